"""Which boxes overlap on the ground."""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.scan import Boxes

MARGIN = 0.2
"""Metres by which two boxes may reach into each other: annotated boxes of parked cars touch."""


def footprints(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(M, 4, 2) corners of boxes (M, 7) on the ground, counter-clockwise."""
    return Boxes(values, ("",) * len(values)).corners()[:, :4, :2]


def find_overlapping(
    box: NDArray[np.float32], others: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(M,) True for each of the others (M, 7) whose footprint overlaps that of a box (7,).

    Separating axis theorem: two rectangles are disjoint if a side of one of them separates their
    corners.
    """
    far: NDArray[np.bool_] = (
        np.hypot(*(others[:, :2] - box[:2]).T)
        > (np.hypot(*others[:, 3:5].T) + np.hypot(*box[3:5])) / 2
    )
    if far.all():
        return ~far
    corners = footprints(np.concatenate([box[None], others]))
    sides = np.stack([corners[:, 0] - corners[:, 1], corners[:, 1] - corners[:, 2]], 1)
    # (M, 4, 2): the sides of the box, then those of the other one
    axes = np.concatenate(
        [np.broadcast_to(sides[0], (len(others), 2, 2)), sides[1:]], 1
    )
    a = axes @ corners[0].T
    b = axes @ corners[1:].transpose(0, 2, 1)
    apart = (a.max(2) < b.min(2)) | (b.max(2) < a.min(2))
    return np.asarray(~apart.any(1))


def overlapping_pairs(boxes: Boxes, margin: float = MARGIN) -> list[tuple[int, int]]:
    """Pairs of boxes that reach more than ``margin`` metres into each other, by their footprints
    and heights."""
    values = boxes.values.copy()
    values[:, 3:6] = np.maximum(values[:, 3:6] - margin, 1e-3)
    pairs = []
    for i, box in enumerate(values):
        later = values[i + 1 :]
        level = np.abs(later[:, 2] - box[2]) < (later[:, 5] + box[5]) / 2
        meet = find_overlapping(box, later) & level
        pairs += [(i, i + 1 + int(j)) for j in np.flatnonzero(meet)]
    return pairs


def count_overlapping(boxes: Boxes) -> int:
    """Number of boxes that overlap another one of their class. Objects do not overlap, but several
    boxes along the way of one moving car do."""
    names = boxes.names
    same = [{i, j} for i, j in overlapping_pairs(boxes) if names[i] == names[j]]
    return len(set().union(*same))
