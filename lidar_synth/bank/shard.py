"""One file of a bank: scans with consecutive indices, each a chunk of its own.

HDF5 with root attributes, the bank's facts (see ``index``) and ``seed``, ``first``, ``scans`` of this file, and the
datasets::

    range, reflectance, label, confidence   (scans, H, W), see ``encoding``; those that ``fields`` names
    seed, index                             (scans,) uint64: what the scan was made from
    condition                               (scans,) text, if there is one: the name of what it was conditioned on
    crc                                     (scans,) uint32: CRC-32 of a scan's seed, index, condition and arrays

A chunk holds one scan of one array: bytes shuffled, deflated (level 1), and the Fletcher-32 checksum of that behind,
as HDF5's own filters do it, so that any HDF5 reads it. The file format is HDF5 1.10's, whose metadata has checksums:
with older ones a flipped bit in an attribute, such as the scale, would be read in silence. Nothing in a file depends
on the time of writing.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import h5py
from numpy.typing import NDArray

from lidar_synth.bank.chunks import checksum, filters, inflate
from lidar_synth.bank.index import FORMAT, REPAIR, Entry, Facts
from lidar_synth.errors import DataError, FileError


class ShardReader:
    """Reads one shard; every scan is checked against its CRC.

    Args:
        file: a path, or an open binary file.
        name: what to call it in errors.
        facts: what its attributes have to say, as the bank's index has it; None to take what they say.
        entry: which scans it has to hold; None to take what it says.

    Attributes:
        facts, entry, encoding: of the file.

    Raises:
        FileError: where it cannot be read.
        DataError: on a file that is no shard of this version, is damaged, or is not what the index says.
        LibraryError: on Blosc2 without hdf5plugin.
    """

    def __init__(
        self,
        file: Path | BinaryIO,
        name: str,
        facts: Facts | None = None,
        entry: Entry | None = None,
    ) -> None:
        self.name = name
        self._handle = _open_plain(file, name) if isinstance(file, Path) else file
        self._file = _open(self._handle, name)
        try:
            self._read_facts(facts, entry)
            self._read_datasets()
        except BaseException:
            self.close()
            raise

    def read(self, position: int) -> dict[str, NDArray[Any]]:
        """The arrays of one scan, 0 <= position < scans.

        Raises:
            DataError: where it is damaged.
        """
        with self._reading(f"scan {position}"):
            arrays = {name: self._array(name, position) for name in self._datasets}
            seed, index, crc = (int(self._numbers[n][position]) for n in ("seed", "index", "crc"))
            if checksum(seed, index, arrays, self._condition(position)) != crc:
                raise OSError("its CRC does not match")
            if (seed, index) != (self.entry.seed, self.entry.first + position):
                raise OSError(f"it is scan {index} of seed {seed}")
        return arrays

    def condition(self, position: int) -> str | None:
        """The name of what a scan is conditioned on."""
        return None if self._conditions is None else self._condition(position).decode()

    def chunks(self, position: int) -> tuple[dict[str, bytes], int]:
        """The chunks of one scan as they are in the file, and its CRC; checked by ``read`` before."""
        self.read(position)
        with self._reading(f"scan {position}"):
            found = {name: self._chunk(name, position) for name in self._datasets}
        return found, int(self._numbers["crc"][position])

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError, RuntimeError):
            self._file.close()
        self._handle.close()

    def __enter__(self) -> "ShardReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_facts(self, facts: Facts | None, entry: Entry | None) -> None:
        """Facts and entry, by the file's attributes."""
        with self._reading("its attributes"):
            attributes = dict(self._file.attrs)
            seed, first, scans = (int(attributes.pop(key, 0)) for key in ("seed", "first", "scans"))
        self.facts = Facts.from_attributes(attributes, self.name)
        if facts is not None and facts != self.facts:
            mine, others = self.facts.to_dict(), facts.to_dict()
            wrong = ", ".join(key for key in others if mine[key] != others[key])
            raise DataError(f"{self.name}: {wrong} are not those of the bank's index", "a shard of it", REPAIR)
        found = Entry(Path(self.name).name, seed, first, scans)
        self.entry = found if entry is None else entry
        if (seed, first, scans) != (self.entry.seed, self.entry.first, self.entry.scans):
            raise DataError(f"{self.name} holds {found.span}", f"{self.entry.span}, by the bank's index", REPAIR)
        self.encoding = self.facts.encoding

    def _read_datasets(self) -> None:
        filters(self.facts.compression)
        count, self._layout = self.entry.scans, self.encoding.arrays()
        with self._reading("its datasets"):
            self._numbers = {n: self._file[n][:] for n in ("seed", "index", "crc")}
            self._conditions = self._file["condition"][:] if "condition" in self._file else None
            self._datasets = {n: self._file[n] for n in self._layout}
            shapes = {n: (d.shape, d.dtype) for n, d in self._datasets.items()}
            expected = {n: ((count, *shape), dtype) for n, (shape, dtype) in self._layout.items()}
            if shapes != expected or any(v.shape != (count,) for v in self._numbers.values()):
                raise OSError(f"they are {shapes}, not {expected}")

    def _array(self, name: str, position: int) -> NDArray[Any]:
        """One array of a scan."""
        if self.facts.compression != "gzip":
            values: NDArray[Any] = self._datasets[name][position]
            return values
        return inflate(self._chunk(name, position), *self._layout[name])

    def _chunk(self, name: str, position: int) -> bytes:
        """The chunk that holds one array of a scan, as it is in the file."""
        skipped, chunk = self._datasets[name].id.read_direct_chunk((position, 0, 0))
        if skipped:
            raise OSError(f"filters {skipped:b} were left out")
        return bytes(chunk)

    def _condition(self, position: int) -> bytes:
        return b"" if self._conditions is None else bytes(self._conditions[position])

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """HDF5's errors in words that help."""
        try:
            yield
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise DataError(f"{self.name}: {what} cannot be read ({error})", "a whole shard", REPAIR) from error


def _open_plain(path: Path, name: str) -> BinaryIO:
    """A shard on disk, for HDF5 to read through Python.

    By its path HDF5 would open a file once for the whole process, and refuse to do so with other settings than those of
    whoever has it open already, plain h5py for instance.
    """
    try:
        return path.open("rb", buffering=0)
    except OSError as error:
        reason = error.strerror or error
        raise FileError(f"shard {name} cannot be read ({reason})", "a shard of the bank", REPAIR) from error


def _open(file: BinaryIO, name: str) -> h5py.File:
    try:
        # A chunk is a whole scan and read once: a cache would only cost memory, in every worker.
        return h5py.File(file, "r", rdcc_nbytes=0)
    except (OSError, RuntimeError) as error:
        file.close()
        raise DataError(f"{name} is cut, damaged or no HDF5 file ({error})", f"a shard of {FORMAT}", REPAIR) from error
