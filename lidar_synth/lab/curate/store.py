"""The features of a bank's scans on disk, so that the bank may be larger than the memory.

A file holds ``BLOCK`` scans, 2.4 kB each, and is written atomically: a killed run resumes after the
existing files.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

import lidar_synth
from lidar_synth.bank import INDEX, Bank
from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import write_file
from lidar_synth.files.lock import lock_shared, try_lock
from lidar_synth.files.processes import map_in_processes
from lidar_synth.lab.curate.features import (
    RANGE_BINS,
    SIGNATURE,
    features,
    supported_measures,
)

BLOCK = 4096
"""Scans per file."""

FOLDER = ".curate"
"""Folder with the features, in the bank's folder while it is being scored."""

_UNIT = 64  # scans per task of a worker


class Store:
    """Rows of features, one for each scan of a bank.

    Args:
        folder: folder of the files.
        count: number of rows in the complete store.
        names: names of the measured numbers.

    Attributes:
        dtype: type of a row: ``ranges``, ``classes``, ``numbers`` and ``signature``, as in
            ``ScanFeatures``.
    """

    def __init__(self, folder: Path, count: int, names: tuple[str, ...]) -> None:
        self.folder = folder
        self.count = count
        self.names = names
        self.dtype = np.dtype(
            [
                ("ranges", "<u4", RANGE_BINS),
                ("classes", "<u4", len(NAMES)),
                ("numbers", "<f8", len(names)),
                ("signature", "<f2", SIGNATURE),
            ]
        )

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, rows: "slice | NDArray[np.int64]") -> NDArray[np.float16]:
        """The signatures of some rows, read from the files without caching."""
        numbers = np.arange(self.count)[rows] if isinstance(rows, slice) else rows
        found = np.empty((len(numbers), SIGNATURE), np.float16)
        for block in np.unique(numbers // BLOCK).tolist():
            here = numbers // BLOCK == block
            found[here] = self.read(block)["signature"][numbers[here] % BLOCK]
        return found

    def read(self, block: int) -> NDArray[Any]:
        """The rows of a file, memory-mapped.

        Raises:
            FileError: if it cannot be read.
            DataError: if it holds other data.
        """
        path = self._path(block)
        try:
            rows: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
        except OSError as error:
            raise FileError(
                f"{path} cannot be read ({error.strerror or error})",
                "what was measured",
            ) from error
        except ValueError as error:
            raise DataError(
                f"{path} is damaged ({error})", "what was measured"
            ) from error
        if rows.dtype != self.dtype or rows.shape != (
            min(BLOCK, self.count - block * BLOCK),
        ):
            raise DataError(
                f"{path} holds {rows.shape} of {rows.dtype}", "what was measured"
            )
        return rows

    def blocks(self) -> Iterator[NDArray[Any]]:
        """The rows of each file, in order."""
        return map(self.read, range(-(-self.count // BLOCK)))

    def write(self, block: int, rows: NDArray[Any]) -> None:
        """Write the rows of a file.

        Raises:
            FileError: if it cannot be written.
        """
        write_file(
            self._path(block),
            lambda file: np.save(file, rows, allow_pickle=False),
            durable=True,
        )

    def stored(self) -> int:
        """Number of rows in the existing files, up to the first missing or damaged one."""
        for block in range(-(-self.count // BLOCK)):
            try:
                self.read(block)
            except (FileError, DataError):
                return block * BLOCK
        return self.count

    def _path(self, block: int) -> Path:
        return self.folder / f"features-{block:06d}.npy"


def measure(bank: Bank, folder: Path, jobs: int, progress: bool) -> Store:
    """Measure the features of all scans of a bank; existing files in the folder are reused.

    Raises:
        DataError, FileError: if a scan cannot be read, or the folder cannot be written.
    """
    # not reused by others
    own = folder / f"{bank.identity[:16]}-{lidar_synth.__version__}"
    store = Store(own, len(bank), supported_measures(bank.fields))
    start = store.stored()
    spans = [
        range(a, min(a + _UNIT, len(bank))) for a in range(start, len(bank), _UNIT)
    ]
    waiting: list[NDArray[Any]] = []
    with (
        map_in_processes(partial(_rows, bank, store), spans, jobs) as results,
        tqdm(
            total=len(bank),
            initial=start,
            desc="scores",
            unit="scan",
            disable=not progress,
        ) as bar,
    ):
        for rows in results:
            waiting.append(rows)
            bar.update(len(rows))
            start += len(rows)
            if start % BLOCK == 0 or start == len(bank):
                store.write((start - 1) // BLOCK, np.concatenate(waiting))
                waiting.clear()
    return store


def _rows(bank: Bank, store: Store, span: range) -> NDArray[Any]:
    rows = np.empty(len(span), store.dtype)
    for row, number in zip(rows, span, strict=True):
        found = features(bank.image(number))
        row["ranges"] = found.ranges
        row["classes"] = found.classes
        row["signature"] = found.signature
        row["numbers"] = [found.numbers[name] for name in store.names]
    return rows


@contextmanager
def keep_features_in(root: Path) -> Iterator[Path]:
    """A folder in the bank's folder for its features; removed at the end, kept if the run is killed
    or fails."""
    with lock_shared(root / INDEX):
        yield root / FOLDER
    with try_lock(root / INDEX) as exclusive, suppress(OSError):
        if exclusive:
            shutil.rmtree(root / FOLDER)
