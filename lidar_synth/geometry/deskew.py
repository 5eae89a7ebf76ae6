"""Motion compensation and its inverse, by poses interpolated at the moment of each point."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.scan import Scan

EXTENSION = 1.5
"""How far a trajectory is extrapolated before its first and after its last pose, in lengths of the
nearest segment; the sweep that ends at the first pose needs one."""


class Trajectory:
    """The poses of a sensor over time: positions are interpolated linearly, rotations at constant
    speed (slerp).

    Args:
        times: (K,) seconds, increasing, K >= 2.
        poses: (K, 4, 4) of the frame in which the points are given, to the world, metres.

    Raises:
        DataError: on shapes that do not match, times that do not increase, or poses that are not
            rigid.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Trajectory
        >>> poses = np.stack([np.eye(4), np.eye(4)])
        >>> poses[1, 0, 3] = 2.0  # 2 m forward in 0.1 s
        >>> Trajectory([0.0, 0.1], poses).at(0.05)[:3, 3]
        array([1., 0., 0.])
    """

    def __init__(self, times: ArrayLike, poses: ArrayLike) -> None:
        self.times = np.asarray(times, np.float64)
        self.poses = np.asarray(poses, np.float64)
        self._check()
        rotations = self.poses[:, :3, :3]
        steps = Rotation.from_matrix(rotations[:-1].swapaxes(1, 2) @ rotations[1:])
        self._steps = steps.as_rotvec()

    def _check(self) -> None:
        count = len(self.times) if self.times.ndim == 1 else 0
        if count < 2 or self.poses.shape != (count, 4, 4):
            given = f"times of shape {self.times.shape} and poses of shape {self.poses.shape}"
            raise DataError(given, "(K,) and (K, 4, 4), K >= 2")
        if not np.isfinite(self.times).all() or not (np.diff(self.times) > 0).all():
            raise DataError(
                "times of poses that do not increase",
                "finite seconds, one after the other",
            )
        rotations = self.poses[:, :3, :3]
        squares = rotations @ rotations.swapaxes(1, 2)
        if not (
            np.isfinite(self.poses).all()
            and np.allclose(squares, np.eye(3), atol=1e-4)
            and (np.linalg.det(rotations) > 0).all()
        ):
            raise DataError(
                "poses whose upper left 3 x 3 part is not a rotation",
                "rigid poses, sensor to world",
            )

    def at(self, time: float) -> Float64Array:
        """(4, 4) the pose at one moment."""
        pose = np.eye(4)
        segment, fraction = self._segments(np.array([time]))
        pose[:3, 3] = self._positions(segment, fraction)[0]
        turned = Rotation.from_rotvec(self._steps[segment[0]] * fraction)
        pose[:3, :3] = self.poses[segment[0], :3, :3] @ turned.as_matrix()
        return pose

    def from_world(self, points: Float64Array, times: Float64Array) -> Float64Array:
        """(N, 3) points of the world in the frame that the sensor had at the time of each."""
        segment, fraction = self._segments(times)
        offset = points - self._positions(segment, fraction)
        local = np.einsum("nji,nj->ni", self.poses[segment, :3, :3], offset)
        return rotate(np.asarray(local), -fraction[:, None] * self._steps[segment])

    def to_world(self, points: Float64Array, times: Float64Array) -> Float64Array:
        """(N, 3) points in the world, from the frame that the sensor had at the time of each."""
        segment, fraction = self._segments(times)
        turned = rotate(points, fraction[:, None] * self._steps[segment])
        turned = np.einsum("nij,nj->ni", self.poses[segment, :3, :3], turned)
        return np.asarray(turned + self._positions(segment, fraction))

    def _positions(
        self, segment: NDArray[np.intp], fraction: Float64Array
    ) -> Float64Array:
        start = self.poses[segment, :3, 3]
        end = self.poses[segment + 1, :3, 3]
        return np.asarray(start + fraction[:, None] * (end - start))

    def _segments(self, times: Float64Array) -> tuple[NDArray[np.intp], Float64Array]:
        """The segment of each time (N,), and the fraction of the segment that has passed;
        ``EXTENSION`` before the first and after the last one is accepted."""
        segment = np.clip(
            np.searchsorted(self.times, times, "right") - 1, 0, len(self.times) - 2
        )
        fraction = (times - self.times[segment]) / (
            self.times[segment + 1] - self.times[segment]
        )
        if len(times) and not (
            fraction.min() >= -EXTENSION and fraction.max() <= 1 + EXTENSION
        ):
            given = f"points from {times.min():.3f} to {times.max():.3f} s"
            span = f"{self.times[0]:.3f} to {self.times[-1]:.3f} s"
            raise DataError(
                given, f"times within those of the poses, {span}", "Check `moment`."
            )
        return segment, fraction


def reskew(scan: Scan, trajectory: Trajectory, moment: float = 0.0) -> Scan:
    """Undo motion compensation: each point as the sensor measured it, in the frame of its own
    moment.

    Args:
        scan: N points with ``time``, all of them in the frame of the moment of ``scan.pose``.
        trajectory: the poses of that frame around this moment.
        moment: seconds of the trajectory at which ``scan.time`` is 0.

    Raises:
        DataError: on a scan without ``time``, or times for which there are no poses.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town, Trajectory, reskew
        >>> scan = Town(seed=0, scans=1)[0]
        >>> scan.time = np.linspace(0, 0.1, len(scan), dtype=np.float32)
        >>> poses = np.stack([np.eye(4), np.eye(4)])
        >>> poses[1, 0, 3] = 2.0
        >>> measured = reskew(scan, Trajectory([0.0, 0.1], poses))
        >>> (measured.points[-1] - scan.points[-1]).round(2)
        array([-2.,  0.,  0.], dtype=float32)
    """
    times = _times(scan, moment)
    pose = trajectory.at(moment)
    world = scan.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    return replace(scan, points=trajectory.from_world(world, times).astype(np.float32))


def deskew(scan: Scan, trajectory: Trajectory, moment: float = 0.0) -> Scan:
    """Motion compensation: all points in the frame of one moment, as if the sensor had measured
    them at once.

    The arguments and errors are those of ``reskew``, its inverse.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town, Trajectory, deskew
        >>> scan = Town(seed=0, scans=1)[0]
        >>> scan.time = np.zeros(len(scan), np.float32)
        >>> still = Trajectory([0.0, 0.1], np.stack([np.eye(4), np.eye(4)]))
        >>> bool(np.allclose(deskew(scan, still).points, scan.points))
        True
    """
    times = _times(scan, moment)
    pose = trajectory.at(moment)
    world = trajectory.to_world(scan.points.astype(np.float64), times)
    return replace(
        scan, points=((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
    )


def _times(scan: Scan, moment: float) -> Float64Array:
    if scan.time is None:
        raise DataError(
            f"scan {scan.id!r} has no time", "seconds for each point in scan.time"
        )
    return moment + scan.time.astype(np.float64)


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
