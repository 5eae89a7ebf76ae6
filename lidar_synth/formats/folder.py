"""A plain folder of scans, one file each: ``.bin``, ``.npy``, ``.npz``, ``.pcd`` or ``.ply``; or one such file.

- ``.bin``: float32 x, y, z, reflectance per point, as KITTI's; beside it ``NAME.label`` with SemanticKITTI's labels.
- ``.npy``: the same as an array (N, 4), or with more columns, of which the first four count.
- ``.npz``: the package's own, see npz.py.
- ``.pcd``, ``.ply``: see pcd.py and ply.py.

Files in subfolders belong to it; a scan's id is its path there without the suffix.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.npz import check_numbers, decode_scan, told_sensor, write_scan
from lidar_synth.formats.pcd import read_pcd, write_pcd
from lidar_synth.formats.ply import read_ply, write_ply
from lidar_synth.formats.point_labels import encode_labels, read_labels, write_labels
from lidar_synth.formats.points import check_scan, read_points, write_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import FileWriter, Picture
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.parsing import read_arrays

SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")


class Folder(ScanFiles):
    """A folder of .bin, .npy, .npz, .pcd or .ply files, one kind only, or one such file.

    Args:
        root: the folder or the file.
        sensor: which sensor took the scans; an ``.npz`` tells its own.
        fields: floats per point of ``.bin`` files.
        reflectance_max: the upper end of the reflectance in the files; it is divided by it.
        on_bad: see ``ScanFiles``.

    Raises:
        FileError: where there is no such path.
        ConfigError: where files of several kinds are there.
        DataError: where there is none.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        fields: int = 4,
        reflectance_max: float = 1.0,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        self._base, paths = scan_paths(root, SUFFIXES)
        ids = [path.relative_to(self._base).with_suffix("").as_posix() for path in paths]
        self._suffix = paths[0].suffix
        told = told_sensor(paths[0]) if sensor is None and self._suffix == ".npz" else None
        super().__init__(root, ids, sensor or told or "hdl64e_kitti", on_bad)
        self._given = None if sensor is None else load_sensor(sensor)
        self._fields, self._reflectance_max = fields, reflectance_max

    def read(self, index: int) -> Scan:
        name = self.ids[index]
        scan = self._decode(self._base / f"{name}{self._suffix}")
        scan.id = name
        return scan

    def _decode(self, path: Path) -> Scan:
        if path.suffix == ".bin":
            points = read_points(path, self._fields, self._reflectance_max)
            beside = path.with_suffix(".label")
            labels = read_labels(beside, path, len(points), SEMANTIC_KITTI) if beside.is_file() else {}
            scan = Scan(points[:, :3], points[:, 3], self.sensor, **labels)
        elif path.suffix == ".npz":
            scan = decode_scan(read_arrays(path), str(path), self._given)
            check_scan(scan, str(path))
            return scan
        else:
            arrays: dict[str, Any] = ARRAYS[path.suffix](path)
            scan = Scan(sensor=self.sensor, **arrays)
            check_scan(scan, str(path), self._reflectance_max)
        if self._reflectance_max != 1:
            scan.reflectance = scan.reflectance / np.float32(self._reflectance_max)
        return scan


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    array = read_arrays(path)["array"]
    if array.ndim != 2 or array.shape[1] < 4:
        raise DataError(f"{path} holds an array of shape {array.shape}", "(N, 4): x, y, z, reflectance")
    check_numbers(array, str(path))
    with np.errstate(over="ignore"):
        array = array.astype(np.float32, copy=False)
    return {"points": array[:, :3], "reflectance": array[:, 3]}


ARRAYS: dict[str, Callable[[Path], dict[str, NDArray[Any]]]] = {".npy": _columns, ".pcd": read_pcd, ".ply": read_ply}
"""Readers of a scan's arrays by suffix."""


def scan_paths(root: Path, suffixes: tuple[str, ...]) -> tuple[Path, list[Path]]:
    """The folder that names are relative to, and the scans' paths in order.

    Raises:
        FileError: where there is no such path.
        ConfigError: where files of several kinds are there, or a file of none.
        DataError: where there is none.
    """
    if root.is_file():
        if root.suffix not in suffixes:
            raise ConfigError(f"{root} is no scan", f"a file with one of {', '.join(suffixes)}")
        return root.parent, [root]
    if not root.is_dir():
        raise FileError(f"{root} does not exist", "a file or a folder with scans")
    found = (path for path in root.rglob("*") if path.suffix in suffixes)
    paths = sorted(p for p in found if not any(part[0] == "." for part in p.relative_to(root).parts))
    kinds = sorted({path.suffix for path in paths})
    if len(kinds) > 1:
        raise ConfigError(f"{root} holds {' and '.join(kinds)} files", "one kind", "Give the folder of one of them.")
    if not paths:
        raise DataError(f"{root} holds no scan", f"files with one of {', '.join(suffixes)}")
    return root, paths


class KITTIWriter(FileWriter):
    """Writes ``NAME.bin`` as KITTI's and ``NAME.label`` as SemanticKITTI's beside it, always: a scan or a class without
    a label is 0 there."""

    suffix = ".bin"

    def _put(self, scan: Scan, path: Path, picture: Picture | None, camera: Calibration | None) -> None:
        write_labels(path.with_suffix(".label"), encode_labels(scan, SEMANTIC_KITTI))
        write_points(path, scan)


class NPZWriter(FileWriter):
    """Writes the package's own ``NAME.npz``, with all that is known of the scan but its image."""

    suffix = ".npz"

    def _put(self, scan: Scan, path: Path, picture: Picture | None, camera: Calibration | None) -> None:
        write_scan(path, scan)


class PCDWriter(FileWriter):
    """Writes ``NAME.pcd`` with the scan's points and fields; boxes and pose have no place there."""

    suffix = ".pcd"

    def _put(self, scan: Scan, path: Path, picture: Picture | None, camera: Calibration | None) -> None:
        write_pcd(path, scan)


class PLYWriter(FileWriter):
    """Writes ``NAME.ply`` with the scan's points and fields; boxes and pose have no place there."""

    suffix = ".ply"

    def _put(self, scan: Scan, path: Path, picture: Picture | None, camera: Calibration | None) -> None:
        write_ply(path, scan)
