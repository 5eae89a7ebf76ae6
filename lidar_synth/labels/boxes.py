"""Geometry of boxes: a box's own frame, movement and enlargement."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, wrap_angle
from lidar_synth.geometry.arrays import Float32Array


def box_frame(points: Float32Array, box: Float32Array) -> Float32Array:
    """Transform points into the frame of one box (7,): (N, 3) metres along, across and above its
    centre."""
    return turn_points(points - box[:3], -box[6])


def grow_box(box: Float32Array, points: Float32Array) -> Float32Array:
    """Enlarge a box (7,) about its centre so that it contains points (N, 3).

    A margin of one millimetre ensures that it still contains them when both are moved in float32.
    """
    needed = 2 * (np.abs(box_frame(points, box)).max(0, initial=0) + 1e-3)
    return np.concatenate(
        [box[:3], np.maximum(box[3:6], needed), box[6:]], dtype=np.float32
    )


def move_boxes(boxes: Boxes, values: Float32Array) -> Boxes:
    """The boxes with new values (M, 7): without their boxes in the camera image, and with yaw in
    [-pi, pi)."""
    values = values.astype(np.float32)
    values[:, 6] = wrap_angle(values[:, 6])
    return Boxes(
        values,
        boxes.names,
        occlusion=boxes.occlusion.copy(),
        instance=boxes.instance.copy(),
    )


def turn_boxes(boxes: Boxes, angle: float) -> Boxes:
    """Boxes turned about the sensor, counter-clockwise by an angle in radians."""
    values = boxes.values.copy()
    values[:, :2] = turn_points(values[:, :2], angle)
    values[:, 6] += angle
    return move_boxes(boxes, values)


def turn_points(points: NDArray[Any], angle: float | np.floating) -> NDArray[Any]:
    """(N, 2 or 3) points turned about the sensor, counter-clockwise by an angle in radians."""
    c = np.cos(angle)
    s = np.sin(angle)
    out = points.copy()
    out[:, 0] = points[:, 0] * c - points[:, 1] * s
    out[:, 1] = points[:, 0] * s + points[:, 1] * c
    return out


def join_boxes(several: Sequence[Boxes]) -> Boxes:
    """Concatenate boxes, in this order."""
    names = tuple(name for boxes in several for name in boxes.names)
    arrays = {
        f.name: np.concatenate([getattr(b, f.name) for b in several])
        for f in fields(Boxes)
        if f.name != "names"
    }
    return Boxes(names=names, **arrays)


def widen_boxes(values: Float32Array, margin: float) -> Float32Array:
    """Boxes (..., 7) with a margin in metres on each of their four sides."""
    return values + np.array([0, 0, 0, 2 * margin, 2 * margin, 0, 0], np.float32)


def forget_images(boxes: Boxes) -> Boxes:
    """The boxes without their place in the camera image, which is unknown after they were raised or
    lowered."""
    return replace(
        boxes,
        image_box=np.full((len(boxes), 4), -1, np.float32),
        dont_care=np.zeros((0, 4), np.float32),
    )
