"""KITTI-360's calibration (camera 0 and IMU relative to the velodyne) and poses.

Files (https://www.cvlibs.net/datasets/kitti-360/documentation.php)::

    calibration/perspective.txt         P_rect_00, R_rect_00, S_rect_00, and _01 of camera 1
    calibration/calib_cam_to_velo.txt   12 numbers: camera 0, unrectified, to velodyne
    calibration/calib_cam_to_pose.txt   image_00: camera 0, unrectified, to IMU; image_01 .. 03
    data_poses/DRIVE/poses.txt          a frame and 12 numbers per line: IMU to world
    data_poses/DRIVE/cam0_to_world.txt  a frame and 16 numbers per line: rectified camera 0 to world
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import (
    numbers,
    read_matrix,
    read_named_matrices,
    read_text,
    write_file,
    write_named_matrices,
)
from lidar_synth.formats.calibration import (
    Calibration,
    check_rigid,
    homogeneous,
    ideal_camera,
    read_image_size,
)
from lidar_synth.geometry.arrays import Float64Array

CAMERA = ideal_camera(552.554261, (1408, 376))
"""The camera that is written if none is known: image_00's size and focal length, at the sensor."""

IMU_FROM_SENSOR = np.diag([1.0, -1.0, -1.0, 1.0])
"""The IMU has x forward, y right, z down; without calibration it is assumed to be at the sensor."""

STILL = 0.5
"""Maximum distance, metres, that the car moved between two poses for the frames between them to get
poses, too."""

SIZES = {
    "P_rect_00": 12,
    "R_rect_00": 9,
    "S_rect_00": 2,
    "image_00": 12,
    "cam_to_velo": 12,
}
"""Number of values of each matrix of the calibration that is required."""


def read_calibration(root: Path) -> Calibration | None:
    """Camera 0, rectified; None if the files of ``calibration`` are missing.

    Raises:
        DataError: if a file does not hold the required matrices.
    """
    folder = root / "calibration"
    paths = [
        folder / name
        for name in (
            "perspective.txt",
            "calib_cam_to_velo.txt",
            "calib_cam_to_pose.txt",
        )
    ]
    if not all(path.is_file() for path in paths):
        return None
    matrices = read_named_matrices(paths[0]) | read_named_matrices(paths[2])
    matrices["cam_to_velo"] = read_matrix(paths[1], 12).reshape(-1)
    with parsing(folder, "P_rect_00, R_rect_00, S_rect_00, image_00 and 12 numbers"):
        sizes = {name: matrices[name].size for name in SIZES}
        if sizes != SIZES:
            raise ValueError(f"{sizes} values, not {SIZES}")
        for name in ("image_00", "cam_to_velo"):
            check_rigid(homogeneous(matrices[name]), name)
        camera_from_sensor = homogeneous(matrices["R_rect_00"]) @ np.linalg.inv(
            homogeneous(matrices["cam_to_velo"])
        )
        size = read_image_size(matrices["S_rect_00"], "S_rect_00")
        return Calibration(
            matrices["P_rect_00"].reshape(3, 4), camera_from_sensor, size, matrices
        )


def write_calibration(root: Path, camera: Calibration) -> None:
    """The inverse of ``read_calibration``: KITTI-360's own matrices unchanged; other cameras as
    unrectified.

    The dataset's own tools require all of its cameras: those that are not known are camera 0.
    """
    own = camera.matrices
    if not SIZES.keys() <= own.keys():
        own = {
            "S_rect_00": np.array(camera.image_size or CAMERA.image_size, np.float64),
            "R_rect_00": np.eye(3),
            "P_rect_00": camera.projection,
            "image_00": (IMU_FROM_SENSOR @ camera.sensor_from_camera)[:3],
            "cam_to_velo": camera.sensor_from_camera[:3],
        }
    names = [f"{kind}_rect_0{k}" for k in range(2) for kind in "SRP"]
    names += [f"image_0{k}" for k in range(4)]
    matrices = {name: own[f"{name[:-1]}0"] for name in names} | dict(own)
    folder = root / "calibration"
    write_file(
        folder / "calib_cam_to_velo.txt",
        f"{numbers(matrices.pop('cam_to_velo').ravel())}\n".encode(),
    )
    mounts = {n: matrices.pop(n) for n in list(matrices) if n.startswith("image_")}
    write_named_matrices(folder / "calib_cam_to_pose.txt", mounts)
    # Last, because its presence marks the calibration as complete.
    write_named_matrices(folder / "perspective.txt", matrices)


