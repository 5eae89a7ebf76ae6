"""Pickled tables of pandas (``DataFrame.to_pickle``), read without pandas and without running their
code.

A pickled table names about a dozen functions and classes (``KNOWN``). It holds the columns' names
as an index, and blocks of columns of one type, each an array with the places of its columns. The
spellings are those of pandas 0.25 (which wrote PandaSet) to 3 and of numpy 1 and 2. A file that
names anything else is refused.
"""

import zlib
from collections.abc import Iterable
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import SKIP_HINT, read_file
from lidar_synth.files.parsing import MOST_BYTES
from lidar_synth.files.pickles import (
    DTYPE,
    ENCODE,
    Call,
    bytes_of,
    dtype_of,
    parse_pickle,
)

EXPECTED = "a pickled pandas table of numbers and text"

GZIP = b"\x1f\x8b"

MANAGERS = (
    "pandas.core.internals.managers.BlockManager",
    "pandas.core.internals.BlockManager",
)
BLOCKS = (
    "pandas._libs.internals._unpickle_block",
    "pandas.core.internals.blocks.new_block",
)
FRAMES = ("pandas.core.frame.DataFrame", "pandas.DataFrame")
INDICES = ("pandas.core.indexes.base.Index", "pandas.Index")
MAKE_INDEX = ("pandas.core.indexes.base._new_Index",)
OTHER_INDICES = (
    "pandas.core.indexes.range.RangeIndex",
    "pandas.RangeIndex",
    "pandas.core.indexes.numeric.Int64Index",
)
BACKED_ARRAYS = ("pandas._libs.arrays.__pyx_unpickle_NDArrayBacked",)
STRINGS = (
    "pandas.arrays.StringArray",
    "pandas.core.arrays.string_.StringArray",
    "pandas.core.arrays.string_.StringDtype",
    "pandas.StringDtype",
)
ARRAYS = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
BUFFERS = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
PLAIN_OBJECTS = ("copy_reg._reconstructor", "copyreg._reconstructor")
SLICES = ("builtins.slice", "__builtin__.slice")

KNOWN = frozenset(
    (
        *MANAGERS,
        *BLOCKS,
        *FRAMES,
        *INDICES,
        *MAKE_INDEX,
        *OTHER_INDICES,
        *BACKED_ARRAYS,
        *STRINGS,
        *ARRAYS,
        *BUFFERS,
        *PLAIN_OBJECTS,
        DTYPE,
        ENCODE,
        *SLICES,
        "numpy.ndarray",
        "builtins.object",
        "__builtin__.object",
    )
)
"""The names that may occur in a pickled table; none of them is imported."""

MOST_COLUMNS = 1000
"""Maximum number of columns of a table, and of their blocks; PandaSet's have at most 17."""


