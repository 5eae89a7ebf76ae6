"""Moving objects and the sensor's own motion between the poses of KITTI-360."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lidar_synth.formats.kitti360_boxes import WorldBoxes
from lidar_synth.formats.kitti360_poses import fill_poses
from lidar_synth.lab.kitti360.accumulated import read_cloud, write_cloud
from lidar_synth.lab.kitti360.movers import Movers
from lidar_synth.lab.kitti360.recovery import undo_ego_motion


def test_undoing_the_motion_of_the_sensor_is_exact_at_the_pose_and_half_a_turn_away() -> (
    None
):
    angle = np.radians(4)
    motion = np.eye(4)
    motion[:2, :2] = [(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))]
    motion[:3, 3] = -1, 0.1, 0
    ahead = np.array([(10.0, 0, 1)])
    behind = np.array([(-10.0, 1e-9, 1)])
    assert np.allclose(undo_ego_motion(ahead, motion), ahead)
    half = np.array(
        [
            (np.cos(angle / 2), -np.sin(angle / 2), 0),
            (np.sin(angle / 2), np.cos(angle / 2), 0),
            (0, 0, 1),
        ]
    )
    assert np.allclose(
        undo_ego_motion(behind, motion), behind @ half.T + motion[:3, 3] / 2
    )
    assert np.array_equal(undo_ego_motion(behind, np.eye(4)), behind)


def test_poses_are_filled_only_where_the_car_stood() -> None:
    poses = {f: np.eye(4) for f in (0, 10, 20)}
    poses[10][0, 3] = 0.4
    poses[20][0, 3] = 12.0
    filled = fill_poses(poses, range(-1, 22))
    assert set(filled) == {*range(11), 20}
    assert filled[5][0, 3] == pytest.approx(0.2)


def _moving_box(
    frames: range, speed: float, instance: int = 26001, start: float = 0.0
) -> WorldBoxes:
    transforms = np.tile(np.diag([4.0, 2.0, 1.5, 1.0]), (len(frames), 1, 1))
    transforms[:, 0, 3] = start + speed * np.array(frames)
    windows = np.repeat(np.array(frames)[:, None], 2, axis=1)
    return WorldBoxes(
        transforms,
        np.array(["Car"] * len(frames)),
        np.full(len(frames), instance, np.int32),
        windows,
        windows,
    )


def _dynamic(
    points: list[tuple[float, float, float, int]], path: Path
) -> NDArray[np.void]:
    x, y, z, frame = np.array(points).T
    values = {
        "x": x,
        "y": y,
        "z": z,
        "timestamp": frame,
        "semantic": np.full(len(x), 26),
    }
    write_cloud(
        path,
        values | {"instance": np.full(len(x), 26001), "confidence": np.ones(len(x))},
    )
    return read_cloud(path)


def test_points_of_a_moving_object_follow_its_box(tmp_path: Path) -> None:
    cloud = _dynamic(
        [(0.5, 0, 0, 0), (4.5, 0.9, 0, 2), (50, 0, 0, 3)],
        tmp_path / "dynamic" / "a.ply",
    )
    movers = Movers([cloud], _moving_box(range(5), 2.0), range(5))
    points, values = movers.at(1)  # no point was measured in this frame
    assert np.allclose(sorted(points.tolist()), [(2.5, 0, 0), (2.5, 0.9, 0)], atol=1e-5)
    assert set(values.tolist()) == {26 | 26001 << 16}
    # The point in no box, only in its own frame.
    assert len(movers.at(3)[0]) == 3 and len(movers.at(9)[0]) == 0


def test_a_box_that_stands_still_is_no_moving_object_unless_it_has_moving_points(
    tmp_path: Path,
) -> None:
    still = _moving_box(range(5), 0.0)
    assert not Movers([], still, range(5)).tracks
    cloud = _dynamic([(0.5, 0, 0, 0)], tmp_path / "dynamic" / "a.ply")
    assert len(Movers([cloud], still, range(5)).tracks) == 1


def test_an_instance_number_that_is_used_again_is_another_object() -> None:
    one = _moving_box(range(5), 2.0)
    other = _moving_box(range(5, 9), 2.0, start=1000.0)
    both = WorldBoxes(
        *(np.concatenate([getattr(one, n), getattr(other, n)]) for n in vars(one))
    )
    assert len(Movers([], both, range(9)).tracks) == 2


def test_points_of_a_turning_object_follow_its_box(tmp_path: Path) -> None:
    boxes = _moving_box(range(2), 0.0)
    turn = np.array([(0, -1, 0), (1, 0, 0), (0, 0, 1)])
    boxes.transforms[1, :3, :3] = turn @ boxes.transforms[1, :3, :3]
    boxes.transforms[1, :3, 3] = 10, 0, 0
    for given, frame, expected in (
        ((1, 0.5, 0, 0), 1, (9.5, 1, 0)),
        ((9.5, 1, 0, 1), 0, (1, 0.5, 0)),
    ):
        cloud = _dynamic([given], tmp_path / str(frame) / "dynamic" / "a.ply")
        [point] = Movers([cloud], boxes, range(2)).at(frame)[0]
        assert point == pytest.approx(expected, abs=1e-5)


def test_an_object_that_is_seen_rarely_stays_one_object() -> None:
    """As fast as 10 m a frame, with a box in every third frame."""
    assert len(Movers([], _moving_box(range(0, 9, 3), 10.0), range(9)).tracks) == 1
