"""KITTI-360's accumulated, labelled clouds: one pair of PLY files per window, in the world frame.

Layout (https://www.cvlibs.net/datasets/kitti-360/documentation.php, "3D Data Format")::

    data_3d_semantics/train/DRIVE/static/FFFFFFFFFF_LLLLLLLLLL.ply    what stands still
    data_3d_semantics/train/DRIVE/dynamic/FFFFFFFFFF_LLLLLLLLLL.ply   what moves; may have no points

A window covers the frames FFFFFFFFFF to LLLLLLLLLL, about 200 m of road, and overlaps its
neighbours by about 10 m. Early releases have no folder ``train``. Each point has ``float x, y, z``,
``uchar red, green, blue``, ``int semantic`` (the id of the label images), ``int instance``
(semantic * 1000 + number; number 0 = none), ``uchar visible`` (1 if a camera saw it), in dynamic
files ``int timestamp`` (the frame in which it was measured, which may lie after the window), and
``float confidence`` of the label in [0, 1]. Neighbouring points are at least about 2 cm apart, and
every point was measured from at most 30 m.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import KITTI360 as CLASSES, MAX_INSTANCES
from lidar_synth.errors import DataError
from lidar_synth.files.disk import list_files, write_file
from lidar_synth.formats.ply import map_vertices, vertex_header

SPACING = 0.02
"""Spacing of the points of a window, metres."""

REACH = 30.0
"""Maximum distance from which a point of a window was measured, metres."""

PROPERTIES = {
    "x": "<f4",
    "y": "<f4",
    "z": "<f4",
    "red": "u1",
    "green": "u1",
    "blue": "u1",
    "semantic": "<i4",
    "instance": "<i4",
    "visible": "u1",
    "timestamp": "<i4",
    "confidence": "<f4",
}
"""{property: type} of the points; files of static points have no ``timestamp``."""

READ = ("x", "y", "z", "semantic", "instance", "confidence")


@dataclass(frozen=True)
class Window:
    """The clouds of one window of a drive.

    Args:
        first, last: its frames, both included.
        static, dynamic: the files; ``dynamic`` is None if the drive has no file of that name.
    """

    first: int
    last: int
    static: Path
    dynamic: Path | None

    @property
    def name(self) -> str:
        """The name of its files, without suffix."""
        return self.static.stem


def find_windows(root: Path, drive: str) -> list[Window]:
    """The windows of a drive, in order; empty if it has none.

    Raises:
        DataError: on a file that is not named by its first and its last frame.
    """
    folders = (root / "data_3d_semantics" / part / drive for part in ("train", "."))
    folder = next((f for f in folders if (f / "static").is_dir()), None)
    windows = []
    for path in list_files(folder / "static", ".ply") if folder is not None else []:
        match = re.fullmatch(r"([0-9]{1,10})_([0-9]{1,10})", path.stem)
        if not match or int(match[1]) > int(match[2]):
            raise DataError(
                f"{path} is no window of KITTI-360",
                "first and last frame: 0000000002_0000000385.ply",
            )
        moving = path.parents[1] / "dynamic" / path.name
        windows.append(
            Window(
                int(match[1]), int(match[2]), path, moving if moving.is_file() else None
            )
        )
    return sorted(windows, key=lambda w: (w.first, w.last))


def read_cloud(path: Path) -> NDArray[np.void]:
    """The points of a window's file, mapped into memory: (N,) records with the properties of
    ``PROPERTIES``.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is no binary PLY file, is truncated, or lacks a property.
    """
    wanted = READ if path.parent.name == "static" else (*READ, "timestamp")
    points = map_vertices(path)
    if missing := [name for name in wanted if name not in (points.dtype.names or ())]:
        raise DataError(
            f"{path} has no {', '.join(missing)}",
            "the properties of KITTI-360's clouds for training",
            "The clouds of its test set have no labels.",
        )
    return points


def cloud_values(
    points: NDArray[np.void], where: str = "the cloud"
) -> NDArray[np.uint32]:
    """(N,) the values of a label file for points of a cloud: the class, and above it the instance,
    0 = none.

    Raises:
        DataError: on a class that KITTI-360 does not define, or an instance that a label file
            cannot hold.
    """
    semantic = points["semantic"]
    instance = points["instance"]
    CLASSES.decode(
        np.flatnonzero(np.bincount(np.clip(semantic, -1, 1 << 15) + 1)) - 1, where
    )
    if len(instance) and not 0 <= instance.min() <= instance.max() <= 0xFFFF:
        raise DataError(
            f"{where} has instances from {instance.min()} to {instance.max()}",
            "0..65535",
        )
    numbered = np.where(instance % MAX_INSTANCES > 0, instance, 0)
    return semantic.astype(np.uint32) | numbered.astype(np.uint32) << np.uint32(16)


def write_cloud(path: Path, values: Mapping[str, NDArray[Any]]) -> None:
    """Write the points of a window; the inverse of ``read_cloud``.

    Args:
        path: the file.
        values: {property: (N,)}; those of ``PROPERTIES`` that are absent are 0, except that
            ``timestamp`` is left out.

    Raises:
        FileError: if it cannot be written.
    """
    kept = [
        (n, kind) for n, kind in PROPERTIES.items() if n != "timestamp" or n in values
    ]
    records = np.zeros(len(values["x"]), kept)
    for name, array in values.items():
        records[name] = array
    write_file(path, vertex_header(records) + records.tobytes())
