"""Scores of scans with boxes by a detector that the user gives.

A detection matches a box of its class by the distance of their centres on the ground, as in the
nuScenes detection benchmark (Caesar et al., CVPR 2020). The mean confidence of detections in
generated scans is what LiDARCrafter calls foreground detection confidence; its code for it is not
public, so that these figures do not stand beside its own.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Boxes, Scan

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Distances of centres, metres, over which the average precision is averaged."""

Detector = Callable[[Scan], tuple[Boxes, NDArray[np.floating]]]
"""Boxes found in a scan, and the confidence of each in [0, 1]."""


class Detection(NamedTuple):
    """How well a detector finds the boxes of scans.

    Args:
        precision: {class: average precision in [0, 1], mean over ``DISTANCES``}, of the classes
            that have boxes.
        confidence: {class: mean confidence of its detections}, of the classes that were detected.
        boxes: {class: number of boxes}.
    """

    precision: dict[str, float]
    confidence: dict[str, float]
    boxes: dict[str, int]

    @property
    def mean_precision(self) -> float:
        """Mean over the classes that have boxes; NaN without any."""
        return float(np.mean(list(self.precision.values()))) if self.precision else float("nan")


def detect(
    detector: Detector, scans: Iterable[Scan], distances: Sequence[float] = DISTANCES
) -> Detection:
    """Let a detector find the boxes of scans.

    Args:
        detector: of the user.
        scans: with boxes.
        distances: of centres on the ground up to which a detection matches a box, metres.

    Raises:
        ConfigError: on distances that are not positive.
        DataError: on a scan without boxes, or a detector that returns other than one confidence per
            box.
    """
    if not distances or min(distances) <= 0:
        raise ConfigError(f"distances {tuple(distances)}", "positive metres")
    found: dict[
        str, list[tuple[float, list[float]]]
    ] = {}  # per detection its confidence, and whether it matches
    count: dict[str, int] = {}
    for scan in scans:
        if scan.boxes is None:
            raise DataError(f"scan {scan.id!r} without boxes", "scans with boxes")
        boxes, confidence = detector(scan)
        scores: NDArray[np.float64] = np.asarray(confidence, np.float64)
        if scores.shape != (len(boxes),) or not ((scores >= 0) & (scores <= 1)).all():
            raise DataError(
                f"scan {scan.id!r}: {len(boxes)} boxes with confidences of shape {scores.shape}",
                "one confidence in [0, 1] per box",
            )
        for name in {*boxes.names, *scan.boxes.names}:
            truth, guess = (_centres(b, name) for b in (scan.boxes, boxes))
            sure = scores[[n == name for n in boxes.names]]
            count[name] = count.get(name, 0) + len(truth)
            hits = np.array([_matches(truth, guess, sure, d) for d in distances]).reshape(
                len(distances), -1
            )
            found.setdefault(name, []).extend(
                (float(c), list(h)) for c, h in zip(sure, hits.T, strict=True)
            )
    precision = {
        n: _mean_average_precision(found[n], c, len(distances)) for n, c in count.items() if c
    }
    mean = {n: float(np.mean([c for c, _ in d])) for n, d in found.items() if d}
    return Detection(precision, mean, {n: c for n, c in count.items() if c})


def _centres(boxes: Boxes, name: str) -> NDArray[np.float32]:
    return boxes.values[[n == name for n in boxes.names], :2]


def _matches(
    truth: NDArray[np.float32],
    guess: NDArray[np.float32],
    confidence: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """(n,) 1 for each guess that is the surest one of its nearest free box within ``reach`` metres,
    else 0."""
    hits = np.zeros(len(guess))
    free = np.ones(len(truth), bool)
    for i in np.argsort(-confidence, kind="stable"):
        distance = np.where(free, np.linalg.norm(truth - guess[i], axis=1), np.inf)
        if len(truth) and distance.min() <= reach:
            hits[i] = 1
            free[distance.argmin()] = False
    return hits


def _mean_average_precision(
    found: Sequence[tuple[float, list[float]]], boxes: int, distances: int
) -> float:
    """Mean over the distances."""
    confidence: NDArray[np.float64] = np.array([one[0] for one in found], np.float64)
    hits: NDArray[np.float64] = np.array([one[1] for one in found], np.float64).reshape(
        -1, distances
    )
    return float(np.mean([average_precision(confidence, one, boxes) for one in hits.T]))


def average_precision(
    confidence: NDArray[np.floating], hits: NDArray[np.floating] | NDArray[np.integer], boxes: int
) -> float:
    """Area under precision over recall, where precision is the best at that recall or a higher one.

    Args:
        confidence: (D,) of detections.
        hits: (D,) 1 for those that match a box, else 0.
        boxes: number of boxes; without any, NaN.
    """
    if not boxes:
        return float("nan")
    right = np.cumsum(hits[np.argsort(-confidence, kind="stable")])
    precision = np.maximum.accumulate((right / np.arange(1, len(right) + 1))[::-1])[::-1]
    return float((precision * np.diff(right, prepend=0)).sum() / boxes)
