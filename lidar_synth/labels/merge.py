"""Points of several scans in one, with all that is known about each."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.geometry.scan import SYNTHETIC, Boxes, Scan
from lidar_synth.labels.boxes import joined


def merged(scan: Scan, others: Sequence[Scan]) -> Scan:
    """A scan with the points, labels and boxes of others behind its own.

    Its ``domain`` is ``SYNTHETIC``, whatever it holds; sensor, id, pose and image are those of the first scan. Labels,
    confidence (1 for a label of which nobody doubts) and instances are always there; the others' instances get new
    numbers. Rings are there if the first scan has them, boxes if any scan has.
    """
    parts = [_complete(scan)]
    used = _last_instance(parts[0])
    for other in others:
        parts.append(_renumbered(_complete(other), used))
        used = max(used, _last_instance(parts[-1]))
    names = ["reflectance", "label", "confidence", "instance"]
    if scan.ring is not None:
        parts = [replace(p, ring=_rings(p, scan) if p.ring is None else p.ring) for p in parts]
        names.append("ring")
    together: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in ("points", *names)}
    boxes = [p.boxes for p in parts if p.boxes is not None]
    return replace(scan, **together, raw_label=None, boxes=joined(boxes) if boxes else None, domain=SYNTHETIC)


def _complete(scan: Scan) -> Scan:
    label = np.full(len(scan), IGNORE, np.uint8) if scan.label is None else scan.label
    confidence = (label != IGNORE).astype(np.float32) if scan.confidence is None else scan.confidence
    instance = np.zeros(len(scan), np.int32) if scan.instance is None else scan.instance
    return replace(scan, label=label, confidence=confidence, instance=instance)


def _numbers(scan: Scan) -> list[NDArray[np.int32]]:
    """The instances of its points and boxes."""
    known = [] if scan.instance is None else [scan.instance]
    return known if scan.boxes is None else [*known, scan.boxes.instance]


def _last_instance(scan: Scan) -> int:
    return max(int(n.max(initial=0)) for n in _numbers(scan))


def _renumbered(scan: Scan, used: int) -> Scan:
    """The scan with the instances used + 1, used + 2, ... in place of its own; none (0 or less) stays none."""
    old = np.unique(np.concatenate(_numbers(scan)))
    old = old[old > 0]

    def new(numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        return np.where(numbers > 0, np.searchsorted(old, numbers) + used + 1, numbers).astype(np.int32)

    assert scan.instance is not None
    boxes: Boxes | None = scan.boxes
    if boxes is not None:
        boxes = replace(boxes, instance=new(boxes.instance))
    return replace(scan, instance=new(scan.instance), boxes=boxes)


def _rings(part: Scan, scan: Scan) -> NDArray[np.int16]:
    """(N,) the lasers of a scan's sensor that point nearest to points whose ring is not known."""
    tilt = np.arcsin(part.points[:, 2] / np.linalg.norm(part.points, axis=1))
    lasers = scan.sensor.laser_elevations[::-1]
    above = np.searchsorted((lasers[1:] + lasers[:-1]) / 2, tilt)
    return np.asarray(len(lasers) - 1 - above, np.int16)
