"""The motion of a sensor during a scan: poses interpolated at the times of points, and points in
the frames of poses.

A rotating sensor measures a scan over 0.1 s, in which a car drives one or two metres. With poses
before and after, each point has a pose of its own, the one at the time of its measurement.
"""

from collections.abc import Sequence

import numpy as np

from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Float64Array

FARTHEST = 1.0
"""Maximum time in seconds before the first pose or after the last one for which a pose is
extrapolated."""


def interpolate_poses(
    times: Float64Array,
    poses: Float64Array,
    at: Float64Array,
    farthest: float = FARTHEST,
) -> Float64Array:
    """The poses at other times: between two poses, velocity and angular velocity are constant.

    Before the first pose and after the last one, the motion of the nearest interval continues.

    Args:
        times: (P,) seconds, increasing.
        poses: (P, 4, 4) rigid transforms.
        at: (N,) seconds.
        farthest: maximum time before the first pose or after the last one, seconds.

    Returns:
        (N, 4, 4) float64.

    Raises:
        DataError: on times that do not increase or do not fit the poses, fewer than two poses,
            poses that turn by half a circle, or a time more than ``farthest`` outside.

    Example:
        >>> import numpy as np
        >>> from lidar_synth.geometry.motion import interpolate_poses
        >>> poses = np.tile(np.eye(4), (2, 1, 1))
        >>> poses[1, 0, 3] = 10.0
        >>> interpolate_poses(np.array([0.0, 1.0]), poses, np.array([0.25]))[0, :3, 3]
        array([2.5, 0. , 0. ])
    """
    if (
        len(times) < 2
        or poses.shape != (len(times), 4, 4)
        or not (np.diff(times) > 0).all()
    ):
        raise DataError(
            f"{len(times)} times for {len(poses)} poses",
            "two or more poses with increasing times",
        )
    if not len(at):
        return np.empty((0, 4, 4))
    if not times[0] - farthest <= at.min() <= at.max() <= times[-1] + farthest:
        raise DataError(
            f"times from {at.min() - times[0]:g} s to {at.max() - times[0]:g} s after the first "
            "pose",
            f"-{farthest:g} s to {times[-1] - times[0] + farthest:g} s: poses of the same "
            "recording",
        )
    start = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    fraction = (at - times[start]) / np.diff(times)[start]
    steps = poses[:-1, :3, :3].swapaxes(-1, -2) @ poses[1:, :3, :3]
    from scipy.spatial.transform import Rotation  # takes long to import

    turns = Rotation.from_matrix(steps).as_rotvec()
    if (np.linalg.norm(turns, axis=1) > 3).any():
        raise DataError(
            "poses that turn by half a circle from one to the next",
            "poses at least ten times a second",
        )
    turned = Rotation.from_rotvec(fraction[:, None] * turns[start])
    result = np.tile(np.eye(4), (len(at), 1, 1))
    result[:, :3, :3] = poses[start, :3, :3] @ turned.as_matrix()
    result[:, :3, 3] = (
        poses[start, :3, 3]
        + fraction[:, None] * np.diff(poses[:, :3, 3], axis=0)[start]
    )
    return result


def from_world(points: Float64Array, poses: Float64Array) -> Float64Array:
    """Points of the world in the frame of a pose each.

    Args:
        points: (N, 3) metres, in the world frame.
        poses: (N, 4, 4) from each point's frame to the world, or (4, 4) for all points.

    Returns:
        (N, 3) float64 metres.
    """
    moved = points - poses[..., :3, 3]
    return np.asarray(
        np.einsum("...ji,...j->...i", poses[..., :3, :3], moved), np.float64
    )


def to_world(points: Float64Array, poses: Float64Array) -> Float64Array:
    """The inverse of ``from_world``."""
    turned = np.einsum("...ij,...j->...i", poses[..., :3, :3], points)
    return np.asarray(turned + poses[..., :3, 3], np.float64)


def pose_of(values: Sequence[float]) -> Float64Array:
    """(4, 4) pose of a position and a quaternion: x, y, z in metres, then w, x, y, z of any
    length."""
    pose = np.eye(4)
    pose[:3, 3] = values[:3]
    scalar, *vector = np.array(values[3:]) / np.linalg.norm(values[3:])
    cross = np.cross(np.eye(3), vector)
    pose[:3, :3] += 2 * (scalar * cross + cross @ cross)
    return pose


def rotate(points: Float64Array, vectors: Float64Array) -> Float64Array:
    """(N, 3) points turned by rotation vectors (N, 3) or (3,), radians (Rodrigues' formula)."""
    # Not by scipy, whose older versions refuse empty arrays.
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = vectors / np.maximum(angle, 1e-12)
    along = np.sum(axis * points, -1, keepdims=True)
    cosine = np.cos(angle)
    return np.asarray(
        points * cosine
        + np.cross(axis, points) * np.sin(angle)
        + axis * along * (1 - cosine)
    )
