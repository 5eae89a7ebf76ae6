"""The image of a layout on a sensor's rays: what each ray meets first, and how far away."""

import numba
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.geometry.layout.layout import (
    CHANNELS,
    CHORD_STEP,
    CODES,
    DEPTH_STEP,
    Layout,
)
from lidar_synth.geometry.sensor import Sensor

_compiled = numba.njit(cache=True)

FARTHEST = 65535 * DEPTH_STEP
"""The largest depth that two bytes hold, metres."""


def layout_image(layout: Layout, sensor: Sensor) -> NDArray[np.uint8]:
    """Cast the rays through the centres of a sensor's cells, from where they start.

    The image does not depend on the direction of x: turning a layout rolls it, mirroring a layout
    flips it.

    Args:
        layout: what stands where. A box is never hidden by the ground, whose estimate may be too
            high under it.
        sensor: H, W.

    Returns:
        (5, H, W) uint8, the ``CHANNELS``: ``class`` from ``CODES``; ``depth_high`` and
        ``depth_low``, the two bytes of the distance from the start of the ray in steps of 2 mm, 0
        where nothing is known; inside a box ``chord``, the way of the ray through it in steps of
        0.1 m, and ``along``, where the ray enters it, from 0 at the box's rear to 255 at its front.
        Nothing is known beyond the sensor's range, nor beyond 131.07 m, the largest depth.
    """
    rows, columns = sensor.shape
    slope = np.tan(sensor.row_elevations().astype(np.float64))
    starts = sensor.starts if len(sensor.starts) else np.zeros(rows)
    walls, kinds = _walls(layout)
    code, depth, chord, along = _cast(
        sensor.column_azimuths().astype(np.float64),
        slope,
        starts.astype(np.float64),
        layout.boxes.values.astype(np.float64),
        layout.codes(),
        walls,
        kinds,
        np.array(layout.ground, np.float64),
        layout.reach,
        sensor.range_min,
        min(sensor.range_max, FARTHEST),
    )
    image = np.zeros((len(CHANNELS), rows, columns), np.uint8)
    steps = np.rint(depth / DEPTH_STEP).astype(np.uint16)
    image[0] = code
    image[1] = steps >> 8
    image[2] = steps & 255
    image[3] = np.clip(np.rint(chord / CHORD_STEP), 0, 255)
    image[4] = np.clip(np.rint(along * 255), 0, 255)
    return image


