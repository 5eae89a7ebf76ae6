"""The ground under an object: a plane through the ground returns in and around its box, and what stands on it."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels.boxes import box_frame

GROUND = np.isin(np.arange(256), [TRAIN_ID[n] for n in ("road", "parking", "sidewalk", "other-ground", "terrain")])
"""(256,) which labels are ground."""

LEAST = 5
"""Returns that a plane needs."""
ROUGH = 0.15
"""Metres by which a return may miss the plane: half a kerb and the unevenness of a lawn."""
STEEP = 0.2
"""Rise per metre of the steepest ground that an upright box can stand on."""
FLOOR = 0.25
"""Metres above the ground up to which a return is ground: it is in nobody's way and hides nobody."""
CLEARANCE = 0.2
"""Metres that an object keeps from what stands beside it."""
_STACK = 0.3  # metres above the lowest return up to which returns are ground where no label tells
_SIDES = 16  # directions in which ground has to lie for it to enclose a box
_NO_LABELS = np.empty(0, np.uint8)


class Ground(NamedTuple):
    """A plane in the frame of a box.

    Args:
        height: of the plane at the box's centre, above the sensor's origin, metres.
        along, across: its rise per metre.
        encloses: its returns lie on all sides of the centre: the box is neither in nor behind a wall.
        free: nothing stands in the box or beside it.
    """

    height: float
    along: float
    across: float
    encloses: bool
    free: bool

    def above(self, points: NDArray[np.float32], box: NDArray[np.float32]) -> NDArray[np.float64]:
        """(N,) metres over the plane of points (N, 3)."""
        local = box_frame(points, box).astype(np.float64)
        heights: NDArray[np.float64] = local @ (-self.along, -self.across, 1.0) + (float(box[2]) - self.height)
        return heights


def ground_under(scan: Scan, box: NDArray[np.float32]) -> Ground | None:
    """The ground under a box, by the labels if there are any around it, else by the lowest returns.

    Args:
        scan: N points.
        box: (7,); its height above the sensor does not matter.

    Returns:
        None where there is no ground, or none that is even and level enough to stand on.
    """
    sensor = scan.sensor
    # A little more than the gap between two rings there, for a sensor as high as on a car's roof.
    gap = 1.5 * np.radians(sensor.up - sensor.down) / sensor.shape[0] * (box[0] ** 2 + box[1] ** 2) / 1.7
    labels = _NO_LABELS if scan.label is None else scan.label
    known, along, across, height, sides, free = _survey(scan.points, labels, GROUND, box, min(max(gap, 1.0), 5.0))
    if not known or np.hypot(along, across) > STEEP:
        return None
    return Ground(height, along, across, sides == _SIDES, free)


def standing(scan: Scan, boxes: Boxes) -> NDArray[np.bool_]:
    """(M, N) which points of a scan belong to each box: those in it that are not ground, and those of its instance."""
    inside = boxes.contain(scan.points)
    low = scan.points[:, 2] < (boxes.values[:, 2] - boxes.values[:, 5] / 2 + FLOOR)[:, None]
    if scan.label is not None:
        low &= GROUND[scan.label] | (scan.label == IGNORE)
    if scan.instance is not None:
        inside |= (boxes.instance[:, None] == scan.instance) & (scan.instance > 0)
    return inside & ~low