def read_table(
    path: Path, columns: Iterable[str], optional: Iterable[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read columns of a pickled table, compressed with gzip or not.

    Args:
        path: the file.
        columns: names of the columns that it must have.
        optional: names of further columns, which are read if they exist.

    Returns:
        {name: (N,) array}: numbers in the table's own types, and objects for columns of text.

    Raises:
        FileError: if the file cannot be read.
        DataError: if it is not a pickled table, would run code, lacks a column, or holds more than
            ``MOST_BYTES``.
    """
    content = read_file(path, EXPECTED, MOST_BYTES)
    if content.startswith(GZIP):
        content = _gunzip(content, path)
    with parsing(path, EXPECTED, SKIP_HINT):
        table = _columns(
            parse_pickle(content, KNOWN, str(path), EXPECTED), {*columns, *optional}
        )
    if missing := [name for name in columns if name not in table]:
        raise DataError(
            f"{path} has no column {', '.join(missing)}",
            f"a table with {', '.join(columns)}",
        )
    if len(lengths := {len(values) for values in table.values()}) > 1:
        raise DataError(
            f"{path} has columns of {sorted(lengths)} rows",
            "columns of one length",
            SKIP_HINT,
        )
    return table


def require_numbers(
    table: dict[str, NDArray[Any]],
    columns: Iterable[str],
    path: Path,
    kinds: str = "iuf",
) -> None:
    """Refuse columns of another type.

    Args:
        table: as ``read_table`` gives it.
        columns: names of columns of numbers.
        path: of the table, for the error.
        kinds: numpy's letters of the types that are accepted; by default integers and
            floating-point numbers.

    Raises:
        DataError: on a column of another type.
    """
    if wrong := [
        f"{name} of type {table[name].dtype}"
        for name in columns
        if table[name].dtype.kind not in kinds
    ]:
        raise DataError(
            f"{path} has columns {', '.join(wrong)}",
            "numbers" if "f" in kinds else "whole numbers",
        )


def _gunzip(content: bytes, path: Path) -> bytes:
    stream = zlib.decompressobj(wbits=31)
    try:
        plain = stream.decompress(content, MOST_BYTES + 1)
    except zlib.error as error:
        raise DataError(f"{path} is damaged ({error})", EXPECTED, SKIP_HINT) from error
    if len(plain) > MOST_BYTES:
        raise DataError(
            f"{path} unpacks into more than {MOST_BYTES} bytes", EXPECTED, SKIP_HINT
        )
    if not stream.eof:
        raise DataError(f"{path} is truncated", EXPECTED, SKIP_HINT)
    return plain


def _columns(frame: Any, wanted: set[str]) -> dict[str, NDArray[Any]]:
    """The wanted columns of a pickled ``DataFrame``."""
    index, parts = _take_apart(frame)
    arrays = _Arrays()
    names = arrays.make(_call(index, MAKE_INDEX).args[1]["data"])
    if names.ndim != 1 or max(len(names), len(parts)) > MOST_COLUMNS:
        raise ValueError(f"{len(names)} columns in {len(parts)} blocks")
    found: dict[str, NDArray[Any]] = {}
    for values, placement in parts:
        places = arrays.places(placement, len(names))
        if not wanted.isdisjoint(block_names := [names[place] for place in places]):
            block = arrays.make(values)
            rows = block if block.ndim == 2 else block[None]
            found |= {
                n: row for n, row in zip(block_names, rows, strict=True) if n in wanted
            }
    return found


def _take_apart(frame: Any) -> tuple[Any, list[Any]]:
    """The index of the columns' names; the values of each block, and the places of its columns."""
    state = _call(frame, FRAMES).state
    manager = _call(state["_mgr"] if "_mgr" in state else state["_data"], MANAGERS)
    if manager.args:  # pandas 1.3 and later
        blocks, axes = manager.args
        return axes[0], [_call(block, BLOCKS).args[:2] for block in blocks]
    [saved] = [part["0.14.1"] for part in manager.state if isinstance(part, dict)]
    parts = [(block["values"], block["mgr_locs"]) for block in saved["blocks"]]
    return saved["axes"][0], parts


def _call(value: Any, names: tuple[str, ...]) -> Call:
    if isinstance(value, Call) and value.name in PLAIN_OBJECTS:  # protocols 0 and 1
        value = Call(value.args[0].text, (), value.state)
    if not isinstance(value, Call) or value.name not in names:
        raise TypeError(f"a {type(value).__name__} instead of {names[0]}")
    return value


class _Arrays:
    """Makes numpy's arrays of calls, as long as all of them together hold at most
    ``MOST_BYTES``."""

    def __init__(self) -> None:
        self.left = MOST_BYTES

    def make(self, value: Any) -> NDArray[Any]:
        """An array of numbers, or of objects that are numbers, text, truth values or None."""
        if isinstance(value, Call) and value.name in BACKED_ARRAYS:  # text in pandas 3
            [value] = [
                part
                for part in value.state
                if isinstance(part, Call) and part.name in ARRAYS
            ]
        if isinstance(value, Call) and value.name in BUFFERS:
            data, dtype, shape, order = value.args
        else:
            _, shape, dtype, fortran, data = _call(value, ARRAYS).state
            order = "F" if fortran else "C"
        _check_shape(shape)
        kind = dtype_of(dtype)
        self.left -= prod(shape) * kind.itemsize
        if self.left < 0:
            raise ValueError(f"more than {MOST_BYTES} bytes of arrays")
        flat = _objects(data) if kind.hasobject else np.frombuffer(bytes_of(data), kind)
        return flat.reshape(shape, order="F" if order == "F" else "C")

    def places(self, value: Any, count: int) -> list[int]:
        """The places of a block's columns among ``count`` columns."""
        if isinstance(value, Call) and value.name in SLICES:
            return list(range(count))[slice(*value.args)]
        places = self.make(value)
        if len(places) > count:
            raise ValueError(f"{len(places)} places for {count} columns")
        return [range(count)[place] for place in places.tolist()]


def _check_shape(shape: Any) -> None:
    lengths = shape if isinstance(shape, tuple) else ()
    if len(lengths) not in (1, 2) or not all(
        type(length) is int and length >= 0 for length in lengths
    ):
        raise ValueError("an array of another shape than (N,) or (N, M)")


def _objects(values: Any) -> NDArray[Any]:
    if not isinstance(values, list) or not all(
        v is None or type(v) in (str, int, float, bool) for v in values
    ):
        raise TypeError("objects that are neither numbers nor text")
    array = np.empty(len(values), object)
    array[:] = values
    return array
