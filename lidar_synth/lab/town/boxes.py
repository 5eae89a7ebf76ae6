"""3-D boxes of the objects of a scan, with their image box, truncation and occlusion in the camera
image.

A box is the bounding box of the object's own mesh, so it contains the returns of its instance.
Range noise and the tilt of the ground can move a few returns outside: a box has a yaw, but no pitch
or roll.
"""

import numpy as np

from lidar_synth.geometry import Boxes
from lidar_synth.geometry.arrays import Float32Array, Float64Array
from lidar_synth.lab.town.camera import CAMERA, pixel_rays
from lidar_synth.lab.town.cast import Snapshot, trace
from lidar_synth.lab.town.scene import PlacedObject, Pose

_GRID = 12
"""Camera rays along each side of an object's image box, cast to estimate how much of the object is
hidden."""
_LEVELS = (0.80, 0.45, 0.05)
"""Visible shares below which KITTI's occlusion is 1 (partly), 2 (largely) and 3 (unknown)."""


def boxes_of(objects: list[PlacedObject], pose: Pose, snapshot: Snapshot) -> Boxes:
    """The boxes of objects in the sensor frame, with their image box, truncation and occlusion.

    Args:
        objects: the objects that have a box and at least one return.
        pose: (4, 4) sensor to world.
        snapshot: the stretch at the time of the scan.
    """
    count = len(objects)
    poses = np.array([o.pose for o in objects]).reshape(-1, 4, 4)
    in_sensor = np.linalg.inv(pose) @ poses
    rows = list(map(box_values, objects, in_sensor))
    values = np.array(rows, np.float32).reshape(-1, 7)
    image_box = np.full((count, 4), -1, np.float32)
    truncation = np.full(count, -1, np.float32)
    occlusion = np.full(count, -1, np.int8)
    # The camera's field of view is 104 degrees wide; objects well outside of it need no projection.
    ahead = abs(values[:, 1]) < 1.35 * values[:, 0] + values[:, 3] + 1
    for i in np.flatnonzero(ahead):
        image_box[i], truncation[i] = _image_box_of(objects[i], in_sensor[i])
    seen = np.flatnonzero(truncation >= 0)
    for i, visible in zip(
        seen,
        _visible_shares([objects[i] for i in seen], image_box[seen], pose, snapshot),
        strict=True,
    ):
        occlusion[i] = sum(visible < level for level in _LEVELS)
    names = tuple(o.prototype.name for o in objects)
    instance = np.array([o.instance for o in objects], np.int32)
    return Boxes(values, names, truncation, occlusion, image_box, instance=instance)


def box_values(placed: PlacedObject, in_sensor: Pose) -> Float64Array:
    """(7,) centre, size and yaw of an object's box, from its pose in the sensor frame."""
    low, high = placed.prototype.mesh.bounds
    middle = placed.scale * (low + high) / 2
    centre = in_sensor[:3, :3] @ middle + in_sensor[:3, 3]
    yaw = np.arctan2(in_sensor[1, 0], in_sensor[0, 0])
    return np.concatenate([centre, placed.scale * (high - low), [yaw]])


def _image_box_of(
    placed: PlacedObject, in_sensor: Pose
) -> tuple[Float64Array | float, float]:
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
    image_boxes: Float32Array,
    pose: Pose,
    snapshot: Snapshot,
) -> list[float]:
    """For each object, the share of the camera rays towards it that nothing in front of it
    blocks."""
    rays = []
    distances = []
    eye = pixel_rays(pose, np.zeros((1, 2)))[0]
    for placed, box in zip(objects, image_boxes, strict=True):
        directions, distance = _rays_towards(placed, box, pose)
        rays.append(directions)
        distances.append(distance)
    if not rays:
        return []
    towards = np.concatenate(rays)
    first = snapshot.cast(np.broadcast_to(eye, towards.shape), towards, eye).distance
    unblocked = first > np.concatenate(distances) - 0.05
    ends = np.cumsum([len(r) for r in rays])[:-1]
    parts = np.split(unblocked, ends)
    return [float(part.mean()) if len(part) else 0.0 for part in parts]


def _rays_towards(
    placed: PlacedObject,
    box: Float32Array,
    pose: Pose,
) -> tuple[Float32Array, Float32Array]:
    """Directions of camera rays that hit an object if nothing is in front of it, and how far it is
    along them."""
    left, top, right, bottom = box
    step = (np.arange(_GRID) + 0.5) / _GRID
    u, v = np.meshgrid(left + step * (right - left), top + step * (bottom - top))
    eye, directions = pixel_rays(pose, np.stack([u, v], -1).reshape(-1, 2))
    distance, *_ = trace(placed, np.broadcast_to(eye, directions.shape), directions)
    hit = np.isfinite(distance)
    return directions[hit], distance[hit]
