"""PCD and PLY files, read and written by open3d's tensor I/O. Lossless for a scan's points and fields.

Reflectance stands in the field ``intensity``, which other tools know, and every other field of a scan under its own
name. PLY has no unsigned 32-bit type in open3d, so ``raw_label`` is stored as the same bits, signed.
"""

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, FileError, LibraryError
from lidar_synth.files import SKIP_HINT, read_file, write_file
from lidar_synth.geometry.scan import Scan

STORED = {"label": "u1", "raw_label": "i4", "instance": "i4", "ring": "i4", "confidence": "f4"}
"""Type on disk of each field of a scan beside reflectance."""

HEADER_END = {".pcd": re.compile(rb"^DATA .*\n", re.M), ".ply": re.compile(rb"^end_header\r?\n", re.M)}

PLY_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip

IN_MEMORY = {"label": "u1", "raw_label": "u4", "instance": "i4", "ring": "i2", "confidence": "f4"}


def import_open3d() -> ModuleType:
    """The library open3d.

    Raises:
        LibraryError: where it or a system library behind it is missing.
    """
    try:
        import open3d  # type: ignore[import-untyped,unused-ignore]
    except (ImportError, OSError) as error:
        raise LibraryError(
            f"open3d cannot be imported ({error})",
            "open3d and its system libraries, for .pcd and .ply files",
            "Type: apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1 libudev1",
        ) from error
    return open3d  # type: ignore[no-any-return,unused-ignore]


def write_cloud(path: Path, scan: Scan) -> None:
    """A scan as binary ``.pcd`` or ``.ply``, by the path's suffix; ``read_cloud`` is the inverse.

    Raises:
        LibraryError: without open3d.
        FileError: where it cannot be written.
    """
    open3d = import_open3d()
    tensor = open3d.core.Tensor
    cloud = open3d.t.geometry.PointCloud()
    cloud.point["positions"] = tensor(np.ascontiguousarray(scan.points))
    cloud.point["intensity"] = tensor(np.ascontiguousarray(scan.reflectance)[:, None])
    for name, values in scan.fields().items():
        if name in STORED:
            cloud.point[name] = tensor(values.astype(STORED[name])[:, None])
    # open3d tells the format by the suffix and writes in place, so it writes elsewhere first.
    with TemporaryDirectory() as folder:
        part = Path(folder) / f"scan{path.suffix}"
        try:
            open3d.t.io.write_point_cloud(str(part), cloud)
            _check_whole(part)  # open3d says that all is well on a full disk too
        except (RuntimeError, DataError, FileError) as error:
            room = f"room for temporary files in {Path(folder).parent}"
            raise FileError(f"{path} cannot be written by open3d ({error})", room) from error
        write_file(path, part.read_bytes())


def read_cloud(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a ``.pcd`` or ``.ply``, as a ``Scan`` names them.

    Returns:
        ``points`` (N, 3) float32; ``reflectance`` (N,) from ``intensity`` or ``reflectance``, 0 where the file has
        neither; and the other fields of a scan that the file has as ``write_cloud`` writes them (a field ``label`` of
        another type is another program's, with classes of its own).

    Raises:
        LibraryError: without open3d.
        FileError: where it cannot be read.
        DataError: where it is cut, or open3d finds no points in it.
    """
    open3d = import_open3d()
    _check_whole(path)
    try:
        cloud = open3d.t.io.read_point_cloud(str(path))
    except RuntimeError as error:
        raise DataError(f"{path}: open3d cannot read it ({error})", "a PCD or PLY file") from error
    found = {name: cloud.point[name].numpy() for name in cloud.point}
    if not len(found.get("positions", ())):
        raise DataError(f"{path} holds no points that open3d can read", "a PCD or PLY file with x, y, z")
    intensity = found.get("intensity", found.get("reflectance", np.zeros(len(found["positions"]))))
    arrays = {"points": found["positions"].astype("f4"), "reflectance": intensity.reshape(-1).astype("f4")}
    ours = [name for name, kind in STORED.items() if name in found and found[name].dtype == np.dtype(kind)]
    return arrays | {name: found[name].reshape(-1).astype(IN_MEMORY[name]) for name in ours}


def _check_whole(path: Path) -> None:
    """Refuse a file that holds less than its header says: open3d gives such points whatever was in memory.

    Raises:
        FileError: where it cannot be read.
        DataError: where it is cut, or has no header.
    """
    content = read_file(path)
    found = HEADER_END[path.suffix.lower()].search(content)
    if found is None:
        raise DataError(f"{path} has no header of a {path.suffix} file", "a PCD or PLY file", SKIP_HINT)
    rows = [line.split() for line in content[: found.end()].decode(errors="replace").splitlines() if line.strip()]
    body = content[found.end() :]
    try:
        count, width, kind = (_pcd_size if path.suffix.lower() == ".pcd" else _ply_size)(rows)
        if kind == "binary_compressed":
            count, width = 1, 8 + int.from_bytes(body[:4], "little")
        held = len(body.splitlines()) if kind == "ascii" else len(body) // width
    except (KeyError, ValueError, IndexError, ZeroDivisionError) as error:
        raise DataError(f"{path}: its header cannot be read ({error!r})", "a PCD or PLY file", SKIP_HINT) from error
    if held < count:
        raise DataError(f"{path} has been cut: it is {len(content)} bytes long", "all points of its header", SKIP_HINT)


def _pcd_size(rows: list[list[str]]) -> tuple[int, int, str]:
    """Points, bytes per point and encoding of a PCD's header (https://pointclouds.org/documentation)."""
    header = {row[0]: row[1:] for row in rows}
    counts = header.get("COUNT", ["1"] * len(header["SIZE"]))
    width = sum(int(size) * int(count) for size, count in zip(header["SIZE"], counts, strict=True))
    return int(header["POINTS"][0]), width, header["DATA"][0]


def _ply_size(rows: list[list[str]]) -> tuple[int, int, str]:
    """The same of a PLY's (http://paulbourke.net/dataformats/ply), up to the end of its vertices."""
    encoding = next(row[1] for row in rows if row[0] == "format")
    [start] = [i for i, row in enumerate(rows) if row[:2] == ["element", "vertex"]]
    width = 0
    for row in rows[start + 1 :]:
        if row[0] == "element":
            break
        width += PLY_BYTES[row[1]] if row[0] == "property" else 0
    return int(rows[start][2]), width, encoding
