"""Shared parts of PCD and PLY: named values per point, as records or as text, and their conversion
to scans.

Reflectance is stored in the field ``intensity``, which other tools understand; all other fields of
a scan keep their names. ``raw_label`` is stored bit for bit as a signed integer, because not every
PLY reader supports unsigned 32-bit values.

The logs of drivers have other names and types, which are read too: ``ring`` or ``channel`` of whole
numbers, the time as ``time``, ``t``, ``time_stamp`` or ``timestamp`` in any unit of ``UNITS``, and
Ouster's ``reflectivity``, which is calibrated and takes precedence over its ``intensity``, the
number of photons. Names of the reflectance may have capitals, and CloudCompare's prefix
``scalar_``.
"""

import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import SKIP_HINT, read_start
from lidar_synth.formats.description import Description, from_comments
from lidar_synth.geometry import Scan
from lidar_synth.geometry.scan import TYPES

STORED = {
    "label": "<u1",
    "raw_label": "<i4",
    "instance": "<i4",
    "ring": "<i4",
    "confidence": "<f4",
    "time": "<f4",
    "cause": "<u1",
}
"""Type on disk of each field of a scan except reflectance."""

REFLECTANCES = ("reflectivity", "intensity", "reflectance", "remission", "i")
RINGS = ("ring", "channel")
TIMES = ("time", "t", "time_stamp", "timestamp")
"""Names of a field in the files of drivers and other programs, of which the first one counts."""

UNITS = (1.0, 1e-3, 1e-6, 1e-9)
"""Units of times in seconds."""

LONGEST_TURN = 1.05
"""Seconds from the first to the last point of a scan, by which the unit of times is recognised."""

WANTED = ("x", "y", "z", *STORED, "channel", *TIMES)
"""The fields that are read from a file beside its reflectance; all others are ignored."""

LONGEST_PADDING = 1 << 16
"""Maximum number of zeros after the points: earlier versions of PCL write one page of memory more
than the points take, whatever the length of the header."""

WIDEST = 1 << 20
"""Maximum number of bytes of one point."""

LONGEST_HEADER = 1 << 16
"""Maximum length of a header in bytes."""

COMMENTS = {".pcd": ("#", "DATA"), ".ply": ("comment", "end_header")}
"""{suffix: beginning of a comment, end of the header}."""


@dataclass(frozen=True)
class Field:
    """A field of a file's points.

    Args:
        name: its name.
        type: numpy type of one value, with byte order.
        count: number of values per point.
    """

    name: str
    type: str
    count: int = 1

    @property
    def width(self) -> int:
        """Bytes per point."""
        return np.dtype(self.type).itemsize * self.count

    @property
    def wanted(self) -> bool:
        """Whether it is read."""
        return self.name in WANTED or _plain(self.name) in REFLECTANCES


def _plain(name: str) -> str:
    """The name of a reflectance without capitals and prefix."""
    return name.lower().removeprefix("scalar_")


def size_error(where: str, held: int, wanted: int, unit: str = "bytes") -> DataError:
    """The error for a file whose size does not match its header."""
    given = "is truncated" if held < wanted else "holds more than its header declares"
    return DataError(
        f"{where} {given}: {held} {unit} of points",
        f"{wanted}, by its header",
        SKIP_HINT,
    )


def check_size(body: bytes, size: int, where: str, *, more: bool = False) -> None:
    """Refuse a body whose length does not match the header.

    A final line break is allowed, up to ``LONGEST_PADDING`` zeros, and with ``more`` any further
    bytes.

    Raises:
        DataError: if it is too short or too long.
    """
    tail = body[size:]
    if len(tail) <= LONGEST_PADDING:
        tail = tail.rstrip(b"\0")
    if len(body) < size or not (more or tail in (b"", b"\n", b"\r\n")):
        raise size_error(where, len(body), size)


def check_fields(fields: Sequence[Field], count: int, where: str) -> None:
    """Refuse fields from which no scan can be made.

    Raises:
        DataError: if x, y or z is missing, a wanted field occurs twice or has several values per
            point, a point has more than ``WIDEST`` bytes, or there are no points.
    """
    wanted = [field for field in fields if field.wanted]
    names = [field.name for field in wanted]
    if len(set(names)) < len(names) or any(field.count != 1 for field in wanted):
        raise DataError(
            f"{where} has the fields {names} twice or with several values",
            "one value of each",
            SKIP_HINT,
        )
    if not {"x", "y", "z"} <= set(names):
        raise DataError(f"{where} has the fields {names}", "x, y and z among them")
    width = sum(field.width for field in fields)
    if width > WIDEST:
        raise DataError(f"{where} has {width} bytes per point", f"at most {WIDEST}")
    if count == 0:
        raise DataError(f"{where} holds no points", "at least one point", SKIP_HINT)


