"""Arrays of scans on disk, which the processes of a run make together, with checksums."""

import json
import os
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import reading, write_file, writing
from lidar_synth.files.parsing import read_sealed, seal
from lidar_synth.files.processes import map_in_processes
from lidar_synth.lab.train.ranks import ALONE, Ranks
from lidar_synth.lab.train.resume import flatten, without_wording

Arrays = Mapping[str, NDArray[Any]]
"""{field: the values of one scan, or of all}."""

Kind = tuple[tuple[int, ...], type[np.generic]]
"""Shape and type of an array; the first length is the number of scans."""

Layout = Mapping[str, Kind]
"""{field: shape and type}."""

BLOCK = 16
"""Scans that share a checksum: they are noted when they are complete, and made again if they are
damaged."""

NOTE = "cache.json"
"""The file beside the arrays that says what they hold, with the checksums of their blocks."""
FILES = "files"
"""The fact about the files of the scans, which earlier versions did not note."""


def make_arrays(
    layout: Layout,
    make: Callable[[int], Arrays],
    named: str,
    folder: Path | None = None,
    facts: Mapping[str, Any] | None = None,
    ranks: Ranks = ALONE,
    progress: bool = True,
    jobs: int = 1,
) -> dict[str, NDArray[Any]]:
    """Arrays of values of scans, made once.

    Args:
        layout: of the arrays.
        make: the number of a scan to its part of each array.
        named: what is made, for the bar.
        folder: keep the arrays there, memory-mapped: a second call finds them, an interrupted one
            goes on; by default they are in memory, of one process.
        facts: what tells them from others, plain values.
        ranks: the processes that share the work; all of them see the same ``folder``.
        progress: show a bar.
        jobs: processes that work for this one, where it is the only one and has a ``folder``;
            ``make`` can then be pickled.

    Raises:
        ConfigError: where ``folder`` holds something else.
        FileError: where it cannot be written.
    """
    if folder is None:
        arrays: dict[str, NDArray[Any]] = {n: np.empty(*layout[n]) for n in layout}
        for i in tqdm(range(_count(layout)), desc=named, disable=not progress):
            for name, values in make(i).items():
                arrays[name][i] = values
        return arrays
    told: dict[str, Any] = json.loads(json.dumps(facts))
    sums = ranks.ask_first(lambda: _open_folder(folder, told, layout))
    _check_blocks(folder, layout, sums, ranks)
    keep = _Keep(folder, layout, make)
    scans = [i for i in range(_count(layout)) if sums[i // BLOCK] is None]
    shown = progress and ranks.first and scans
    with _map(keep, scans, ranks, jobs) as found:
        bar = tqdm(found, desc=named, total=len(scans), disable=not shown)
        block: list[int] = []
        for total, i in zip(bar, scans, strict=True):
            block.append(total)
            if i + 1 == _count(layout) or (i + 1) % BLOCK == 0:
                sums[i // BLOCK] = _join(block)
                block.clear()
                if ranks.first:
                    _note(folder, told, sums)
    return _open_arrays(folder, layout)


@dataclass(frozen=True)
class _Keep:
    """Makes the values of a scan and writes them; returns their sum."""

    folder: Path
    layout: Layout
    make: Callable[[int], Arrays]

    def __call__(self, i: int) -> int:
        made = {n: _fit(self.layout[n], values) for n, values in self.make(i).items()}
        _write(self.folder, i - _count(self.layout), made)
        return _sum(made)


def _map(
    keep: _Keep, scans: Sequence[int], ranks: Ranks, jobs: int
) -> AbstractContextManager[Iterator[int]]:
    """The sums of scans in order, made by all ranks, or by the processes of the only one."""
    if ranks.size > 1 or jobs == 1:
        return nullcontext(ranks.map(keep, scans))
    return map_in_processes(keep, scans, jobs, BLOCK)


def _count(layout: Layout) -> int:
    """The number of scans."""
    return next(iter(layout.values()))[0][0]


def _blocks(layout: Layout) -> list[range]:
    """The numbers of the scans of each block."""
    every = range(_count(layout))
    return [every[start : start + BLOCK] for start in every[::BLOCK]]


def _open_folder(
    folder: Path, facts: dict[str, Any], layout: Layout
) -> list[int | None]:
    """The noted sum of each block, of files that are there; None where it is to be made."""
    try:
        if (folder / NOTE).exists():
            return _read_note(folder, facts, layout)
    except (DataError, FileError) as error:
        warnings.warn(f"{error}; the cache is made again", stacklevel=2)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, (shape, dtype) in layout.items():
            path = folder / f"{name}.npy"
            # Another run may read the old file, which must not shrink under it.
            path.unlink(missing_ok=True)
            np.lib.format.open_memmap(path, "w+", dtype, shape)
    except OSError as error:
        raise FileError(
            f"the cache {folder} cannot be opened ({error})",
            "a folder that can be written",
        ) from error
    sums: list[int | None] = [None] * len(_blocks(layout))
    # Another run that opens the folder now does not empty the files.
    _note(folder, facts, sums)
    return sums


def _read_note(folder: Path, facts: dict[str, Any], layout: Layout) -> list[int | None]:
    """The noted sums of the blocks.

    Raises:
        ConfigError: if they are those of other data.
        DataError, FileError: if the files are damaged as a whole.
    """
    found = read_sealed(folder / NOTE, "the notes of a cache")
    sums = found.pop("sums", None)
    if FILES in facts:
        found.setdefault(FILES, facts[FILES])
    old, new = (flatten(without_wording(some)) for some in (found, facts))
    if differs := [key for key in old | new if old.get(key) != new.get(key)]:
        raise ConfigError(
            f"{folder} is the cache of other data ({', '.join(differs)} differ)",
            "the cache of this configuration",
            "Remove it, or name another folder.",
        )
    count = len(_blocks(layout))
    if not isinstance(sums, list) or len(sums) != count:
        raise DataError(f"{folder / NOTE} is damaged", f"{count} checksums")
    _open_arrays(folder, layout)
    return sums


def _check_blocks(
    folder: Path, layout: Layout, sums: list[int | None], ranks: Ranks
) -> None:
    """Forget the sums of damaged blocks, with a warning."""
    arrays = _open_arrays(folder, layout)
    blocks = _blocks(layout)
    noted = [number for number, wanted in enumerate(sums) if wanted is not None]

    def intact(number: int) -> bool:
        scans = ({n: a[i] for n, a in arrays.items()} for i in blocks[number])
        return sums[number] == _join(_sum(scan) for scan in scans)

    whole = ranks.map(intact, noted)
    damaged = [n for n, fine in zip(noted, whole, strict=True) if not fine]
    for number in damaged:
        sums[number] = None
    if damaged and ranks.first:
        spans = [f"{blocks[n].start} to {blocks[n].stop - 1}" for n in damaged[:5]]
        more = f" and {len(damaged) - 5} more blocks" if len(damaged) > 5 else ""
        warnings.warn(
            f"{folder}: scans {', '.join(spans)}{more} are damaged, and are made again",
            stacklevel=2,
        )


def _fit(kind: Kind, values: NDArray[Any]) -> NDArray[Any]:
    """The values of a scan in the shape and type of their array."""
    shape, dtype = kind
    return np.ascontiguousarray(values, dtype).reshape(shape[1:])


def _write(folder: Path, place: int, made: Arrays) -> None:
    """Write the values of a scan into the files; ``place`` counts from the end, below 0.

    Not through a memory map: where machines share the folder, one would overwrite what another one
    has written to the same page, and a full disk would end the process without a word.
    """
    for name, values in made.items():
        path = folder / f"{name}.npy"
        with writing(path), path.open("r+b") as file:
            file.seek(place * values.nbytes, os.SEEK_END)
            file.write(values.data)


def _open_arrays(folder: Path, layout: Layout) -> dict[str, NDArray[Any]]:
    return {n: _open_array(folder / f"{n}.npy", *layout[n]) for n in layout}


def _open_array(
    path: Path, shape: tuple[int, ...], dtype: type[np.generic]
) -> NDArray[Any]:
    """Map an ``.npy`` file of this shape and type into memory; its header has to be the one that
    numpy writes.

    Raises:
        DataError: on another file.
        FileError: if it cannot be read.
    """
    header = BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {
            "descr": np.lib.format.dtype_to_descr(np.dtype(dtype)),
            "fortran_order": False,
            "shape": shape,
        },
    )
    start = header.getvalue()
    with reading(path, "a file of a cache"):
        size = path.stat().st_size
        with path.open("rb") as file:
            same = file.read(len(start)) == start
        if not same or size != len(start) + prod(shape) * np.dtype(dtype).itemsize:
            raise DataError(
                f"{path} is truncated or damaged", f"{np.dtype(dtype)} of shape {shape}"
            )
        return np.memmap(path, dtype, "r", len(start), shape)


def _sum(made: Arrays) -> int:
    """A CRC-32 over the values of a scan, field by field."""
    total = 0
    for name in sorted(made):
        total = zlib.crc32(np.ascontiguousarray(made[name]).data, total)
    return total


def _join(sums: Iterable[int]) -> int:
    """The sum of a block from those of its scans."""
    return zlib.crc32(np.array(list(sums), "<u4").data)


def _note(folder: Path, facts: dict[str, Any], sums: list[int | None]) -> None:
    write_file(folder / NOTE, seal(facts | {"sums": sums}))
