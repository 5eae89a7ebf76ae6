"""What PCD and PLY files have in common: named values per point, as records or as text, and the scan that they make.

Reflectance stands in the field ``intensity``, which other tools know, and every other field of a scan under its own
name. ``raw_label`` is stored as the same bits, signed: not every reader of PLY knows unsigned 32-bit values.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import SKIP_HINT
from lidar_synth.geometry.scan import Scan

STORED = {"label": "<u1", "raw_label": "<i4", "instance": "<i4", "ring": "<i4", "confidence": "<f4"}
"""Type on disk of each field of a scan beside its reflectance."""

IN_MEMORY = {"label": "u1", "raw_label": "u4", "instance": "i4", "ring": "i2", "confidence": "f4"}

WANTED = ("x", "y", "z", "intensity", "reflectance", *STORED)
"""The fields of a file that are read; others are passed over."""

WIDEST = 1 << 20
"""Bytes of one point."""


@dataclass(frozen=True)
class Field:
    """A field of a file's points.

    Args:
        name: its name.
        type: numpy's type of one value, byte order and all.
        count: values per point.
    """

    name: str
    type: str
    count: int = 1

    @property
    def width(self) -> int:
        """Bytes per point."""
        return np.dtype(self.type).itemsize * self.count


def cut(where: str, held: int, wanted: int, unit: str = "bytes") -> DataError:
    """The error for a file that does not hold what its header says."""
    given = "has been cut" if held < wanted else "holds more than its header says"
    return DataError(f"{where} {given}: {held} {unit} of points", f"{wanted}, by its header", SKIP_HINT)


def check_size(body: bytes, size: int, where: str, *, more: bool = False) -> None:
    """Refuse a body of another length than its header says, but for the end of a line; ``more`` may follow.

    Raises:
        DataError: saying which of the two it is.
    """
    if len(body) < size or not (more or body[size:] in (b"", b"\n", b"\r\n")):
        raise cut(where, len(body), size)


def check_fields(fields: Sequence[Field], count: int, where: str) -> None:
    """Refuse fields that make no scan.

    Raises:
        DataError: where x, y or z is missing, a wanted field stands there twice or has several values per point, a
            point has more than ``WIDEST`` bytes, or there are no points.
    """
    names = [field.name for field in fields if field.name in WANTED]
    if len(set(names)) < len(names) or any(field.count != 1 for field in fields if field.name in WANTED):
        raise DataError(f"{where} has the fields {names} twice or with several values", "one value of each", SKIP_HINT)
    if not {"x", "y", "z"} <= set(names):
        raise DataError(f"{where} has the fields {names}", "x, y and z among them")
    if sum(field.width for field in fields) > WIDEST:
        raise DataError(f"{where} has {sum(field.width for field in fields)} bytes per point", f"at most {WIDEST}")
    if count == 0:
        raise DataError(f"{where} holds no points", "at least one point", SKIP_HINT)


def from_records(body: bytes, fields: Sequence[Field], count: int) -> dict[str, NDArray[Any]]:
    """{name: (N,)} the wanted fields of points that stand one after another; ``body`` holds them all."""
    wanted, offset = [], 0
    for field in fields:
        if field.name in WANTED:
            wanted.append((field.name, field.type, offset))
        offset += field.width
    names, types, offsets = (list(column) for column in zip(*wanted, strict=True))
    dtype = np.dtype({"names": names, "formats": types, "offsets": offsets, "itemsize": offset})
    records = np.frombuffer(body, dtype, count)
    return {name: records[name] for name in names}


def from_text(text: str, fields: Sequence[Field], count: int, where: str) -> dict[str, NDArray[Any]]:
    """{name: (N,)} the wanted fields of points that stand one in a line.

    Raises:
        DataError: on another number of lines or values, or a value that its type cannot hold.
    """
    columns = sum(field.count for field in fields)
    lines = sum(1 for line in text.splitlines() if line.strip())
    if lines != count:
        raise cut(where, lines, count, "lines")
    try:
        table = np.loadtxt(io.StringIO(text), np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise DataError(f"{where}: {error}", f"{columns} numbers in each line", SKIP_HINT) from error
    if table.shape != (count, columns):
        raise DataError(f"{where} has {table.shape[1]} values in a line", f"{columns}, by its header", SKIP_HINT)
    found, column = {}, 0
    for field in fields:
        if field.name in WANTED:
            found[field.name] = _typed(table[:, column], field, where)
        column += field.count
    return found


def _typed(values: NDArray[np.float64], field: Field, where: str) -> NDArray[Any]:
    """Numbers of a text as the type that its header gives them."""
    dtype = np.dtype(field.type)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return values.astype(dtype)
    limits = np.iinfo(dtype)
    if not ((values == np.floor(values)) & (values >= limits.min) & (values <= limits.max)).all():
        raise DataError(f"{where}: field {field.name!r} holds other values than {dtype}", "whole numbers", SKIP_HINT)
    return values.astype(dtype)


def to_arrays(found: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The fields of a file as a ``Scan`` names them; those of its own only where they have the type of ``STORED``."""
    with np.errstate(over="ignore"):
        points = np.column_stack([found[axis] for axis in "xyz"]).astype(np.float32)
        intensity = found.get("intensity", found.get("reflectance", np.zeros(len(points)))).astype(np.float32)
    ours = [n for n, kind in STORED.items() if n in found and found[n].dtype.newbyteorder("<") == np.dtype(kind)]
    return {"points": points, "reflectance": intensity} | {n: found[n].astype(IN_MEMORY[n]) for n in ours}


def to_records(scan: Scan) -> NDArray[np.void]:
    """The points of a scan, one after another; ``to_arrays`` is the inverse."""
    values = dict(zip("xyz", scan.points.T, strict=True)) | {"intensity": scan.reflectance}
    values |= {name: array.astype(STORED[name]) for name, array in scan.fields().items() if name in STORED}
    records = np.empty(len(scan), [(name, STORED.get(name, "<f4")) for name in values])
    for name, array in values.items():
        records[name] = array
    return records
