"""Motion compensation and its inverse, by poses interpolated at the moment of each point."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.motion import from_world, interpolate_poses, to_world
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
            and np.allclose(self.poses[:, 3], (0, 0, 0, 1))
            and (np.linalg.det(rotations) > 0).all()
        ):
            raise DataError(
                "poses that are not a rotation, a translation and the row 0, 0, 0, 1",
                "rigid poses, sensor to world",
            )

    def at(self, time: float) -> Float64Array:
        """(4, 4) the pose at one moment."""
        [pose] = self.poses_at(np.array([time]))
        return np.asarray(pose)

    def poses_at(self, times: Float64Array) -> Float64Array:
        """(N, 4, 4) the poses at moments (N,), seconds.

        Raises:
            DataError: on moments more than ``EXTENSION`` outside, or poses that turn by half a
                circle from one to the next.
        """
        first, last = self.times[[0, -1]]
        before, after = EXTENSION * np.diff(self.times)[[0, -1]]
        if len(times) and not (
            first - before <= times.min() <= times.max() <= last + after
        ):
            given = f"points from {times.min():.3f} to {times.max():.3f} s"
            span = f"{first:.3f} to {last:.3f} s"
            raise DataError(
                given, f"times within those of the poses, {span}", "Check `moment`."
            )
        return interpolate_poses(self.times, self.poses, times, np.inf)


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
    measured = from_world(world, trajectory.poses_at(times))
    return replace(scan, points=measured.astype(np.float32))


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
    world = to_world(scan.points.astype(np.float64), trajectory.poses_at(times))
    return replace(
        scan, points=((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
    )


def _times(scan: Scan, moment: float) -> Float64Array:
    if scan.time is None:
        raise DataError(
            f"scan {scan.id!r} has no time", "seconds for each point in scan.time"
        )
    return moment + scan.time.astype(np.float64)
