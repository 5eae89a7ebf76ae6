"""A plain folder of scans, one file each: ``.bin``, ``.npy``, ``.npz``, ``.pcd`` or ``.ply``; or
one such file.

- ``.bin``: float32 x, y, z, reflectance per point, as in KITTI; optional ``NAME.label`` with
  SemanticKITTI's labels.
- ``.npy``: the same as an array (N, 4); further columns are ignored.
- ``.npz``: the package's own format, see npz.py.
- ``.pcd``, ``.ply``: see pcd.py and ply.py; optional ``NAME.boxes.json`` with the fields of
  ``Boxes`` as lists.

Files in subfolders, and in those that links lead to, are included; a scan's id is its relative path
without the suffix.
"""

import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import fields
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError, check_count, parsing
from lidar_synth.files.disk import files_below, read_text, write_file
from lidar_synth.files.parsing import parse_json, read_arrays
from lidar_synth.formats.cloud import (
    REFLECTANCES,
    read_header_description,
    seconds,
)
from lidar_synth.formats.description import Description
from lidar_synth.formats.npz import (
    check_numbers,
    decode_scan,
    read_stored_sensor,
    write_scan,
)
from lidar_synth.formats.pcd import encode_pcd, read_pcd
from lidar_synth.formats.ply import encode_ply, read_ply
from lidar_synth.formats.point_labels import encode_labels, read_labels, write_labels
from lidar_synth.formats.points import check_scale, check_scan, read_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import DETAILS, LABELS, FileWriter
from lidar_synth.geometry import POINT_FIELDS, Boxes, Scan, Sensor
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.projection.unfold import rows_by_elevation

LOG_REFLECTANCE = 255.0
"""Maximum of the reflectance in the logs of Velodyne's, Hesai's and Ouster's drivers."""

SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")

BOXES = ".boxes.json"
"""Suffix of the boxes beside a file of points."""

# Fields of clouds that mean something else in files of other programs.
_OURS = ("label", "confidence", "cause")

MOST_OFF = 5.0
"""Degrees between rings and beams (median) beyond which elevations do not tell the rings' rows."""


class CloudFiles(ScanFiles):
    """Files of points with named fields, which this package or others wrote."""

    plain = True

    def as_scan(
        self, arrays: dict[str, Any], said: Description | None, path: Path
    ) -> Scan:
        """The checked scan of a cloud, with reflectance from 0 to 1, the sensor's rings, and the
        boxes beside its file.

        Args:
            arrays: as the file has them.
            said: what this package wrote about it; other clouds with rings are logs of drivers.
            path: of the file.

        Raises:
            DataError: on a scan with invalid values, or damaged boxes.
            FileError: if the boxes cannot be read.
        """
        if "reflectance" not in arrays:
            warnings.warn(
                f"the points in {path.parent} have no reflectance (no field "
                f"{', '.join(REFLECTANCES)}): it is read as 0",
                stacklevel=2,
            )
            arrays["reflectance"] = np.zeros(len(arrays["points"]), np.float32)
        if said is None:
            arrays = drop_empty_firings(
                {name: a for name, a in arrays.items() if name not in _OURS}
            )
        if (ring := arrays.get("ring")) is not None:
            with np.errstate(invalid="ignore"):
                arrays["ring"] = ring.astype(np.int16)
            if not np.array_equal(arrays["ring"].clip(-32768 if said else 0), ring):
                del arrays["ring"]
                warnings.warn(
                    f"the rings of the points in {path.parent} are ignored: some are no whole "
                    "numbers from 0 to 32767",
                    stacklevel=2,
                )
        if said is None and "time" in arrays:
            arrays["time"] = seconds(arrays["time"], arrays["points"], path.parent)
        sensor = self._given or (said and said.sensor) or self.sensor
        scan = Scan(**arrays, sensor=sensor, boxes=read_boxes(path))
        if said is not None:
            scan = said.origin.apply(scan)
        is_log = said is None and scan.ring is not None
        scale = self._reflectance_max
        if scale is None:
            wide = is_log and np.nanmax(scan.reflectance, initial=0) > 1
            scale = LOG_REFLECTANCE if wide else 1.0
        check_scan(scan, str(path), scale)
        if is_log and not self._unknown:
            scan.ring = rows_of_rings(scan)
        if scale != 1:
            scan.reflectance = scan.reflectance / np.float32(scale)
        return scan


