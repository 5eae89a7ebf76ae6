"""PCD files, version 0.7 (https://pointclouds.org/documentation/tutorials/pcd_file_format.html). Lossless for a scan.

Read as ``ascii``, ``binary`` and ``binary_compressed``, written as ``binary``. What a header says is compared with the
file before any value is read: a header that lies would otherwise drop points, or read what is no part of the file.
"""

import re
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import SKIP_HINT, read_file, write_file
from lidar_synth.formats.cloud import Field, check_fields, check_size, from_records, from_text, to_arrays, to_records
from lidar_synth.geometry.scan import Scan

LONGEST_HEADER = 1 << 16
"""Bytes."""

MOST_EXPANSION = 89
"""LZF makes at most 264 bytes of 3."""

_PER_FIELD = ("FIELDS", "SIZE", "TYPE", "COUNT")

_SIZES = {"F": "48", "I": "1248", "U": "1248"}
"""Bytes that a value of each type may have."""


def write_pcd(path: Path, scan: Scan) -> None:
    """A scan as binary ``.pcd``; ``read_pcd`` is the inverse.

    Raises:
        FileError: where it cannot be written.
    """
    records = to_records(scan)
    types = [records.dtype[name] for name in records.dtype.names or ()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(records.dtype.names or ())}",
        f"SIZE {' '.join(str(t.itemsize) for t in types)}",
        f"TYPE {' '.join(t.kind.upper() for t in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {len(records)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        "DATA binary\n",
    ]
    write_file(path, "\n".join(lines).encode() + records.tobytes())


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a ``.pcd``, as a ``Scan`` names them.

    Raises:
        FileError: where it cannot be read.
        DataError: where its header is none or does not fit the file, or it holds no points.
    """
    content, where = read_file(path), str(path)
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t\r]*\n", content[:LONGEST_HEADER], re.M)
    if end is None:
        raise DataError(f"{where} has no header of a .pcd file", "a PCD file", SKIP_HINT)
    fields, count = _header(content[: end.start()].decode("latin-1"), where)
    check_fields(fields, count, where)
    body, size = content[end.end() :], count * sum(field.width for field in fields)
    if end[1] == b"ascii":
        return to_arrays(from_text(body.decode("latin-1"), fields, count, where))
    if end[1] == b"binary_compressed":
        return to_arrays(_from_columns(_decompressed(body, size, where), fields, count))
    if end[1] != b"binary":
        raise DataError(f"{where} holds {end[1].decode('latin-1')!r} data", "ascii, binary or binary_compressed")
    check_size(body, size, where)
    return to_arrays(from_records(body, fields, count))


def _header(text: str, where: str) -> tuple[list[Field], int]:
    """Fields and number of points; every line is there once, and all agree."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    header = {row[0]: row[1:] for row in rows}
    fault = f"{where}: its header cannot be read"
    expected = "one line each of FIELDS, SIZE, TYPE, WIDTH, HEIGHT and POINTS"
    if len(header) < len(rows) or not {"FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS"} <= set(header):
        raise DataError(f"{fault} (it has {[row[0][:20] for row in rows][:20]})", expected, SKIP_HINT)
    header.setdefault("COUNT", ["1"] * len(header["FIELDS"]))
    if len({len(header[key]) for key in _PER_FIELD}) > 1:
        raise DataError(
            f"{fault} ({ {key: len(header[key]) for key in _PER_FIELD} })", "one value per field", SKIP_HINT
        )
    single = [header[key] for key in ("WIDTH", "HEIGHT", "POINTS")]
    numbers = sum(single, [*header["SIZE"], *header["COUNT"]])
    if any(len(row) != 1 for row in single) or any(not re.fullmatch("[0-9]{1,12}", number) for number in numbers):
        raise DataError(f"{fault}: sizes that are none", "whole numbers, one each of WIDTH, HEIGHT, POINTS", SKIP_HINT)
    width, height, points = (int(number) for [number] in single)
    if width * height != points:
        raise DataError(f"{where}: WIDTH {width}, HEIGHT {height} and POINTS {points}", "WIDTH x HEIGHT = POINTS")
    fields = []
    for name, size, kind, count in zip(*(header[key] for key in _PER_FIELD), strict=True):
        if size not in _SIZES.get(kind, "") or int(count) < 1:
            given = f"{where}: field {name[:50]!r} of TYPE {kind[:20]}, SIZE {size} and COUNT {count}"
            raise DataError(given, "F of 4 or 8 bytes, I or U of 1, 2, 4 or 8, at least one value", SKIP_HINT)
        fields.append(Field(name, f"<{kind.lower()}{size}", int(count)))
    return fields, points


def _from_columns(body: bytes, fields: list[Field], count: int) -> dict[str, NDArray[Any]]:
    """{name: (N, count)} fields of which each has all its values together, as compression has it."""
    found, offset = {}, 0
    for field in fields:
        found[field.name] = np.frombuffer(body, field.type, count * field.count, offset)
        offset += count * field.width
    return found


def _decompressed(body: bytes, size: int, where: str) -> bytes:
    """The ``size`` bytes of a compressed body: two lengths, then LZF."""
    packed, plain = (int.from_bytes(body[i : i + 4], "little") for i in (0, 4))
    if plain != size or size > MOST_EXPANSION * packed:
        raise DataError(f"{where} says {packed} bytes hold {plain}", f"{size}, by its header", SKIP_HINT)
    check_size(body, 8 + packed, where)
    target = np.empty(size, np.uint8)
    if lzf(np.frombuffer(body, np.uint8, packed, 8), target) != size:
        raise DataError(f"{where}: its compressed points are damaged", "what LZF compressed", SKIP_HINT)
    return target.tobytes()


@numba.njit(cache=True)
def lzf(source, target):  # type: ignore[no-untyped-def]  # (N,) and (M,) uint8, compiled
    """Decompress LZF (http://oldhome.schmorp.de/marc/liblzf.html) into ``target``.

    Returns:
        The bytes written, or -1 where the source is damaged or ``target`` too short.
    """
    read = written = 0
    while read < len(source):
        control = int(source[read])
        read += 1
        if control < 32:  # the next bytes as they are
            length = control + 1
            if read + length > len(source) or written + length > len(target):
                return -1
            for i in range(length):
                target[written + i] = source[read + i]
            read += length
        else:  # bytes that were written before
            length = (control >> 5) + 2
            if read + 1 + (length == 9) > len(source):
                return -1
            if length == 9:
                length += int(source[read])
                read += 1
            start = written - ((control & 31) << 8) - int(source[read]) - 1
            read += 1
            if start < 0 or written + length > len(target):
                return -1
            for i in range(length):
                target[written + i] = target[start + i]
        written += length
    return written
