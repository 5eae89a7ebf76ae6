"""Average precision of detected boxes, by their overlap in bird's-eye view.

A detection is right if it overlaps a box of its class that no better detection has taken. The
precision is interpolated at all recalls (PASCAL VOC since 2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Scan
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.overlap import footprints
from lidar_synth.lab.proof.detection.bev import REACH, Found
from lidar_synth.lab.proof.detection.boxes import (
    LEAST,
    classes_of,
    detected,
    points_in,
)

OVERLAP = (0.5, 0.25, 0.25)
"""Minimum intersection over union of the footprints of cars, pedestrians and cyclists."""


@dataclass(frozen=True)
class Truth:
    """The boxes of a tested scan: (M, 7), classes (M,), and whether each has to be found (M,). The
    others, with fewer than ``LEAST`` returns or outside the view, may be found."""

    boxes: Float32Array
    classes: NDArray[np.int64]
    wanted: NDArray[np.bool_]

    @classmethod
    def of(cls, scan: Scan) -> "Truth":
        """The boxes of a scan."""
        boxes = detected(scan)
        inside = (np.abs(boxes.values[:, :2]) < REACH).all(1)
        return cls(
            boxes.values, classes_of(boxes), inside & (points_in(boxes, scan) >= LEAST)
        )


@dataclass(frozen=True)
class Criterion:
    """When a detection is right, and which boxes count.

    Args:
        overlap: minimum intersection over union of the footprints; 0 for a criterion by distance.
        distance: maximum distance of the centres, metres.
        near, far: distance of the boxes from the sensor, metres.
    """

    overlap: float = 0.0
    distance: float = 0.0
    near: float = 0.0
    far: float = np.inf

    def fit(
        self,
        boxes: Float32Array,
        truth: Float32Array,
    ) -> NDArray[np.float64]:
        """(D, M) how well boxes (D, 7) fit others (M, 7); 1 and more is right."""
        if self.overlap:
            return footprint_ious(boxes, truth) / self.overlap
        apart = _distances(boxes, truth)
        return np.asarray(self.distance / np.maximum(apart, 1e-9), np.float64)

    def includes(self, boxes: Float32Array) -> NDArray[np.bool_]:
        """(M,) whether boxes (M, 7) are within the limits of distance."""
        away = np.hypot(*boxes[:, :2].T)
        return np.asarray((self.near <= away) & (away < self.far))


class Judged(NamedTuple):
    """The detections of a class that count, in some scans: (D,) scores and (D,) 1 for right ones;
    and the number of boxes that have to be found."""

    scores: Float32Array
    hits: NDArray[np.int64]
    wanted: int


def judge(
    found: Found,
    truth: Truth,
    each: int,
    criterion: Criterion,
) -> Judged:
    """The detections of a class in one scan by a criterion."""
    mine = found.classes == each
    real = truth.classes == each
    boxes = found.boxes[mine]
    scores = found.scores[mine]
    wanted = truth.wanted[real] & criterion.includes(truth.boxes[real])
    right = matched(criterion.fit(boxes, truth.boxes[real]), scores, wanted)
    counted = (right == 1) | ((right == 0) & criterion.includes(boxes))
    return Judged(scores[counted], right[counted], int(wanted.sum()))


def precision_of(judged: Sequence[Judged]) -> float:
    """The average precision over some scans, 0 to 1; NaN without a box."""
    if not judged:
        return float("nan")
    return average_precision(
        np.concatenate([one.scores for one in judged]),
        np.concatenate([one.hits for one in judged]),
        sum(one.wanted for one in judged),
    )


def precisions(
    found: Sequence[Found],
    truths: Sequence[Truth],
) -> list[float]:
    """The average precision of every class over some scans, 0 to 1; NaN for one without a box."""
    pairs = list(zip(found, truths, strict=True))
    return [
        precision_of([judge(*pair, each, Criterion(least)) for pair in pairs])
        for each, least in enumerate(OVERLAP)
    ]


def matched(
    fit: NDArray[np.float64],
    scores: Float32Array,
    wanted: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """(D,) 1 for a right detection, 0 for a wrong one, -1 for one that does not count: of a box
    that is not wanted.

    Args:
        fit: (D, M), 1 and more where a detection may be of a box.
        scores: (D,) of the detections; the best are matched first.
        wanted: (M,) the boxes that have to be found.
    """
    result = np.zeros(len(scores), np.int64)
    free = np.ones(len(wanted), bool)
    for i in np.argsort(-scores, kind="stable"):
        for mine, value in ((wanted & free, 1), (~wanted, -1)):
            fits = np.where(mine, fit[i], 0)
            if len(fits) and fits.max() >= 1:
                result[i] = value
                free[fits.argmax()] = False
                break
    return result


def _distances(a: Float32Array, b: Float32Array) -> NDArray[np.float64]:
    """(A, B) distances between the centres of boxes (A, 7) and (B, 7) on the ground."""
    x, y = (a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1)
    return np.asarray(np.hypot(x, y))


def footprint_ious(
    a: Float32Array,
    b: Float32Array,
) -> NDArray[np.float64]:
    """(A, B) intersection over union of the footprints of boxes (A, 7) and (B, 7)."""
    ious = np.zeros((len(a), len(b)))
    if not ious.size:
        return ious
    lengths = np.hypot(a[:, 3], a[:, 4])
    others = np.hypot(b[:, 3], b[:, 4])
    near = _distances(a, b) < (lengths[:, None] + others) / 2
    first = footprints(a).astype(np.float64)
    second = footprints(b).astype(np.float64)
    for i, j in np.argwhere(near):
        common = _common_area(first[i], second[j])
        ious[i, j] = common / (
            float(a[i, 3]) * a[i, 4] + float(b[j, 3]) * b[j, 4] - common
        )
    return ious


def _clip(
    polygon: NDArray[np.float64], left: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The part of a polygon (n, 2) that is on the left of a line, by the sides (n,) of its
    corners."""
    clipped = []
    for k in range(len(polygon)):
        before = left[k - 1]
        here = left[k]
        if (before < 0) != (here < 0):
            clipped.append(
                polygon[k - 1]
                + (polygon[k] - polygon[k - 1]) * before / (before - here)
            )
        if here >= 0:
            clipped.append(polygon[k])
    return np.array(clipped)


def _common_area(
    polygon: NDArray[np.float64],
    window: NDArray[np.float64],
) -> float:
    """Area of the intersection of two convex polygons (n, 2), counter-clockwise: Sutherland and
    Hodgman (1974)."""
    for start, end in zip(window, np.roll(window, -1, 0), strict=True):
        along = end - start
        left = along[0] * (polygon[:, 1] - start[1]) - along[1] * (
            polygon[:, 0] - start[0]
        )
        polygon = _clip(polygon, left)
        if len(polygon) < 3:
            return 0.0
    x, y = (polygon - polygon[0]).T
    doubled = x * np.roll(y, -1) - y * np.roll(x, -1)
    return float(np.sum(doubled) / 2)


def average_precision(
    confidence: NDArray[np.floating],
    hits: NDArray[np.floating] | NDArray[np.integer],
    boxes: int,
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
    exact = right / np.arange(1, len(right) + 1)
    precision = np.maximum.accumulate(exact[::-1])[::-1]
    return float((precision * np.diff(right, prepend=0)).sum() / boxes)