def imu_from_sensor(camera: Calibration | None) -> Float64Array:
    """(4, 4) from the velodyne to the IMU, whose poses ``poses.txt`` holds."""
    if camera is None or not {"image_00", "cam_to_velo"} <= set(camera.matrices):
        return IMU_FROM_SENSOR
    cam_to_velo = homogeneous(camera.matrices["cam_to_velo"])
    return homogeneous(camera.matrices["image_00"]) @ np.linalg.inv(cam_to_velo)


def read_poses(
    root: Path, drive: str, camera: Calibration | None
) -> dict[int, Float64Array]:
    """{frame: (4, 4) velodyne to world}; empty without ``poses.txt`` or calibration. Not every
    frame has a pose.

    Raises:
        DataError: on a line without 13 numbers, an invalid or repeated frame number, or a pose that
            is not rigid.
    """
    path = root / "data_poses" / drive / "poses.txt"
    if camera is None or not path.is_file():
        return {}
    lines = read_matrix(path, 13)
    matrices = np.tile(np.eye(4), (len(lines), 1, 1))
    matrices[:, :3] = lines[:, 1:].reshape(-1, 3, 4)
    frames = lines[:, 0]
    valid = (frames >= 0) & (frames < 1e10) & (frames == np.rint(frames))
    if not valid.all() or len(np.unique(frames)) < len(frames):
        raise DataError(
            f"{path} has invalid or repeated frame numbers",
            "each frame once, integers from 0 on",
        )
    check_rigid(matrices, str(path))
    return dict(
        zip(
            frames.astype(int).tolist(), matrices @ imu_from_sensor(camera), strict=True
        )
    )


def write_poses(root: Path, drive: str, poses: dict[int, Float64Array]) -> None:
    """The inverse of ``read_poses``, with the calibration in ``root``; poses of other frames in the
    files stay.

    ``cam0_to_world.txt``, which the dataset also has, is written beside ``poses.txt``.
    """
    camera = read_calibration(root)
    if not poses or camera is None:
        return
    folder = root / "data_poses" / drive
    for name, mount, rows in (
        ("poses.txt", np.linalg.inv(imu_from_sensor(camera)), 3),
        ("cam0_to_world.txt", camera.sensor_from_camera, 4),
    ):
        lines = {f: numbers((p @ mount)[:rows].ravel()) for f, p in poses.items()}
        _add_lines(folder / name, lines)


def _add_lines(path: Path, lines: dict[int, str]) -> None:
    """Write lines by frame; those of other frames stay as they are, since reading a pose rounds
    it."""
    there = read_text(path).splitlines() if path.is_file() else []
    kept = {
        int(float(frame)): values
        for frame, _, values in (line.partition(" ") for line in there if line)
    }
    text = [f"{frame} {values}\n" for frame, values in sorted((kept | lines).items())]
    write_file(path, "".join(text).encode())


def fill_poses(
    poses: dict[int, Float64Array], frames: Iterable[int]
) -> dict[int, Float64Array]:
    """Poses of further frames, between two known poses that are at most ``STILL`` apart.

    The dataset leaves out frames in which the car hardly moved.

    Args:
        poses: {frame: (4, 4)} sensor to world.
        frames: the frames that need a pose.

    Returns:
        The poses of those of ``frames`` that have one or can be filled.
    """
    known = np.array(sorted(poses), np.int64)
    filled = {}
    for frame in frames:
        if frame in poses:
            filled[frame] = poses[frame]
            continue
        after = int(np.searchsorted(known, frame))
        if not 0 < after < len(known):
            continue
        first = int(known[after - 1])
        last = int(known[after])
        start = poses[first][:3, 3]
        end = poses[last][:3, 3]
        if np.linalg.norm(end - start) <= STILL:
            share = (frame - first) / (last - first)
            filled[frame] = poses[first if share < 0.5 else last].copy()
            filled[frame][:3, 3] = (1 - share) * start + share * end
    return filled