def read_header_description(path: Path) -> Description | None:
    """What the comments of a ``.pcd`` or ``.ply`` file say about its scan; None if they say
    nothing, or the file is of another kind.

    Raises:
        FileError: if it cannot be read.
        DataError: on a damaged description.
    """
    mark, end = COMMENTS.get(path.suffix.lower(), ("", ""))
    if not mark:
        return None
    lines = read_start(path, LONGEST_HEADER).split(f"\n{end}", 1)[0].splitlines()
    said = (line.removeprefix(mark) for line in lines if line.startswith(mark))
    return from_comments(said, str(path))


def from_records(
    body: bytes, fields: Sequence[Field], count: int
) -> dict[str, NDArray[Any]]:
    """{name: (N,)} the wanted fields of points stored as consecutive records; ``body`` must be long
    enough."""
    kinds = [f.type if f.wanted else f"V{f.width}" for f in fields]
    records = np.frombuffer(body, ",".join(kinds), count)
    named = zip(fields, records.dtype.names or (), strict=True)
    return {field.name: records[place] for field, place in named if field.wanted}


def from_text(
    text: str, fields: Sequence[Field], count: int, where: str
) -> dict[str, NDArray[Any]]:
    """{name: (N,)} the wanted fields of points stored as text, one point per line.

    Raises:
        DataError: on a wrong number of lines or values, or a value out of range of its type.
    """
    columns = sum(field.count for field in fields)
    lines = sum(1 for line in text.splitlines() if line.strip())
    if lines != count:
        raise size_error(where, lines, count, "lines")
    with parsing(where, f"{columns} numbers in each line", SKIP_HINT):
        table = np.loadtxt(io.StringIO(text), np.float64, comments=None, ndmin=2)
    if table.shape != (count, columns):
        raise DataError(
            f"{where} has {table.shape[1]} values in a line",
            f"{columns}, by its header",
            SKIP_HINT,
        )
    arrays = {}
    column = 0
    for field in fields:
        if field.wanted:
            arrays[field.name] = _typed(table[:, column], field, where)
        column += field.count
    return arrays


def _typed(values: NDArray[np.float64], field: Field, where: str) -> NDArray[Any]:
    """Convert numbers from text to the type that the header declares."""
    dtype = np.dtype(field.type)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    if not (
        (values == np.floor(values)) & (values >= limits.min) & (values <= limits.max)
    ).all():
        raise DataError(
            f"{where}: field {field.name!r} holds other values than {dtype}",
            "integers",
            SKIP_HINT,
        )
    return values.astype(dtype)


def to_arrays(stored: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Rename and convert a file's fields to those of a ``Scan``, as far as it has them: ring and
    time as they are stored, see ``CloudFiles``.

    Labels and the like are read only if they have the type of ``STORED``; other programs use the
    names otherwise.
    """
    with np.errstate(over="ignore"):
        points = np.column_stack([stored[axis] for axis in "xyz"]).astype(np.float32)
        grey = _first({_plain(n): stored[n] for n in stored}, REFLECTANCES)
        reflectance = {} if grey is None else {"reflectance": grey.astype(np.float32)}
    own = [
        n
        for n, kind in STORED.items()
        if n in stored and stored[n].dtype.newbyteorder("<") == np.dtype(kind)
    ]
    arrays = {"points": points, **reflectance} | {
        n: stored[n].astype(TYPES[n]) for n in own
    }
    named = {"ring": _first(stored, RINGS), "time": _first(stored, TIMES)}
    return arrays | {n: np.array(a) for n, a in named.items() if a is not None}


def _first(
    stored: Mapping[str, NDArray[Any]], names: Sequence[str]
) -> NDArray[Any] | None:
    """The first of these fields that a file has."""
    return next((stored[name] for name in names if name in stored), None)


def seconds(
    time: NDArray[Any], points: NDArray[np.float32], where: Path
) -> NDArray[np.float32] | None:
    """The times of points as seconds from the first point, read in the largest unit in which a turn
    is short; points that are not finite do not count.

    None if all points have one time, which is that of the file; with a warning, which names
    ``where``, if there is no such unit.
    """
    own = time[np.isfinite(points).all(axis=1)]
    if not own.size or own.min() == own.max():
        return None
    with np.errstate(all="ignore"):
        since: NDArray[np.float64] = (time - own.min()).astype(np.float64)
        longest = np.float64(own.max() - own.min())
        for unit in UNITS:
            if longest * unit <= LONGEST_TURN:
                return (since * unit).astype(np.float32)
    warnings.warn(
        f"the times of the points in {where} are ignored: in no unit is a turn short",
        stacklevel=3,
    )
    return None


def to_records(scan: Scan) -> NDArray[np.void]:
    """The points of a scan as consecutive records; ``to_arrays`` is the inverse."""
    values = dict(zip("xyz", scan.points.T, strict=True)) | {
        "intensity": scan.reflectance
    }
    values |= {
        name: array.astype(STORED[name])
        for name, array in scan.fields().items()
        if name in STORED
    }
    records = np.empty(len(scan), [(name, STORED.get(name, "<f4")) for name in values])
    for name, array in values.items():
        records[name] = array
    return records
