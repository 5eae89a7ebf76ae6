"""Poses between poses, and points in their frames."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from lidar_synth.errors import DataError
from lidar_synth.geometry.motion import FARTHEST, from_world, interpolate_poses


def some_poses(
    count: int = 6, seed: int = 0, angle: float = 0.3
) -> tuple[np.ndarray, np.ndarray]:
    """(P,) times at uneven distances and (P, 4, 4) poses that turn about any axis."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(size=(count, 3)) * angle)
    poses = np.tile(np.eye(4), (count, 1, 1))
    rotation = Rotation.identity()
    for pose, turn in zip(poses, turns, strict=True):
        rotation = rotation * turn
        pose[:3, :3] = rotation.as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(0)
    return 1e9 + np.cumsum(rng.uniform(0.05, 0.2, count)), poses


def test_poses_between_are_those_of_scipy() -> None:
    times, poses = some_poses()
    at = np.random.default_rng(1).uniform(times[0], times[-1], 500)
    found = interpolate_poses(times, poses, at)
    expected = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    # The times have seven digits after the point.
    assert np.abs(found[:, :3, :3] - expected).max() < 1e-6
    for axis in range(3):
        assert np.allclose(
            found[:, axis, 3], np.interp(at, times, poses[:, axis, 3]), atol=1e-9
        )
    assert (found[:, 3] == (0, 0, 0, 1)).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.5])
def test_given_poses_are_kept(angle: float) -> None:
    times, poses = some_poses(angle=angle)
    assert np.abs(interpolate_poses(times, poses, times) - poses).max() < 1e-9


def test_motion_continues_before_and_after() -> None:
    times, poses = some_poses(2)
    step = times[1] - times[0]
    turn = poses[0, :3, :3].T @ poses[1, :3, :3]
    before, after = interpolate_poses(
        times, poses, np.array([times[0] - step, times[1] + step])
    )
    assert np.allclose(before[:3, :3], poses[0, :3, :3] @ turn.T, atol=1e-6)
    assert np.allclose(after[:3, :3], poses[1, :3, :3] @ turn, atol=1e-6)
    assert np.allclose(after[:3, 3], 2 * poses[1, :3, 3] - poses[0, :3, 3], atol=1e-6)


def test_points_are_in_the_frame_of_their_pose() -> None:
    _, poses = some_poses(400)
    local = np.random.default_rng(2).normal(size=(400, 3)) * 30
    world = np.array(
        [
            pose[:3, :3] @ point + pose[:3, 3]
            for pose, point in zip(poses, local, strict=True)
        ]
    )
    assert np.allclose(from_world(world, poses), local)
    assert np.allclose(
        from_world(world, poses[7]),
        (np.linalg.inv(poses[7]) @ np.c_[world, np.ones(400)].T).T[:, :3],
    )


def test_what_cannot_be_interpolated_is_refused() -> None:
    times, poses = some_poses()
    for given in (
        (times[:1], poses[:1]),
        (times, poses[:-1]),
        (times[::-1], poses),
        (times[[0, 0, 1, 2, 3, 4]], poses),
    ):
        with pytest.raises(DataError, match="two or more poses with increasing times"):
            interpolate_poses(*given, times)
    for time in (times[0] - FARTHEST - 0.1, times[-1] + FARTHEST + 0.1, np.nan):
        with pytest.raises(
            DataError, match=r"s after the first pose; expected -1 s to [\d.]+ s"
        ):
            interpolate_poses(times, poses, np.array([time]))
    half = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
    with pytest.raises(DataError, match="turn by half a circle"):
        interpolate_poses(np.array([0.0, 1.0]), half, np.array([0.5]))
    assert interpolate_poses(times, poses, np.zeros(0)).shape == (0, 4, 4)
