"""PCD files, version 0.7 (https://pointclouds.org/documentation/tutorials/pcd_file_format.html).
Lossless for a scan.

The package reads ``ascii``, ``binary`` and ``binary_compressed`` files and writes ``binary``. The
header is compared with the file before any value is read: a false header could otherwise drop
points, or read beyond the data.
"""

import re
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import SKIP_HINT, read_file
from lidar_synth.formats.cloud import (
    LONGEST_HEADER,
    Field,
    check_fields,
    check_size,
    from_records,
    from_text,
    to_arrays,
    to_records,
)
from lidar_synth.formats.description import to_comments
from lidar_synth.geometry import Scan

MOST_EXPANSION = 89
"""Maximum factor of decompression: LZF expands 3 bytes to at most 264."""

_PER_FIELD = ("FIELDS", "SIZE", "TYPE", "COUNT")

_SIZES = {"F": "48", "I": "1248", "U": "1248"}
"""{type: possible sizes of a value in bytes}."""


def encode_pcd(scan: Scan) -> bytes:
    """A scan as a binary ``.pcd`` file; ``read_pcd`` is the inverse."""
    records = to_records(scan)
    types = [records.dtype[name] for name in records.dtype.names or ()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {line}" for line in to_comments(scan)),
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
    return "\n".join(lines).encode() + records.tobytes()


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of a ``.pcd`` file, named as in ``Scan``.

    Raises:
        FileError: if it cannot be read.
        DataError: if its header is invalid or does not match the file, or it holds no points.
    """
    content = read_file(path)
    where = str(path)
    end = re.search(rb"^DATA[ \t]+(\w+)[ \t\r]*\n", content[:LONGEST_HEADER], re.M)
    if end is None:
        raise DataError(
            f"{where} has no header of a .pcd file", "a PCD file", SKIP_HINT
        )
    fields, count = _header(content[: end.start()].decode("latin-1"), where)
    check_fields(fields, count, where)
    body = content[end.end() :]
    size = count * sum(field.width for field in fields)
    if end[1] == b"ascii":
        return to_arrays(from_text(body.decode("latin-1"), fields, count, where))
    if end[1] == b"binary_compressed":
        return to_arrays(_from_columns(_decompressed(body, size, where), fields, count))
    if end[1] != b"binary":
        raise DataError(
            f"{where} holds {end[1].decode('latin-1')!r} data",
            "ascii, binary or binary_compressed",
        )
    check_size(body, size, where)
    return to_arrays(from_records(body, fields, count))


def _header(text: str, where: str) -> tuple[list[Field], int]:
    """Parse the fields and the number of points, after checking that all lines exist once and
    agree."""
    rows = [
        line.split()
        for line in text.splitlines()
        if line.strip() and not line.startswith("#")
    ]
    header = {row[0]: row[1:] for row in rows}
    fault = f"{where}: its header cannot be read"
    expected = "one line each of FIELDS, SIZE, TYPE, WIDTH, HEIGHT and POINTS"
    if len(header) < len(rows) or not {
        "FIELDS",
        "SIZE",
        "TYPE",
        "WIDTH",
        "HEIGHT",
        "POINTS",
    } <= set(header):
        raise DataError(
            f"{fault} (it has {[row[0][:20] for row in rows][:20]})",
            expected,
            SKIP_HINT,
        )
    header.setdefault("COUNT", ["1"] * len(header["FIELDS"]))
    if len({len(header[key]) for key in _PER_FIELD}) > 1:
        raise DataError(
            f"{fault} ({ {key: len(header[key]) for key in _PER_FIELD} })",
            "one value per field",
            SKIP_HINT,
        )
    single = [header[key] for key in ("WIDTH", "HEIGHT", "POINTS")]
    numbers = sum(single, [*header["SIZE"], *header["COUNT"]])
    if any(len(row) != 1 for row in single) or any(
        not re.fullmatch("[0-9]{1,12}", number) for number in numbers
    ):
        raise DataError(
            f"{fault}: invalid sizes",
            "integers, one each for WIDTH, HEIGHT and POINTS",
            SKIP_HINT,
        )
    width, height, points = (int(number) for [number] in single)
    if width * height != points:
        raise DataError(
            f"{where}: WIDTH {width}, HEIGHT {height} and POINTS {points}",
            "WIDTH x HEIGHT = POINTS",
        )
    fields = []
    for name, size, kind, count in zip(
        *(header[key] for key in _PER_FIELD), strict=True
    ):
        if size not in _SIZES.get(kind, "") or int(count) < 1:
            raise DataError(
                f"{where}: field {name[:50]!r} of TYPE {kind[:20]}, SIZE {size} and COUNT {count}",
                "F of 4 or 8 bytes, I or U of 1, 2, 4 or 8, at least one value",
                SKIP_HINT,
            )
        fields.append(Field(name, f"<{kind.lower()}{size}", int(count)))
    return fields, points


def _from_columns(
    body: bytes, fields: list[Field], count: int
) -> dict[str, NDArray[Any]]:
    """{name: values} of fields that are stored one after another, as in compressed files."""
    arrays = {}
    offset = 0
    for field in fields:
        arrays[field.name] = np.frombuffer(
            body, field.type, count * field.count, offset
        )
        offset += count * field.width
    return arrays


def _decompressed(body: bytes, size: int, where: str) -> bytes:
    """The ``size`` bytes of a compressed body: two lengths, then LZF."""
    packed, plain = (int.from_bytes(body[i : i + 4], "little") for i in (0, 4))
    if plain != size or size > MOST_EXPANSION * packed:
        raise DataError(
            f"{where} declares {plain} bytes in {packed} compressed ones",
            f"{size}, by its header",
            SKIP_HINT,
        )
    check_size(body, 8 + packed, where)
    target = np.empty(size, np.uint8)
    if lzf(np.frombuffer(body, np.uint8, packed, 8), target) != size:
        raise DataError(
            f"{where}: its compressed points are damaged", "LZF data", SKIP_HINT
        )
    return target.tobytes()


@numba.njit(cache=True)
def lzf(source, target):  # type: ignore[no-untyped-def]  # (N,) and (M,) uint8, compiled
    """Decompress LZF (http://oldhome.schmorp.de/marc/liblzf.html) into ``target``.

    Returns:
        The number of bytes written, or -1 if the source is damaged or ``target`` too short.
    """
    read = written = 0
    while read < len(source):
        control = int(source[read])
        read += 1
        if control < 32:  # literal bytes follow
            length = control + 1
            if read + length > len(source) or written + length > len(target):
                return -1
            for i in range(length):
                target[written + i] = source[read + i]
            read += length
        else:  # a reference to bytes that were written before
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