class Folder(CloudFiles):
    """A folder of .bin, .npy, .npz, .pcd or .ply files, one kind only, or one such file.

    Args:
        root: the folder or the file.
        sensor: the sensor that recorded the scans; by default the one that the files name
            (``.npz``, ``.pcd`` and ``.ply`` files of this package), or ``scans.json`` beside them,
            or else ``hdl64e_kitti``, except for ``.npz`` files.
        fields: floats per point of ``.bin`` files.
        reflectance_max: maximum of the reflectance in the files; values are divided by it. By
            default 1, and 255 in scans of PCD and PLY logs of a driver that hold more than 1: those
            have rings and no description of ours.
        on_bad: see ``ScanFiles``.

    Files of other programs have no labels of ours: ``label``, ``confidence`` and ``cause`` of PCD
    and PLY files without our description are ignored.

    Raises:
        FileError: if the path does not exist.
        ConfigError: if there are files of several kinds; on invalid ``fields`` or
            ``reflectance_max``.
        DataError: if there is no file.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return has_files(root, SUFFIXES)

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        fields: int = 4,
        reflectance_max: float | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        check_count("fields", fields, 4)
        self._reflectance_max = check_scale(reflectance_max)
        root = Path(root)
        ids, self._paths = scan_paths(root, SUFFIXES)
        super().__init__(
            root, ids, sensor, on_bad, stored=_named_sensor(self._paths[0])
        )
        self.options = {"fields": fields, "reflectance_max": self._reflectance_max}

    def read(self, index: int) -> Scan:
        scan = self._decode(self._paths[index])
        scan.id = self.ids[index]
        return scan

    def _decode(self, path: Path) -> Scan:
        suffix = path.suffix.lower()
        most = self._reflectance_max
        if suffix == ".bin":
            points = read_points(path, self.options["fields"], most)
            beside = path.with_suffix(".label")
            labels = (
                read_labels(beside, path, len(points), SEMANTIC_KITTI)
                if beside.is_file()
                else {}
            )
            return Scan(points[:, :3], points[:, 3], self.sensor, **labels)
        if suffix == ".npz":
            stored = read_arrays(path)
            known = self.sensor if self._unknown else self._named
            own = "sensor" in stored
            scan = decode_scan(stored, str(path), self._given if own else known)
            check_scan(scan, str(path), most or 1.0)
            scan.reflectance = scan.reflectance / np.float32(most or 1)
            return scan
        arrays = ARRAYS[suffix](path)
        return self.as_scan(arrays, read_header_description(path), path)


def read_boxes(path: Path) -> Boxes | None:
    """The boxes beside a file of points; None if there are none.

    Raises:
        FileError: if they cannot be read.
        DataError: if they are damaged.
    """
    beside = path.with_suffix(BOXES)
    if not beside.is_file():
        return None
    expected = "the fields of Boxes, one value per box"
    given = parse_json(read_text(beside), str(beside), expected)
    with parsing(beside, expected):
        return boxes_from_lists(given)


def boxes_from_lists(given: dict[str, Any]) -> Boxes:
    """The inverse of ``boxes_as_lists``, for values that may be hostile: what is wrong raises an
    error of any kind."""
    if not all(isinstance(name, str) for name in given["names"]):
        raise TypeError("names that are not text")
    with np.errstate(over="ignore"):  # Boxes refuses what is not finite
        return Boxes(**given)


def write_boxes(path: Path, boxes: Boxes | None) -> None:
    """The inverse of ``read_boxes``.

    Raises:
        FileError: if they cannot be written.
    """
    if boxes is not None:
        values = json.dumps(boxes_as_lists(boxes))
        write_file(path.with_suffix(BOXES), values.encode())


def boxes_as_lists(boxes: Boxes) -> dict[str, list[Any]]:
    """The fields of boxes by their names, as JSON holds them."""
    return {f.name: np.asarray(getattr(boxes, f.name)).tolist() for f in fields(Boxes)}


def drop_empty_firings(arrays: dict[str, Any]) -> dict[str, Any]:
    """The arrays of a cloud without firings that had no return: points at the origin, and those of
    logs without any coordinate."""
    points = arrays["points"]
    there = points.any(axis=1)
    if {"ring", "time"} <= arrays.keys():
        there &= ~np.isnan(points).all(axis=1)
    return arrays if there.all() else {n: a[there] for n, a in arrays.items()}


def rows_of_rings(scan: Scan) -> NDArray[np.int16]:
    """(N,) the row of the sensor for each ring: drivers count from below, or in the order of the
    lasers.

    Each ring gets a row of its own: from the highest to the lowest median elevation, those that
    fit best. More rings than rows, as of another sensor, and with a warning those far from the
    beams, as in the frame of a vehicle, keep their numbers. Points that are not finite do not
    count.
    """
    assert scan.ring is not None
    names, number = np.unique(scan.ring, return_inverse=True)
    beams, _ = scan.sensor.optics()
    if len(names) > len(beams):
        return scan.ring
    good = np.flatnonzero(np.isfinite(scan.points).all(axis=1))
    order = good[np.argsort(number[good], kind="stable")]
    there, starts = np.unique(number[order], return_index=True)
    found = assign_beams(scan[order])
    elevation = beams[found.ring] + np.radians(found.off)  # as seen from the laser
    middle = np.array([np.median(part) for part in np.split(elevation, starts[1:])])
    downward = np.argsort(-middle)
    fitting = rows_by_elevation(middle[downward], beams)
    if np.median(abs(middle[downward] - beams[fitting])) > np.radians(MOST_OFF):
        warnings.warn(
            f"the points lie far from the beams of sensor {scan.sensor.name!r}: rings keep the "
            "numbers of the files. lidar-synth sensor fit says how to bring points in the frame of "
            "a vehicle into the sensor's",
            stacklevel=2,
        )
        return scan.ring
    rows = np.zeros(len(names), np.int16)
    rows[there[downward]] = fitting
    return rows[number]


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    array = read_arrays(path)["array"]
    if array.ndim != 2 or array.shape[1] < 4:
        raise DataError(
            f"{path} holds an array of shape {array.shape}",
            "(N, 4): x, y, z, reflectance",
        )
    check_numbers(array, str(path))
    with np.errstate(over="ignore"):
        array = array.astype(np.float32, copy=False)
    return {"points": array[:, :3], "reflectance": array[:, 3]}


ARRAYS: dict[str, Callable[[Path], dict[str, NDArray[Any]]]] = {
    ".npy": _columns,
    ".pcd": read_pcd,
    ".ply": read_ply,
}
"""{suffix: reader of a scan's arrays}."""


def _named_sensor(path: Path) -> Sensor | None:
    """The sensor that a file names; None if it names none, or if reading the scan will raise an
    error."""
    if path.suffix.lower() == ".npz":
        return read_stored_sensor(path)
    try:
        said = read_header_description(path)
    except (DataError, FileError):
        return None
    return said.sensor if said else None


def has_files(root: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether a path is a file with one of the suffixes, or a folder with such a file."""
    paths = chain([root], files_below(root))
    return any(path.suffix.lower() in suffixes for path in paths)


def scan_paths(
    root: Path,
    suffixes: tuple[str, ...],
    order: Callable[[Path], Any] | None = None,
) -> tuple[list[str], list[Path]]:
    """The names of a path's files, which are relative and without suffix, and their paths.

    Args:
        root: the folder or the file.
        suffixes: of the files.
        order: key by which the files are sorted; by default by path.

    Raises:
        FileError: if the path does not exist.
        ConfigError: if there are files of several kinds, or the file is of an unknown kind.
        DataError: if there is no file.
    """
    if root.is_file():
        if root.suffix.lower() not in suffixes:
            raise ConfigError(
                f"{root} is not a scan", f"a file with one of {', '.join(suffixes)}"
            )
        return [root.stem], [root]
    if not root.is_dir():
        raise FileError(f"{root} does not exist", "a file or a folder with scans")
    found = (
        path
        for path in files_below(root)
        if path.suffix.lower() in suffixes
        and not any(part[0] == "." for part in path.relative_to(root).parts)
    )
    paths = sorted(found, key=order)
    kinds = sorted({path.suffix.lower() for path in paths})
    if len(kinds) > 1:
        raise ConfigError(
            f"{root} holds {' and '.join(kinds)} files",
            "one kind",
            "Give the folder of one of them.",
        )
    if not paths:
        raise DataError(
            f"{root} holds no scan", f"files with one of {', '.join(suffixes)}"
        )
    return [p.relative_to(root).with_suffix("").as_posix() for p in paths], paths


def find_scans(
    root: Path,
    suffix: str,
    survey: Callable[[Path], tuple[Sequence[Any], Description | None]],
    order: Callable[[Path], Any] | None = None,
) -> tuple[
    list[str], list[tuple[Path, Any]], dict[Path, Description | None], Sensor | None
]:
    """The scans of files that hold several each: their ids, their files and places in them, what
    each file says, and the sensor that the first one names.

    Args:
        root, order: as for ``scan_paths``.
        suffix: of the files.
        survey: gives the places of a file's scans, and what it says.

    Raises:
        ConfigError, DataError, FileError: as ``scan_paths`` and ``survey``.
    """
    ids = []
    found = []
    said = {}
    for name, path in zip(*scan_paths(root, (suffix,), order), strict=True):
        places, said[path] = survey(path)
        numbers = range(len(places))
        ids += [name] if len(places) == 1 else [f"{name}/{n:06d}" for n in numbers]
        found += [(path, place) for place in places]
    first = next(iter(said.values()))
    return ids, found, said, first.sensor if first else None


class KITTIWriter(FileWriter):
    """Writes ``NAME.bin`` as in KITTI, and ``NAME.label`` of labelled scans as in SemanticKITTI."""

    suffix = ".bin"
    keeps = LABELS

    def _write_file(self, path: Path, scan: Scan) -> None:
        if scan.label is not None:
            write_labels(
                path.with_suffix(".label"), encode_labels(scan, SEMANTIC_KITTI)
            )
        self._write_points(path, scan)


class NPZWriter(FileWriter):
    """Writes the package's own ``NAME.npz``, with all fields of the scan except its image."""

    suffix = ".npz"
    keeps = frozenset(DETAILS) - {"image_path"}

    def _write_file(self, path: Path, scan: Scan) -> None:
        write_scan(path, scan)


class PCDWriter(FileWriter):
    """Writes ``NAME.pcd`` with the scan's points and fields, and its boxes to ``NAME.boxes.json``,
    without pose."""

    suffix = ".pcd"
    keeps = frozenset({*POINT_FIELDS, "boxes"})
    encode: "staticmethod[[Scan], bytes]" = staticmethod(encode_pcd)

    def _write_file(self, path: Path, scan: Scan) -> None:
        content = self.encode(scan)
        write_boxes(path, scan.boxes)
        write_file(path, content)


class PLYWriter(PCDWriter):
    """Writes ``NAME.ply``, with what ``PCDWriter`` writes."""

    suffix = ".ply"
    encode = staticmethod(encode_ply)
