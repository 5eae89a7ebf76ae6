"""PandaSet's poses, times and camera parameters (JSON files), and where its sensors stand on the
vehicle."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import name_errors, read_text
from lidar_synth.files.parsing import parse_json
from lidar_synth.geometry.motion import pose_of

Matrix = NDArray[np.float64]

FORWARD = "pandar_gt"
"""Name of the sensor that is read from the rows with d = 1; every other sensor is read from those
with d = 0."""


def _mounts() -> dict[str, Matrix]:
    """{sensor: (4, 4) from the sensor's frame to the frame of the poses (x right, y forward, z
    up)}.

    Pandar64: fitted on frame 002/00, where the vehicle stands, such that elevations lie on the
    beams: at (0.001, 0.7752, 1.8589) m, Rx(-0.0157) Ry(0.0005) rad from the poses' frame. PandarGT:
    parallel to the Pandar64, 0.562 m ahead of it and 0.282 m below, fitted on 002/00 and 002/40
    such that its lines of points stay straight where the range jumps (by PandaSet's own calibration
    0.606 m and 0.302 m).
    """
    about_x = -0.0157
    about_y = 0.0005
    tilt = np.array(
        [
            (1, 0, 0),
            (0, np.cos(about_x), -np.sin(about_x)),
            (0, np.sin(about_x), np.cos(about_x)),
        ]
    )
    tilt = tilt @ [
        (np.cos(about_y), 0, np.sin(about_y)),
        (0, 1, 0),
        (-np.sin(about_y), 0, np.cos(about_y)),
    ]
    top = np.eye(4)
    top[:3, :3] = tilt.T @ [(0, -1, 0), (1, 0, 0), (0, 0, 1)]
    top[:3, 3] = 0.001, 0.7752, 1.8589
    ahead = np.eye(4)
    ahead[:3, 3] = 0.562, 0.0, -0.282
    return {"pandar64": top, FORWARD: top @ ahead}


MOUNTS = _mounts()


@dataclass(frozen=True)
class Track:
    """(P,) times in seconds and (P, 4, 4) poses to the world of a vehicle or a camera, one for each
    frame."""

    times: Matrix
    poses: Matrix

    def number(self, frame: str, where: Path) -> int:
        """The place of a frame, such as ``07``, in the lists.

        Raises:
            DataError: if there is none; ``where`` names the frame in the error.
        """
        if not frame.isdecimal() or int(frame) >= len(self.times):
            raise DataError(
                f"{where}: frame {frame!r}, but {len(self.times)} poses",
                "a pose for each frame",
            )
        return int(frame)


def read_track(folder: Path) -> Track:
    """The poses and times of a folder with ``poses.json`` and ``timestamps.json``.

    Raises:
        FileError: if a file cannot be read.
        DataError: on anything but as many poses as increasing times.
    """
    times, poses = (_parse(folder / name) for name in ("timestamps.json", "poses.json"))
    with name_errors(folder / "poses.json"):
        if (
            not isinstance(times, list)
            or not isinstance(poses, list)
            or not 2 <= len(times) == len(poses)
        ):
            raise DataError(
                "another number of poses than of timestamps",
                "one for each frame, two or more frames",
            )
        seconds = np.array(_numbers(times, *range(len(times))), np.float64)
        if not (np.diff(seconds) > 0).all():
            raise DataError(
                "timestamps that do not increase", "seconds, one for each frame"
            )
        return Track(seconds, np.stack([_transform(pose) for pose in poses]))


def read_intrinsics(folder: Path) -> Matrix:
    """(3, 4) projection of a camera's ``intrinsics.json``; PandaSet's images are rectified.

    Raises:
        FileError: if it cannot be read.
        DataError: if it lacks a number.
    """
    fx, fy, cx, cy = _numbers(
        _parse(folder / "intrinsics.json"), "fx", "fy", "cx", "cy"
    )
    return np.array([(fx, 0, cx, 0), (0, fy, cy, 0), (0, 0, 1, 0)], np.float64)


def _parse(path: Path) -> Any:
    return parse_json(
        read_text(path, "a file of PandaSet"), str(path), "a JSON file of PandaSet"
    )


def _numbers(values: Any, *keys: Any) -> list[float]:
    """The finite numbers under some keys of a JSON object or list."""
    with parsing(f"no numbers {keys[:4]}", "metres, unit quaternions, seconds, pixels"):
        found = [values[key] for key in keys]
        if not all(
            type(value) in (int, float) and abs(value) < 1e12 for value in found
        ):
            raise TypeError("something else than finite numbers")
    return found


def _transform(pose: Any) -> Matrix:
    """(4, 4) of a position and a quaternion."""
    if not isinstance(pose, dict):
        raise DataError(f"a pose of type {type(pose).__name__}", "position and heading")
    quaternion = np.array(_numbers(pose.get("heading"), "w", "x", "y", "z"), np.float64)
    if abs(np.linalg.norm(quaternion) - 1) > 0.01:
        raise DataError(
            f"a heading of length {np.linalg.norm(quaternion):g}", "a unit quaternion"
        )
    return pose_of([*_numbers(pose.get("position"), "x", "y", "z"), *quaternion])
