"""Writes a shard; ``shard`` describes its format and reads it."""

import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from lidar_synth.bank.chunks import checksum, deflate, filters
from lidar_synth.bank.facts import Facts
from lidar_synth.bank.index import Entry
from lidar_synth.bank.layout import metadata_size
from lidar_synth.errors import DataError, FileError, LibraryError
from lidar_synth.geometry import RangeImage

_VERSION = "v110"
# Bytes: a paged file keeps its metadata together, for fewer requests over a network.
_PAGE = 4 << 20
_BLOCK = 4 << 20  # bytes by which a shard grows in memory
_PENDING = 8  # scans per thread that may wait to be written


class ShardWriter:
    """Writes one shard. It is built in memory, of which ``close`` takes twice the size of the file,
    and its file is complete only after ``close`` has returned.

    Args:
        path: path of the file; an existing file is overwritten.
        facts: facts of the bank.
        entry: the scans that will be written.
        conditions: name of the scan that conditions each scan, in order.
        threads: number of threads that compress.

    Raises:
        FileError: if the file cannot be written or the disk is full; also by the methods.
        LibraryError: on Blosc2 without hdf5plugin, or h5py with HDF5 before 2.0.
    """

    def __init__(
        self,
        path: Path,
        facts: Facts,
        entry: Entry,
        *,
        conditions: Sequence[str] = (),
        threads: int = 1,
    ) -> None:
        self.path = path
        self.entry = entry
        self.encoding = facts.encoding
        self._compression = facts.compression
        self._direct = facts.compression == "gzip"
        self._conditions = [name.encode() for name in conditions]
        self._crc = np.zeros(entry.scans, np.uint32)
        self._next = 0
        self._waiting: deque[Future[tuple[int, dict[str, Any]]]] = deque()
        self._pool = ThreadPoolExecutor(threads, "compress")
        self._limit = _PENDING * threads
        with _on_disk(path):
            self._file = _create(path.name, facts, entry.scans)
            self._out = path.open("wb")
            try:
                self._declare(facts)
            except BaseException:
                self.discard()
                raise

    def append(self, image: RangeImage) -> None:
        """Add the next scan; a thread encodes and compresses it, and it is written later, in order.

        Raises:
            DataError: on an image that cannot be encoded; possibly raised by a later call.
        """
        position = self._next
        self._next += 1
        self._waiting.append(self._pool.submit(self._pack, position, image))
        self._write_ready(self._limit)

    def append_chunks(self, chunks: Mapping[str, bytes], crc: int) -> None:
        """Add the next scan as compressed chunks from another shard with the same facts."""
        self._write_ready(0)
        self._put(self._next, crc, chunks)
        self._next += 1

    def close(self) -> None:
        """Write the waiting scans and sync the file to the disk.

        Raises:
            DataError: if scans are missing.
            FileError: if it cannot be written.
        """
        self._write_ready(0)
        self._pool.shutdown()
        if self._next != self.entry.scans:
            raise DataError(
                f"{self._next} scans for {self.path}", f"{self.entry.scans}"
            )
        with _on_disk(self.path):
            self._file["crc"][:] = self._crc
            self._file.flush()
            self._out.write(self._file.id.get_file_image())
            self._out.flush()
            os.fsync(self._out.fileno())
            self._out.close()
            self._file.close()

    def discard(self) -> None:
        """Abort and remove the file."""
        self._pool.shutdown(cancel_futures=True)
        with suppress(OSError, RuntimeError):
            self._file.close()
        with suppress(OSError):
            self._out.close()
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise

    def _declare(self, facts: Facts) -> None:
        """Write the attributes and the scans' numbers, and create the datasets of the arrays."""
        count = self.entry.scans
        own = {
            "seed": np.uint64(self.entry.seed),
            "first": np.uint64(self.entry.first),
            "scans": count,
        }
        for name, value in (facts.to_attributes() | own).items():
            self._file.attrs[name] = value
        numbers = {
            "seed": np.full(count, self.entry.seed, "<u8"),
            "index": np.arange(count, dtype="<u8") + np.uint64(self.entry.first),
            "crc": self._crc,
        }
        if self._conditions:
            numbers["condition"] = np.array(self._conditions, "S")
        for name, values in numbers.items():
            self._file.create_dataset(name, data=values, track_times=False)
        self._create_arrays()

    def _create_arrays(self) -> None:
        self._datasets = {
            name: self._file.create_dataset(
                name,
                (self.entry.scans, *shape),
                dtype,
                chunks=(1, *shape),
                fletcher32=True,
                track_times=False,
                **filters(self._compression),
            )
            for name, (shape, dtype) in self.encoding.arrays().items()
        }

    def _pack(self, position: int, image: RangeImage) -> tuple[int, dict[str, Any]]:
        """CRC and chunks or plain arrays of a scan; runs in a thread."""
        arrays = self.encoding.encode(image)
        condition = self._conditions[position] if self._conditions else b""
        crc = checksum(self.entry.seed, self.entry.first + position, arrays, condition)
        return crc, {
            name: deflate(a) if self._direct else a for name, a in arrays.items()
        }

    def _write_ready(self, keep: int) -> None:
        """Write scans, in order, until no more than ``keep`` wait."""
        while len(self._waiting) > keep:
            crc, chunks = self._waiting.popleft().result()
            self._put(self._next - len(self._waiting) - 1, crc, chunks)

    def _put(self, position: int, crc: int, chunks: Mapping[str, Any]) -> None:
        """Write a scan: compressed chunks, or plain arrays, which HDF5 compresses."""
        self._crc[position] = crc
        with _on_disk(self.path):
            for name, chunk in chunks.items():
                if isinstance(chunk, bytes):
                    self._datasets[name].id.write_direct_chunk((position, 0, 0), chunk)
                else:
                    self._datasets[name][position] = chunk


def _create(name: str, facts: Facts, scans: int) -> h5py.File:
    if h5py.version.hdf5_version_tuple < (2,):  # get_file_image has a wrong checksum
        raise LibraryError(
            f"h5py with HDF5 {h5py.version.hdf5_version}",
            "HDF5 2.0 or later, to write a bank",
            "pip install --upgrade h5py",
        )
    # One block, so that a remote reader gets all metadata with one request.
    options: dict[str, Any] = {"meta_block_size": metadata_size(facts, scans)}
    if facts.layout == "paged":
        options = {"fs_strategy": "page", "fs_page_size": _PAGE}
    # In memory: on a full disk, HDF5 would end the process when it cannot write its metadata.
    options |= {"driver": "core", "backing_store": False, "block_size": _BLOCK}
    return h5py.File(name, "w", libver=(_VERSION, _VERSION), **options)


@contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    """Convert HDF5's errors while writing to a FileError that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, LibraryError):
            raise
        reason = (
            os.strerror(error.errno)
            if isinstance(error, OSError) and error.errno
            else str(error)
        )
        raise FileError(
            f"{path} cannot be written ({reason})",
            "a writable folder on a disk with free space",
            "Free some space or fix the folder, then run the same command again: finished shards "
            "are kept.",
        ) from error