@numba.njit(cache=True)
def _survey(points, labels, is_ground, box, reach):  # type: ignore[no-untyped-def]
    """Whether there is ground, the plane (rise along and across, height at the centre), in how many directions its
    returns lie, and whether nothing stands in the box."""
    near, local = _around(points, box, reach)
    ground, labelled = np.zeros(len(near), np.bool_), False
    for k in range(len(near) if len(labels) else 0):
        labelled |= labels[near[k]] != IGNORE
        ground[k] = is_ground[labels[near[k]]]
    if not labelled:
        lowest = _third_lowest(local)
        for k in range(len(near)):
            ground[k] = local[k, 2] < lowest + _STACK
    total = ground.sum()
    along, across, height = _plane(local, ground, box)
    # Without labels the first plane lies a little too high, for it includes the feet of what stands there.
    upper = ROUGH if labelled else ROUGH / 2
    for k in range(len(near)):
        ground[k] &= -ROUGH < local[k, 2] - height - along * local[k, 0] - across * local[k, 1] < upper
    if ground.sum() < max(LEAST, 0.7 * total if labelled else 0.0):
        return False, 0.0, 0.0, 0.0, 0, False
    along, across, height = _plane(local, ground, box)
    free = True
    for x, y, z in local:
        if abs(x) <= box[3] / 2 + CLEARANCE and abs(y) <= box[4] / 2 + CLEARANCE:
            free &= not FLOOR < z - height - along * x - across * y <= box[5]
    return True, along, across, height, _sides(local, ground), free


@numba.njit(cache=True)
def _around(points, box, reach):  # type: ignore[no-untyped-def]
    """Indices of the points whose distance from the box is at most the reach, and where they are: (n, 3) float64
    along and across the box, and above the sensor."""
    c, s = np.cos(box[6]), np.sin(box[6])
    half = np.sqrt(box[3] ** 2 + box[4] ** 2) / 2 + reach
    near, local = np.empty(len(points), np.int64), np.empty((len(points), 3), np.float64)
    count = 0
    for i in range(len(points)):
        x, y = points[i, 0] - box[0], points[i, 1] - box[1]
        if abs(x) <= half and abs(y) <= half:
            along, across = x * c + y * s, y * c - x * s
            if abs(along) <= box[3] / 2 + reach and abs(across) <= box[4] / 2 + reach:
                near[count] = i
                local[count, 0], local[count, 1], local[count, 2] = along, across, points[i, 2]
                count += 1
    return near[:count], local[:count]


@numba.njit(cache=True)
def _third_lowest(local):  # type: ignore[no-untyped-def]
    """Height below which there are two points at most: two stray returns may lie under the ground."""
    first, second, third = np.inf, np.inf, np.inf
    for k in range(len(local)):
        z = local[k, 2]
        if z < first:
            first, second, third = z, first, second
        elif z < second:
            second, third = z, second
        elif z < third:
            third = z
    return third


@numba.njit(cache=True)
def _sides(local, ground):  # type: ignore[no-untyped-def]
    """In how many of the directions from the centre some ground lies."""
    count = 0
    for side in range(_SIDES):
        x, y = np.cos(2 * np.pi * side / _SIDES), np.sin(2 * np.pi * side / _SIDES)
        for k in range(len(local)):
            if ground[k] and local[k, 0] * x + local[k, 1] * y > 0:
                count += 1
                break
    return count


@numba.njit(cache=True)
def _plane(local, ground, box):  # type: ignore[no-untyped-def]
    """Least squares in which near returns count most; few returns give a level plane rather than a steep one."""
    weight = np.zeros(len(local))
    total, x, y, z = 1e-9, 0.0, 0.0, 0.0
    for k in range(len(local)):
        if ground[k]:
            gap = max(abs(local[k, 0]) - box[3] / 2, abs(local[k, 1]) - box[4] / 2, 0.0)
            weight[k] = 1 / (1 + gap * gap)
            total += weight[k]
            x, y, z = x + weight[k] * local[k, 0], y + weight[k] * local[k, 1], z + weight[k] * local[k, 2]
    x, y, z = x / total, y / total, z / total
    xx, xy, yy, xz, yz = 1.0, 0.0, 1.0, 0.0, 0.0
    for k in range(len(local)):
        u, v, w = local[k, 0] - x, local[k, 1] - y, local[k, 2] - z
        xx, xy, yy = xx + weight[k] * u * u, xy + weight[k] * u * v, yy + weight[k] * v * v
        xz, yz = xz + weight[k] * u * w, yz + weight[k] * v * w
    scale = xx * yy - xy * xy
    along, across = (xz * yy - yz * xy) / scale, (yz * xx - xz * xy) / scale
    return along, across, z - along * x - across * y
