"""3-D boxes of the objects of a scan, with their image box, truncation and occlusion in the camera
image.

A box is the bounding box of the object's own mesh, so it contains the returns of its instance.
Range noise and the
tilt of the ground can move a few returns outside: a box has a yaw, but no pitch or roll.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.scan import Boxes
from lidar_synth.lab.town.camera import CAMERA, pixel_rays
from lidar_synth.lab.town.cast import Snapshot, trace
from lidar_synth.lab.town.scene import PlacedObject, Pose

_GRID = 12
"""Camera rays along each side of an object's image box, cast to estimate how much of the object is
hidden."""
_LEVELS = ((0.80, 0), (0.45, 1), (0.05, 2))
"""(smallest visible share, KITTI's occlusion): 0 visible, 1 partly, 2 largely occluded; 3 below all
of them."""


def boxes_of(objects: list[PlacedObject], pose: Pose, snapshot: Snapshot) -> Boxes:
    """The boxes of objects in the sensor frame, with their image box, truncation and occlusion.

    Args:
        objects: the objects that have a box and at least one return.
        pose: (4, 4) sensor to world.
        snapshot: the stretch at the time of the scan.
    """
    count = len(objects)
    in_sensor = np.linalg.inv(pose) @ np.array([o.pose for o in objects]).reshape(
        -1, 4, 4
    )
    values = np.array(
        [_box_values(o, p) for o, p in zip(objects, in_sensor, strict=True)], np.float32
    ).reshape(-1, 7)
    image_box = np.full((count, 4), -1, np.float32)
    truncation = np.full(count, -1, np.float32)
    occlusion = np.full(count, -1, np.int8)
    for i, placed in enumerate(objects):
        # The camera's field of view is 104 degrees wide; objects well outside of it need no
        # projection.
        if abs(values[i, 1]) < 1.35 * values[i, 0] + values[i, 3] + 1:
            image_box[i], truncation[i] = _image_box_of(placed, in_sensor[i])
    visible = _visible_shares(
        [objects[i] for i in np.flatnonzero(truncation >= 0)],
        image_box[truncation >= 0],
        pose,
        snapshot,
    )
    occlusion[truncation >= 0] = [
        next((level for threshold, level in _LEVELS if v >= threshold), 3)
        for v in visible
    ]
    names = tuple(o.prototype.name for o in objects)
    instance = np.array([o.instance for o in objects], np.int32)
    return Boxes(
        values,
        names,
        truncation,
        occlusion,
        image_box,
        instance=instance,
    )


def _box_values(placed: PlacedObject, in_sensor: Pose) -> NDArray[np.float64]:
    """(7,) centre, size and yaw of an object's box, from its pose in the sensor frame."""
    low, high = placed.prototype.mesh.bounds
    centre = in_sensor[:3, :3] @ (placed.scale * (low + high) / 2) + in_sensor[:3, 3]
    return np.array(
        [
            *centre,
            *(placed.scale * (high - low)),
            np.arctan2(in_sensor[1, 0], in_sensor[0, 0]),
        ]
    )


def _image_box_of(
    placed: PlacedObject, in_sensor: Pose
) -> tuple[NDArray[np.float64] | float, float]:
    """The image box (left, top, right, bottom) of an object and its truncation, the share of its
    outline's corners that lie outside the image; -1, -1 if the object is not in the image."""
    assert CAMERA.image_size is not None
    edge = np.array(CAMERA.image_size) - 1.0
    outline = placed.scale * placed.prototype.mesh.outline
    pixels, depth = CAMERA.pixels(outline @ in_sensor[:3, :3].T + in_sensor[:3, 3])
    in_front = depth > 0.2
    inside = in_front & ((pixels >= 0) & (pixels <= edge)).all(1)
    if not inside.any():
        return -1.0, -1.0
    low = np.clip(pixels[in_front].min(0), 0, edge)
    high = np.clip(pixels[in_front].max(0), 0, edge)
    if (high - low).min() < 2:
        return -1.0, -1.0
    return np.r_[low, high], float(1 - inside.mean())


def _visible_shares(
    objects: list[PlacedObject],
    image_boxes: NDArray[np.float32],
    pose: Pose,
    snapshot: Snapshot,
) -> list[float]:
    """For each object, the share of the camera rays towards it that nothing in front of it
    blocks."""
    step = (np.arange(_GRID) + 0.5) / _GRID
    rays = []
    own_distances = []
    eye = pixel_rays(pose, np.zeros((1, 2)))[0]
    for placed, (left, top, right, bottom) in zip(objects, image_boxes, strict=True):
        u, v = np.meshgrid(left + step * (right - left), top + step * (bottom - top))
        _, directions = pixel_rays(pose, np.stack([u, v], -1).reshape(-1, 2))
        distance, *_ = trace(placed, np.broadcast_to(eye, directions.shape), directions)
        rays.append(directions[np.isfinite(distance)])
        own_distances.append(distance[np.isfinite(distance)])
    if not rays:
        return []
    directions = np.concatenate(rays)
    distance = np.concatenate(own_distances)
    first = snapshot.cast(
        np.broadcast_to(eye, directions.shape), directions, eye
    ).distance
    unblocked = first > distance - 0.05
    ends = np.cumsum([len(r) for r in rays])[:-1]
    return [
        float(part.mean()) if len(part) else 0.0 for part in np.split(unblocked, ends)
    ]
