"""PLY files (http://paulbourke.net/dataformats/ply): their vertices as points. Lossless for a scan.

The package reads ``ascii`` and both binary byte orders and writes ``binary_little_endian``. As with
PCD, the header is compared with the file before any value is read.
"""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import SKIP_HINT, open_file, read_file
from lidar_synth.formats.cloud import (
    LONGEST_HEADER,
    Field,
    check_fields,
    check_size,
    from_records,
    from_text,
    size_error,
    to_arrays,
    to_records,
)
from lidar_synth.formats.description import to_comments
from lidar_synth.geometry import Scan

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}

ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """One element of the file: ``count`` records of ``fields``; ``lists`` if a field has no fixed
    length."""

    name: str
    count: int
    fields: list[Field] = field(default_factory=list)
    lists: bool = False

    @property
    def size(self) -> int:
        """Total size of its records in bytes."""
        return self.count * sum(f.width for f in self.fields)


def encode_ply(scan: Scan) -> bytes:
    """A scan as a binary ``.ply`` file; ``read_ply`` is the inverse."""
    records = to_records(scan)
    return vertex_header(records, to_comments(scan)) + records.tobytes()


def vertex_header(records: NDArray[np.void], comments: Iterable[str] = ()) -> bytes:
    """The header of a binary file that holds only these records."""
    names = {kind: name for name, kind in reversed(TYPES.items())}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
    ]
    lines += [f"element vertex {len(records)}"]
    lines += [
        f"property {names[records.dtype[n].str[1:]]} {n}"
        for n in records.dtype.names or ()
    ]
    return "\n".join([*lines, "end_header\n"]).encode()


def map_vertices(path: Path) -> NDArray[np.void]:
    """All properties of the vertices of a large binary ``.ply`` file, mapped into memory instead of
    read.

    Returns:
        (N,) records, read-only; N may be 0.

    Raises:
        FileError: if it cannot be read.
        DataError: if its header is invalid or does not match the file.
    """
    where = str(path)
    with open_file(path, "a PLY file") as file:
        start = file.read(LONGEST_HEADER)
        size = os.fstat(file.fileno()).st_size
    encoding, elements, offset = _parse(start, where)
    if encoding == "ascii" or len(elements) != 1 or elements[0].lists:
        raise DataError(
            f"{where} is not a list of binary points",
            "a binary PLY file with only the element vertex",
        )
    fields = elements[0].fields
    count = elements[0].count
    if size - offset != elements[0].size:
        raise size_error(where, size - offset, elements[0].size)
    if len({f.name for f in fields}) < len(fields):
        raise DataError(
            f"{where} has a property twice", "each property once", SKIP_HINT
        )
    kind = np.dtype([(f.name, f.type) for f in fields])
    if count == 0:
        return np.zeros(0, kind)
    return np.memmap(path, kind, "r", offset, count)


def read_ply(path: Path) -> dict[str, NDArray[Any]]:
    """Read the vertices of a ``.ply`` file as arrays, named as in ``Scan``.

    Raises:
        FileError: if it cannot be read.
        DataError: if its header is invalid or does not match the file, or it holds no points.
    """
    content = read_file(path)
    where = str(path)
    encoding, elements, offset = _parse(content[:LONGEST_HEADER], where)
    position = [e.name for e in elements].index("vertex")
    vertex = elements[position]
    if vertex.lists or (
        encoding != "ascii" and any(e.lists for e in elements[:position])
    ):
        raise DataError(
            f"{where} has lists in its points or before them",
            "the element vertex first, without lists",
        )
    check_fields(vertex.fields, vertex.count, where)
    body = content[offset:]
    if encoding == "ascii":
        lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
        if len(lines) != (wanted := sum(e.count for e in elements)):
            raise size_error(where, len(lines), wanted, "lines")
        start = sum(e.count for e in elements[:position])
        text = "\n".join(lines[start : start + vertex.count])
        return to_arrays(from_text(text, vertex.fields, vertex.count, where))
    size = sum(e.size for e in elements)  # a lower bound if there are lists
    check_size(body, size, where, more=any(e.lists for e in elements))
    start = sum(e.size for e in elements[:position])
    return to_arrays(
        from_records(body[start : start + vertex.size], vertex.fields, vertex.count)
    )


def _parse(start: bytes, where: str) -> tuple[str, list[Element], int]:
    """Encoding, elements, and length of the header in the first bytes of a file."""
    end = re.search(rb"^end_header\r?\n", start, re.M)
    if not start.startswith(b"ply") or end is None:
        raise DataError(
            f"{where} has no header of a .ply file", "a PLY file", SKIP_HINT
        )
    return *_header(start[: end.start()].decode("latin-1"), where), end.end()


def _header(text: str, where: str) -> tuple[str, list[Element]]:
    """Parse the encoding and the elements in order; exactly one of them is ``vertex``."""
    encodings = []
    elements = []
    for line in text.splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in ORDERS:
                encodings.append(name)
            case ["element", name, count] if (
                re.fullmatch("[0-9]{1,12}", count) and encodings
            ):
                elements.append(Element(name, int(count)))
            case ["property", "list", length, kind, _] if (
                length in TYPES and kind in TYPES and elements
            ):
                elements[-1].fields.append(Field("", TYPES[length]))
                elements[-1].lists = True
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].fields.append(
                    Field(name, ORDERS[encodings[0]] + TYPES[kind])
                )
            case _:
                raise DataError(
                    f"{where}: its header cannot be read ({line[:100]!r})",
                    "a PLY file",
                    SKIP_HINT,
                )
    if len(encodings) != 1 or [e.name for e in elements].count("vertex") != 1:
        raise DataError(
            f"{where}: its header cannot be read",
            "one format and one element vertex",
            SKIP_HINT,
        )
    return encodings[0], elements
