"""Evaluation of scans by a detector that was trained on real streets: how well it finds the scans'
own boxes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.errors import DataError
from lidar_synth.files.torch_files import load_pickle
from lidar_synth.geometry import Scan, Source
from lidar_synth.lab.evaluate.extractors.archive import load_weights
from lidar_synth.lab.evaluate.reading import readable
from lidar_synth.lab.proof.detection.bev import Found
from lidar_synth.lab.proof.detection.boxes import (
    CLASSES,
    LEAST,
    classes_of,
    detected,
    points_in,
)
from lidar_synth.lab.proof.detection.centerpoint import CenterPoint
from lidar_synth.lab.proof.detection.pointpillars import PointPillars
from lidar_synth.lab.proof.detection.scores import (
    OVERLAP,
    Criterion,
    Truth,
    judge,
    precision_of,
)

BANDS = {
    "all": (0.0, np.inf),
    "0 to 20 m": (0.0, 20.0),
    "20 to 35 m": (20.0, 35.0),
    "over 35 m": (35.0, np.inf),
}
"""Distance of the boxes from the sensor, metres."""
NEUTRAL = ("Van", "Person_sitting")
"""Boxes that KITTI's detectors neither learn nor get wrong."""
Detecting = PointPillars | CenterPoint


def load_detector(path: Path) -> Detecting:
    """Load a checkpoint of OpenPCDet's PointPillars for KITTI or CenterPoint on pillars for
    nuScenes, without running code of the file.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a damaged file, or weights of another network.
    """
    content = load_pickle(Path(path), "OpenPCDet")
    state = content.get("model_state") if isinstance(content, dict) else None
    if not isinstance(state, dict):
        raise DataError(
            f"{path} without model_state",
            "a checkpoint of OpenPCDet, such as pointpillar_7728.pth",
        )
    centres = "dense_head.shared_conv.0.weight" in state
    network = CenterPoint() if centres else PointPillars()
    load_weights(network, state, str(path), extra=True)
    return network.eval()


def _truth(network: Detecting, scan: Scan) -> Truth:
    boxes = detected(scan)
    wanted = network.sees(boxes.values) & (points_in(boxes, scan) >= LEAST)
    wanted &= np.array([name not in NEUTRAL for name in boxes.names], bool)
    return Truth(boxes.values, classes_of(boxes), wanted)


def recognise_boxes(
    network: Detecting, scans: Source, name: str = "scans", progress: bool = True
) -> dict[str, Any]:
    """How well a detector finds the boxes of scans, where it looks.

    Args:
        network: the detector, in evaluation mode.
        scans: with boxes.
        name: what the progress bar calls them.
        progress: whether to show a progress bar.

    Returns:
        The number of ``scans``, and ``classes``: {class: {band of distance: ``boxes`` that have to
        be found, ``precision`` (average precision) and ``recall``, 0 to 1}}, without bands that
        hold no box. The overlap of a right detection is at least ``OVERLAP``.

    Raises:
        DataError: on scans without boxes.
    """
    pairs: list[tuple[Found, Truth]] = []
    for scan in readable(scans, None, name, progress):
        truth = _truth(network, scan)
        pairs.append((network.find(scan), truth))
    classes: dict[str, dict[str, dict[str, float]]] = {}
    for each, title in enumerate(CLASSES):
        for band, (near, far) in BANDS.items():
            criterion = Criterion(OVERLAP[each], near=near, far=far)
            judged = [judge(*pair, each, criterion) for pair in pairs]
            if boxes := sum(one.wanted for one in judged):
                classes.setdefault(title, {})[band] = {
                    "boxes": boxes,
                    "precision": precision_of(judged),
                    "recall": sum(int(one.hits.sum()) for one in judged) / boxes,
                }
    if not classes:
        raise DataError(
            f"{name}: no car, pedestrian or cyclist with {LEAST} returns where the detector looks",
            "scans with such boxes in front of the sensor, within 50 m",
        )
    return {"scans": len(pairs), "classes": classes}


def as_text(figures: Mapping[str, Any]) -> str:
    """The figures of ``{"real": ..., "fake": ...}``, each of ``recognise_boxes``, as a table in
    Markdown."""
    sides = [figures["real"], figures["fake"]]
    heads = " | ".join(
        f"{name}, boxes ({side['scans']} scans) | average precision, % | recall, %"
        for name, side in zip(("real", "fake"), sides, strict=True)
    )
    lines = [f"| class | distance | {heads} |", "|---|---|" + "---:|" * 6]
    for title in CLASSES:
        for band in BANDS:
            found = [side["classes"].get(title, {}).get(band) for side in sides]
            if any(found):
                cells = " | ".join(map(_cells, found))
                lines.append(f"| {title} | {band} | {cells} |")
    return "\n".join(lines)


def _cells(figures: Mapping[str, float] | None) -> str:
    if figures is None:
        return "0 | | "
    shown = [f"{100 * figures[name]:.1f}" for name in ("precision", "recall")]
    return " | ".join([str(figures["boxes"]), *shown])
