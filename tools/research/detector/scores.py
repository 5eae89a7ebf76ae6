"""Average precision of detected boxes, by their overlap in bird's-eye view.

A detection is right if it overlaps a box of its class that no better detection has taken. The
precision is interpolated at all recalls (PASCAL VOC since 2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.bev import REACH, Found
from detector.classes import LEAST
from detector.pools import classes_of, detected, points_in
from lidar_synth import Boxes, Scan

OVERLAP = (0.5, 0.25, 0.25)
"""Minimum intersection over union of the footprints of cars, pedestrians and cyclists."""


@dataclass(frozen=True)
class Truth:
    """The boxes of a tested scan: (M, 7), classes (M,), and whether each has to be found (M,). The
    others, with fewer than ``LEAST`` returns or outside the view, may be found."""

    boxes: NDArray[np.float32]
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


def precisions(found: Sequence[Found], truths: Sequence[Truth]) -> list[float]:
    """The average precision of every class over some scans, 0 to 1; NaN for one without a box."""
    every = []
    for each, least in enumerate(OVERLAP):
        scores = []
        hits = []
        for some, truth in zip(found, truths, strict=True):
            mine = some.classes == each
            real = truth.classes == each
            right = matched(
                some.boxes[mine],
                some.scores[mine],
                truth.boxes[real],
                truth.wanted[real],
                least,
            )
            scores.append(some.scores[mine][right >= 0])
            hits.append(right[right >= 0])
        wanted = sum(int(truth.wanted[truth.classes == each].sum()) for truth in truths)
        every.append(
            average_precision(np.concatenate(scores), np.concatenate(hits), wanted)
        )
    return every


def matched(
    boxes: NDArray[np.float32],
    scores: NDArray[np.float32],
    truth: NDArray[np.float32],
    wanted: NDArray[np.bool_],
    least: float,
) -> NDArray[np.int64]:
    """(D,) 1 for a right detection, 0 for a wrong one, -1 for one that does not count: of a box
    that is not wanted."""
    result = np.zeros(len(boxes), np.int64)
    overlaps = footprint_ious(boxes, truth)
    free = np.ones(len(truth), bool)
    for i in np.argsort(-scores, kind="stable"):
        for mine, value in ((wanted & free, 1), (~wanted, -1)):
            fits = np.where(mine, overlaps[i], 0)
            if len(fits) and fits.max() >= least:
                result[i] = value
                free[fits.argmax()] = False
                break
    return result


def footprint_ious(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> NDArray[np.float64]:
    """(A, B) intersection over union of the footprints of boxes (A, 7) and (B, 7)."""
    ious = np.zeros((len(a), len(b)))
    if not ious.size:
        return ious
    distance = np.hypot(*(a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1))
    near = (
        distance
        < (np.hypot(a[:, 3], a[:, 4])[:, None] + np.hypot(b[:, 3], b[:, 4])) / 2
    )
    first = _footprints(a)
    second = _footprints(b)
    for i, j in np.argwhere(near):
        common = _common_area(first[i], second[j])
        ious[i, j] = common / (
            float(a[i, 3]) * a[i, 4] + float(b[j, 3]) * b[j, 4] - common
        )
    return ious


def _footprints(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(M, 4, 2) corners, counter-clockwise."""
    boxes = Boxes(values, ("",) * len(values))
    return boxes.corners()[:, :4, :2].astype(np.float64)


def _common_area(polygon: NDArray[np.float64], window: NDArray[np.float64]) -> float:
    """Area of the intersection of two convex polygons (n, 2), counter-clockwise: Sutherland and
    Hodgman (1974)."""
    for start, end in zip(window, np.roll(window, -1, 0), strict=True):
        along = end - start
        left = along[0] * (polygon[:, 1] - start[1]) - along[1] * (
            polygon[:, 0] - start[0]
        )
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
        if len(clipped) < 3:
            return 0.0
        polygon = np.array(clipped)
    x, y = (polygon - polygon[0]).T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


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
    precision = np.maximum.accumulate((right / np.arange(1, len(right) + 1))[::-1])[
        ::-1
    ]
    return float((precision * np.diff(right, prepend=0)).sum() / boxes)
