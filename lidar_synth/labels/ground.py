"""The ground under an object, a plane fitted to the ground returns in and around its box, and the
returns above it."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE, has_ground
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels.boxes import box_frame

_compiled = numba.njit(cache=True)

LEAST = 5
"""Minimum number of returns of a plane."""
ROUGH = 0.15
"""Maximum distance of a ground return from the plane, metres: half a kerb, or the unevenness of a
lawn."""
STEEP = 0.2
"""Maximum slope of the ground under an upright box, rise per metre."""
FLOOR = 0.25
"""Height above the ground, metres, below which a return counts as ground and neither blocks nor
hides an object."""
OFF = 0.5
"""Maximum distance, metres, of the floor of a recorded box from ground that has no labels; beyond,
the lowest returns are the object's own."""
CLEARANCE = 0.2
"""Minimum distance between an object and its surroundings, metres."""
# height above the lowest return, metres, below which returns count as ground if there are no labels
_STACK = 0.3
_MIRRORED = 0.5  # minimum depth, metres, of what a mirror shows under the ground
_SIDES = 16  # number of directions in which ground must lie to enclose a box
_NO_LABELS = np.empty(0, np.uint8)


class Ground(NamedTuple):
    """A plane in the frame of a box.

    Args:
        height: height of the plane at the box's centre, above the sensor's origin, metres.
        along, across: rise per metre along and across the box.
        encloses: whether ground returns lie on all sides of the centre, so that the box is neither
            in nor behind a wall.
        free: whether there are no other returns in or beside the box.
    """

    height: float
    along: float
    across: float
    encloses: bool
    free: bool

    def above(
        self, points: NDArray[np.float32], box: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """(N,) height of points (N, 3) above the plane, metres."""
        local = box_frame(points, box).astype(np.float64)
        heights: NDArray[np.float64] = local @ (-self.along, -self.across, 1.0) + (
            float(box[2]) - self.height
        )
        return heights

    def find_standing(
        self, points: NDArray[np.float32], box: NDArray[np.float32]
    ) -> int:
        """Number of points (N, 3) above the ground in or beside a box (7,)."""
        local = np.abs(box_frame(points, box)[:, :2])
        near = (local <= box[3:5] / 2 + CLEARANCE).all(1)
        height = self.above(points[near], box)
        return int(((height > FLOOR) & (height <= box[5])).sum())


def ground_under(scan: Scan, box: NDArray[np.float32]) -> Ground | None:
    """The ground under a box, found by the labels around it, or by the lowest returns if the scan
    has no labels of the ground.

    Args:
        scan: N points.
        box: (7,); its z coordinate is ignored.

    Returns:
        None if there is no ground, or if it is too rough or too steep.
    """
    sensor = scan.sensor
    # A little more than the gap between two rings at this distance, for a sensor on a car's roof.
    gap = (
        1.5
        * np.radians(sensor.up - sensor.down)
        / sensor.shape[0]
        * (box[0] ** 2 + box[1] ** 2)
        / 1.7
    )
    labels = _NO_LABELS if scan.label is None else scan.label
    known, along, across, height, sides, free = _survey(
        scan.points, labels, GROUND, box, min(max(gap, 1.0), 5.0)
    )
    if not known or np.hypot(along, across) > STEEP:
        return None
    return Ground(height, along, across, sides == _SIDES, free)


def ground_of(scan: Scan, box: NDArray[np.float32]) -> Ground | None:
    """``ground_under`` a recorded box (7,); without labels it is level with the box's floor if no
    ground is near."""
    ground = ground_under(scan, box)
    floor = float(box[2] - box[5] / 2)
    if ground is None or has_ground(scan.label) or abs(ground.height - floor) <= OFF:
        return ground
    return Ground(floor, 0.0, 0.0, False, False)


def standing(scan: Scan, boxes: Boxes) -> NDArray[np.bool_]:
    """(M, N) True for points that belong to a box: those inside that are not ground, and those of
    its instance."""
    inside = boxes.contain(scan.points)
    low = (
        scan.points[:, 2]
        < (boxes.values[:, 2] - boxes.values[:, 5] / 2 + FLOOR)[:, None]
    )
    if scan.label is not None:
        low &= GROUND[scan.label] | (scan.label == IGNORE)
    if scan.instance is not None:
        inside |= (boxes.instance[:, None] == scan.instance) & (scan.instance > 0)
    return inside & ~low


@_compiled
def _survey(points, labels, is_ground, box, reach):  # type: ignore[no-untyped-def]
    """Fit the ground: (whether there is any, rise along, rise across, height at the centre, number
    of directions with ground returns, whether the box is free)."""
    near, local = _around(points, box, reach)
    ground = np.zeros(len(near), np.bool_)
    labelled = False
    for k in range(len(near) if len(labels) else 0):
        labelled |= labels[near[k]] != IGNORE
        ground[k] = is_ground[labels[near[k]]]
    if labelled and not ground.any():
        labelled = is_ground[labels].any()  # as ``has_ground``
    if not labelled:
        ground = local[:, 2] < _lowest(local) + _STACK
    total = ground.sum()
    along, across, height = _plane(local, ground, box)
    # Without labels the first plane lies slightly too high, because it includes the lowest returns
    # of objects.
    upper = ROUGH if labelled else ROUGH / 2
    for k in range(len(near)):
        ground[k] &= (
            -ROUGH
            < local[k, 2] - height - along * local[k, 0] - across * local[k, 1]
            < upper
        )
    if ground.sum() < max(LEAST, 0.7 * total if labelled else 0.0):
        return False, 0.0, 0.0, 0.0, 0, False
    along, across, height = _plane(local, ground, box)
    free = True
    for x, y, z in local:
        if abs(x) <= box[3] / 2 + CLEARANCE and abs(y) <= box[4] / 2 + CLEARANCE:
            free &= not FLOOR < z - height - along * x - across * y <= box[5]
    return True, along, across, height, _sides(local, ground), free


@_compiled
def _around(points, box, reach):  # type: ignore[no-untyped-def]
    """Indices (n,) of the points within reach of the box, and their coordinates (n, 3) float64:
    along and across the box, and above the sensor."""
    c = np.cos(box[6])
    s = np.sin(box[6])
    half = np.sqrt(box[3] ** 2 + box[4] ** 2) / 2 + reach
    near = np.empty(len(points), np.int64)
    local = np.empty((len(points), 3), np.float64)
    count = 0
    for i in range(len(points)):
        x = points[i, 0] - box[0]
        y = points[i, 1] - box[1]
        if abs(x) <= half and abs(y) <= half:
            along = x * c + y * s
            across = y * c - x * s
            if abs(along) <= box[3] / 2 + reach and abs(across) <= box[4] / 2 + reach:
                near[count] = i
                local[count, 0] = along
                local[count, 1] = across
                local[count, 2] = points[i, 2]
                count += 1
    return near[:count], local[:count]


@_compiled
def _lowest(local):  # type: ignore[no-untyped-def]
    """The third lowest height, since two stray returns may lie below the ground; if a mirror shows
    more of them, the height that 5 % lie below."""
    if len(local) < LEAST:
        return np.inf
    heights = np.sort(local[:, 2])
    level = heights[max(2, len(local) // 20)]
    return level if level - heights[2] > _MIRRORED else heights[2]


@_compiled
def _sides(local, ground):  # type: ignore[no-untyped-def]
    """Number of directions from the centre in which there is ground."""
    count = 0
    for side in range(_SIDES):
        x = np.cos(2 * np.pi * side / _SIDES)
        y = np.sin(2 * np.pi * side / _SIDES)
        for k in range(len(local)):
            if ground[k] and local[k, 0] * x + local[k, 1] * y > 0:
                count += 1
                break
    return count


@_compiled
def _plane(local, ground, box):  # type: ignore[no-untyped-def]
    """Weighted least squares: near returns weigh more, and regularisation makes a plane of few
    returns level."""
    weight = np.zeros(len(local))
    total = 1e-9
    x = 0.0
    y = 0.0
    z = 0.0
    for k in range(len(local)):
        if ground[k]:
            gap = max(abs(local[k, 0]) - box[3] / 2, abs(local[k, 1]) - box[4] / 2, 0.0)
            weight[k] = 1 / (1 + gap * gap)
            total += weight[k]
            x += weight[k] * local[k, 0]
            y += weight[k] * local[k, 1]
            z += weight[k] * local[k, 2]
    x /= total
    y /= total
    z /= total
    xx = 1.0
    xy = 0.0
    yy = 1.0
    xz = 0.0
    yz = 0.0
    for k in range(len(local)):
        u = local[k, 0] - x
        v = local[k, 1] - y
        w = local[k, 2] - z
        xx += weight[k] * u * u
        xy += weight[k] * u * v
        yy += weight[k] * v * v
        xz += weight[k] * u * w
        yz += weight[k] * v * w
    scale = xx * yy - xy * xy
    along = (xz * yy - yz * xy) / scale
    across = (yz * xx - xz * xy) / scale
    return along, across, z - along * x - across * y
