"""The plain PyTorch item, the default form of a sample."""

from copy import deepcopy
from typing import Any

import numpy as np
import torch

from lidar_synth.datasets.classes import IGNORE, check_labels
from lidar_synth.geometry import Scan


class Item(dict[str, Any]):
    """One sample. All items have the same keys, and their tensors share no memory with the scan.

    Keys:
        points: (N, 4) float32 x, y, z in metres, sensor frame, and reflectance in [0, 1].
        label: (N,) int64 train ids 0..18; 255 = ignore, or the scan has no labels.
        confidence: (N,) float32 in [0, 1] of ``label``; if the scan has none, 1 for every labelled
            point.
        boxes: (M, 7) float32 x, y, z of the centre of gravity, l, w, h in metres, yaw in radians; M
            = 0 without boxes.
        names: M class names in KITTI's spelling.
        domain: 0 real, 1 synthetic.
        loss_weight: the factor by which to multiply the loss of this sample.
        id: the scan's name.
    """


def copy_scan(scan: Scan) -> Scan:
    """A scan whose arrays, boxes and pose may be changed in place."""
    shared = (scan.sensor, scan.provenance, scan.augmented)
    return deepcopy(scan, {id(part): part for part in shared})


def to_item(scan: Scan, rng: np.random.Generator) -> Item:
    """Convert a scan to a plain PyTorch item.

    Args:
        scan: N points.
        rng: not used; every ``to_sample(scan, rng)`` gets one.

    Raises:
        DataError: on a label that is not a train id.
    """
    points = np.empty((len(scan), 4), np.float32)
    # By column, because numpy copies rows of three values slowly.
    for column, values in enumerate((*scan.points.T, scan.reflectance)):
        points[:, column] = values
    if scan.label is None:
        label = np.full(len(scan), IGNORE, np.int64)
    else:
        label = scan.label.astype(np.int64)
        hint = "Map the dataset's own ids when they are read (Taxonomy.decode)."
        check_labels(scan.label, f"scan {scan.id!r}", hint)
    if scan.confidence is None:
        confidence = (label != IGNORE).astype(np.float32)
    else:
        confidence = np.array(scan.confidence, np.float32)
    boxes: Any = (
        np.empty((0, 7), np.float32) if scan.boxes is None else scan.boxes.values.copy()
    )
    return Item(
        points=torch.from_numpy(points),
        label=torch.from_numpy(label),
        confidence=torch.from_numpy(confidence),
        boxes=torch.from_numpy(boxes),
        names=() if scan.boxes is None else scan.boxes.names,
        domain=scan.domain,
        loss_weight=1.0,
        id=scan.id,
    )
