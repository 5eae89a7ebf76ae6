"""One file of a bank: scans with consecutive indices, each in chunks of its own.

An HDF5 file. The root attributes are the bank's facts (see ``index``) and ``seed``, ``first``,
``scans`` of this file. The datasets are::

    range, reflectance, label, confidence   (scans, H, W), see ``encoding``; those in ``fields``
    instance                                (scans, H, W), in "lidar-synth-bank/2"
    boxes                                   (scans, 256, 9), see ``boxes``; in "lidar-synth-bank/2"
    seed, index                             (scans,) uint64: seed and index of the scan's noise
    condition                               (scans,) text, in conditional banks: name of the
                                            conditioning scan
    crc                                     (scans,) uint32: CRC-32 of a scan's seed, index,
                                            condition and arrays

A chunk holds one array of one scan: shuffled, deflated (level 1), and followed by its Fletcher-32
checksum, as HDF5's own filters write it, so that any HDF5 library reads it. The file format is that
of HDF5 1.10, whose metadata has checksums: in older formats a flipped bit in an attribute, such as
the scale, would stay undetected. No byte of a file depends on the time of writing.

When a shard is opened, HDF5 reads the attributes and the addresses of the chunks once (``layout``).
Scans are then read directly from the file, with a single read where their chunks are adjacent.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lidar_synth.bank.chunks import checksum, filters, unpack
from lidar_synth.bank.facts import FORMAT, REPAIR, Facts
from lidar_synth.bank.index import Entry
from lidar_synth.bank.layout import ShardLayout, read_attributes, read_layout, with_hdf5
from lidar_synth.bank.storage import LocalFile, Storage
from lidar_synth.errors import DataError, LidarSynthError
from lidar_synth.files.disk import name_errors

_GAP = 16 << 10  # chunks closer together than this many bytes are read at once


class ShardReader:
    """Reads one shard; every scan is checked against its CRC.

    Args:
        file: a path, or an open storage, which is closed with the reader.
        name: name of the file in error messages.
        facts: the facts that the bank's index expects; None accepts those of the file.
        entry: the scans that the bank's index expects; None accepts those of the file.

    Attributes:
        facts: facts of the file.
        entry: scans of the file.
        encoding: encoding of the scans.

    Raises:
        FileError: if it cannot be read.
        DataError: on a file that is not a shard of this version, is damaged, or does not match the
            index.
        LibraryError: on Blosc2 without hdf5plugin.
    """

    def __init__(
        self,
        file: Path | Storage,
        name: str,
        facts: Facts | None = None,
        entry: Entry | None = None,
    ) -> None:
        self.name = name
        self._file = LocalFile(file) if isinstance(file, Path) else file
        try:
            self.facts, self.entry, self._layout = self._open(facts, entry)
        except BaseException:
            self.close()
            raise
        self.encoding = self.facts.encoding

    def read(self, position: int) -> dict[str, NDArray[Any]]:
        """The arrays of one scan, 0 <= position < scans.

        Raises:
            DataError: if it is damaged.
            FileError: if the file cannot be read.
        """
        return self._read(position)[0]

    def condition(self, position: int) -> str | None:
        """The name of the scan that a scan is conditioned on; None in an unconditional bank.

        Raises:
            DataError: if it is not text.
        """
        with self._reading(f"the condition of scan {position}"):
            if self._layout.conditions is None:
                return None
            return self._condition(position).decode()

    def conditions(self, positions: range) -> list[str]:
        """The names of the scans that some scans are conditioned on; [] in an unconditional bank;
        raises as ``condition``."""
        return [name for p in positions if (name := self.condition(p)) is not None]

    def chunks(self, position: int) -> tuple[dict[str, bytes], int]:
        """The compressed chunks of one scan and its CRC, after the checks of ``read``; raises as
        ``read``."""
        return self._read(position)[1], int(self._layout.numbers["crc"][position])

    def close(self) -> None:
        """Close the file; ``reopen`` opens it again."""
        self._file.close()

    def reopen(self) -> bool:
        """Open the file again if it was closed; False if it has changed since, so that it needs a
        new reader.

        Raises:
            FileError: if it cannot be opened.
        """
        return self._file.reopen()

    def __enter__(self) -> "ShardReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(
        self, facts: Facts | None, entry: Entry | None
    ) -> tuple[Facts, Entry, ShardLayout]:
        """Facts and entry from the file's attributes, and the addresses of its scans."""

        def work(file: h5py.File) -> tuple[Facts, Entry, ShardLayout]:
            with self._reading("its attributes"):
                attributes = read_attributes(file)
                numbers = [
                    int(attributes.pop(key, np.uint64(0)))
                    for key in ("seed", "first", "scans")
                ]
            found = Facts.from_attributes(attributes, self.name)
            self._check_facts(found, facts)
            found = facts or found  # one object for all shards of a bank
            actual = self._checked_entry(numbers, entry)
            filters(found.compression)
            with self._reading("its datasets"):
                layout = read_layout(
                    file,
                    self._file,
                    actual.scans,
                    found.encoding.arrays(),
                    found.compression,
                )
            return found, actual, layout

        try:
            return with_hdf5(self._file, facts, entry.scans if entry else 0, work)
        except LidarSynthError:
            raise
        except (OSError, RuntimeError) as error:
            raise DataError(
                f"{self.name} is truncated, damaged or not an HDF5 file ({error})",
                f"a shard of {FORMAT}",
                REPAIR,
            ) from error

    def _check_facts(self, found: Facts, facts: Facts | None) -> None:
        if facts is not None and facts != found:
            mine = found.to_dict()
            others = facts.to_dict()
            wrong = ", ".join(key for key in others if mine[key] != others[key])
            raise DataError(
                f"{self.name}: {wrong} differ from the bank's index",
                "a shard of this bank",
                REPAIR,
            )

    def _checked_entry(self, numbers: list[int], entry: Entry | None) -> Entry:
        seed, first, scans = numbers
        found = Entry(Path(self.name).name, seed, first, scans)
        entry = found if entry is None else entry
        if (seed, first, scans) != (entry.seed, entry.first, entry.scans):
            raise DataError(
                f"{self.name} holds {found.span}",
                f"{entry.span}, according to the bank's index",
                REPAIR,
            )
        return entry

    def _read(self, position: int) -> tuple[dict[str, NDArray[Any]], dict[str, bytes]]:
        """The arrays of a scan and their compressed chunks."""
        with self._reading(f"scan {position}"):
            packed = self._packed(position)
            kinds = self.encoding.arrays()
            arrays = {
                name: unpack(chunk, *kinds[name], self.facts.compression)
                for name, chunk in packed.items()
            }
            seed, index, crc = (
                int(values[position]) for values in self._layout.numbers.values()
            )
            if checksum(seed, index, arrays, self._condition(position)) != crc:
                raise ValueError("its CRC does not match")
            if (seed, index) != (self.entry.seed, self.entry.first + position):
                raise ValueError(f"it is scan {index} of seed {seed}")
        with name_errors(f"{self.name}: scan {position}"):
            self.encoding.check(arrays)
        return arrays, packed

    def _packed(self, position: int) -> dict[str, bytes]:
        """The chunks of a scan; adjacent ones are read at once."""
        places = self._locate(position)
        packed: dict[str, bytes] = {}
        for names in _side_by_side(places):
            start = min(places[name][0] for name in names)
            content = self._file.read(
                start, max(places[name][1] for name in names) - start
            )
            packed |= {
                name: content[places[name][0] - start : places[name][1] - start]
                for name in names
            }
        return {name: packed[name] for name in places}

    def _locate(self, position: int) -> dict[str, tuple[int, int]]:
        """Where in the file the chunks of a scan begin and end."""
        places = {}
        for name, chunks in self._layout.chunks.items():
            offset, size, skipped = (
                int(v[position]) for v in (chunks.offset, chunks.size, chunks.skipped)
            )
            if skipped:
                raise ValueError(f"filters {skipped:b} were not applied")
            if not size:
                raise ValueError(f"its {name} is missing")
            if offset + size > self._file.size:
                raise ValueError(f"its {name} lies outside the file")
            places[name] = (offset, offset + size)
        return places

    def _condition(self, position: int) -> bytes:
        if self._layout.conditions is None:
            return b""
        return bytes(self._layout.conditions[position])

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Convert errors of HDF5 and of invalid values to a DataError that names the file."""
        try:
            yield
        except LidarSynthError:
            raise  # from the storage: the file may be intact but out of reach
        except (
            OSError,
            RuntimeError,
            LookupError,
            ValueError,
            TypeError,
            ArithmeticError,
            MemoryError,
        ) as error:
            raise DataError(
                f"{self.name}: {what} cannot be read ({error})",
                "an intact shard",
                REPAIR,
            ) from error


def _side_by_side(places: dict[str, tuple[int, int]]) -> list[list[str]]:
    """Names in groups of adjacent places (start, end), without gaps of more than ``_GAP`` bytes."""
    groups: list[list[str]] = []
    reached = -_GAP - 1
    for name in sorted(places, key=lambda name: places[name]):
        start, end = places[name]
        if start > reached + _GAP:
            groups.append([])
        groups[-1].append(name)
        reached = max(reached, end)
    return groups