def depth_of(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(..., H, W) metres of layout images (..., 5, H, W); 0 where nothing is known."""
    high = image[..., 1, :, :].astype(np.float32)
    low = image[..., 2, :, :].astype(np.float32)
    return np.asarray((high * 256 + low) * np.float32(DEPTH_STEP), np.float32)


def depths_of(images: Tensor) -> Tensor:
    """``depth_of`` for tensors: (B, H, W) metres of layout images (B, 5, H, W) uint8."""
    return (256 * images[:, 1].float() + images[:, 2]) * DEPTH_STEP


def _walls(layout: Layout) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(S, 8) x, y, lower and upper edge of both ends of each upright wall, and (S,) the code of
    each."""
    walls = [np.empty((0, 8))]
    kinds = []
    for outline in layout.outlines:
        corners = np.c_[outline.line, outline.low, outline.high].astype(np.float64)
        walls.append(np.c_[corners[:-1], corners[1:]])
        kinds += [CODES[outline.kind]] * (len(corners) - 1)
    return np.concatenate(walls), np.array(kinds, np.uint8)


@_compiled
def _cast(  # type: ignore[no-untyped-def]
    azimuth, slope, lift, boxes, codes, walls, kinds, ground, reach, nearest, farthest
):
    """Code, distance, way through the box and place along the box of the first thing on each ray
    (H, W).

    A ray is (cos a, -sin a, slope) times the horizontal distance rho, above its start.
    """
    rows = len(slope)
    columns = len(azimuth)
    code = np.zeros((rows, columns), np.uint8)
    depth = np.zeros((rows, columns), np.float32)
    chord = np.zeros((rows, columns), np.float32)
    along = np.zeros((rows, columns), np.float32)
    hit_wall = np.empty(len(walls), np.int64)
    wall_at = np.empty((len(walls), 3))
    hit_box = np.empty(len(boxes), np.int64)
    span = np.empty((len(boxes), 2))
    for j in range(columns):
        dx = np.cos(azimuth[j])
        dy = -np.sin(azimuth[j])
        some_walls = _cross_walls(dx, dy, walls, hit_wall, wall_at)
        some_boxes = _cross_boxes(dx, dy, boxes, hit_box, span)
        rise = ground[1] * dx + ground[2] * dy
        for i in range(rows):
            rho = np.inf
            what = 0
            way = 0.0
            place = 0.0
            fall = slope[i] - rise
            if fall < 0 and 0 < (ground[0] - lift[i]) / fall <= reach:
                rho = (ground[0] - lift[i]) / fall
                what = 1
            for k in range(some_walls):
                far, low, high = wall_at[k]
                if far < rho and low <= lift[i] + slope[i] * far <= high:
                    rho = far
                    what = kinds[hit_wall[k]]
            for k in range(some_boxes):
                box = boxes[hit_box[k]]
                enter, leave = _between(
                    lift[i] - box[2], slope[i], box[5] / 2, span[k, 0], span[k, 1]
                )
                if 0 < enter < leave and (enter < rho or what == 1):
                    rho = enter
                    what = codes[hit_box[k]]
                    way = (leave - enter) * np.sqrt(1 + slope[i] ** 2)
                    x = enter * dx - box[0]
                    y = enter * dy - box[1]
                    place = 0.5 + (x * np.cos(box[6]) + y * np.sin(box[6])) / box[3]
            distance = rho * np.sqrt(1 + slope[i] ** 2)
            if nearest <= distance <= farthest:
                code[i, j] = what
                depth[i, j] = distance
                chord[i, j] = way
                along[i, j] = place
    return code, depth, chord, along


@_compiled
def _between(offset, slope, half, enter, leave):  # type: ignore[no-untyped-def]
    """The part of ``enter`` to ``leave`` in which |offset + slope * rho| <= half; empty parts have
    enter >= leave."""
    if abs(slope) < 1e-12:
        return (enter, leave) if abs(offset) <= half else (1.0, 0.0)
    a = (-half - offset) / slope
    b = (half - offset) / slope
    return max(enter, min(a, b)), min(leave, max(a, b))


@_compiled
def _cross_boxes(dx, dy, boxes, which, span):  # type: ignore[no-untyped-def]
    """Fill the boxes whose footprint a direction crosses, and from where to where; return their
    number."""
    count = 0
    for k in range(len(boxes)):
        x, y, _, length, width, _, yaw = boxes[k]
        c = np.cos(yaw)
        s = np.sin(yaw)
        enter, leave = _between(
            -x * c - y * s, dx * c + dy * s, length / 2, 0.0, np.inf
        )
        enter, leave = _between(x * s - y * c, dy * c - dx * s, width / 2, enter, leave)
        if enter < leave:
            which[count] = k
            span[count, 0] = enter
            span[count, 1] = leave
            count += 1
    return count


@_compiled
def _cross_walls(dx, dy, walls, which, at):  # type: ignore[no-untyped-def]
    """Fill the walls that a direction crosses, and their distance, lower and upper edge there;
    return their number."""
    count = 0
    for k in range(len(walls)):
        x1, y1, low1, high1, x2, y2, low2, high2 = walls[k]
        # The side of the direction on which each end is.
        first = dx * y1 - dy * x1
        second = dx * y2 - dy * x2
        if (first < 0) == (second < 0) or first == second:
            continue
        share = first / (first - second)
        rho = (x1 + share * (x2 - x1)) * dx + (y1 + share * (y2 - y1)) * dy
        if rho > 0:
            which[count] = k
            at[count, 0] = rho
            at[count, 1] = low1 + share * (low2 - low1)
            at[count, 2] = high1 + share * (high2 - high1)
            count += 1
    return count
