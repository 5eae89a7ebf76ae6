"""Scores of all scans of a bank, and their file.

The file is a numpy ``.npz`` without pickled objects: ``bank``, the identity of its bank;
``reference``, the scans that the histograms were compared with ("" = the bank's own mean);
``twin``; and one array (N,) per score.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.bank import Bank
from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import DataError, check_count
from lidar_synth.files.disk import write_arrays
from lidar_synth.files.parsing import read_arrays
from lidar_synth.files.processes import map_in_processes
from lidar_synth.geometry import Sensor, Source
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.projection import project
from lidar_synth.lab.curate.duplicates import most_similar
from lidar_synth.lab.curate.features import MEASURES, RANGE_BINS, features
from lidar_synth.lab.curate.store import Store, measure

FILE = "scores.npz"
"""Name of the file, in the bank's folder."""

FARTHEST = float(np.sqrt(np.log(2)))
"""The Jensen-Shannon distance of disjoint histograms; also used for a scan without returns or
labels."""

MEANINGS: dict[str, str] = {
    "range": "Jensen-Shannon distance of the range histogram to the mean histogram, 0 to 0.83",
    "labels": "Jensen-Shannon distance of the class histogram to the mean histogram, 0 to 0.83",
    "duplicate": "similarity to the most similar earlier scan in bird's-eye view, 0 to 1",
} | {name: measure.meaning for name, measure in MEASURES.items()}
"""Description of each score."""

_CHUNK = 16  # scans of a reference per task of a worker

Histograms = tuple[NDArray[Any], NDArray[Any]]
"""(RANGE_BINS,) histogram of ranges and (19,) histogram of classes."""


@dataclass(frozen=True)
class Scores:
    """The scores of all scans of a bank.

    Args:
        bank: identity of the bank.
        reference: name of the scans that the histograms were compared with; "" for the bank's own
            mean.
        values: {name: (N,) float64} for the names in ``MEANINGS`` that the bank's fields support.
        twin: (N,) number of the most similar earlier scan, -1 for the first scan.
    """

    bank: str
    reference: str
    values: dict[str, Float64Array]
    twin: NDArray[np.int64]


def score(
    bank: Bank,
    reference: Source | None = None,
    *,
    name: str = "",
    jobs: int = 1,
    progress: bool = True,
    folder: Path | None = None,
) -> Scores:
    """Score every scan of a bank. It needs 2.4 kB per scan on disk and at most 400 bytes per scan
    in memory.

    Args:
        bank: the bank to score.
        reference: scans whose mean histograms to compare with, projected onto the bank's sensor; by
            default the bank's own. Without labels the score ``labels`` is left out.
        name: name of the reference.
        jobs: worker processes.
        progress: show bars.
        folder: stores the features during the run; a killed run resumes with the same folder. By
            default a temporary one.

    Raises:
        ConfigError: on fewer than one job, or an empty reference.
        DataError, FileError: if a scan cannot be read, or the folder cannot be written.
    """
    check_count("jobs", jobs, 1)
    if reference is not None:
        check_count(f"scans of the reference {name!r}", len(reference), 1)
    with TemporaryDirectory() as temporary:
        store = measure(bank, folder or Path(temporary), jobs, progress)
        if reference is None:
            ranges, classes = _means(
                (row["ranges"], row["classes"])
                for rows in store.blocks()
                for row in rows
            )
        else:
            ranges, classes = _means_of(reference, bank.sensor, jobs, progress)
        values = {"range": _distances(store, "ranges", ranges)}
        if "label" in bank.fields and classes.any():
            values["labels"] = _distances(store, "classes", classes)
        numbers = np.concatenate([rows["numbers"] for rows in store.blocks()])
        values |= dict(zip(store.names, numbers.T.copy(), strict=True))
        values["duplicate"], twin = most_similar(store, progress)
    return Scores(
        bank.identity, name, {n: values[n] for n in MEANINGS if n in values}, twin
    )


def write_scores(path: Path, scores: Scores) -> None:
    """Write scores to their file; ``read_scores`` is the inverse.

    Raises:
        FileError: if it cannot be written.
    """
    arrays = {
        "bank": np.array(scores.bank),
        "reference": np.array(scores.reference),
        "twin": scores.twin,
    }
    write_arrays(path, arrays | scores.values)


def read_scores(path: Path) -> Scores:
    """Read scores from their file.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is damaged or another kind of file.
    """
    arrays = read_arrays(path, most=1 << 32)
    values = {name: arrays[name] for name in MEANINGS if name in arrays}
    shapes = {
        array.shape
        for name, array in arrays.items()
        if name in MEANINGS or name == "twin"
    }
    if not {"bank", "reference", "twin", "range"} <= set(arrays) or len(shapes) != 1:
        raise DataError(
            f"{path} holds {sorted(arrays)}",
            "the scores of a bank",
            "Remove it and curate again.",
        )
    return Scores(str(arrays["bank"]), str(arrays["reference"]), values, arrays["twin"])


class _Mean:
    """The mean of normalised histograms with equal weights; empty histograms are ignored."""

    def __init__(self, bins: int) -> None:
        self._total = np.zeros(bins)
        self._count = 0

    def add(self, histogram: NDArray[np.integer]) -> None:
        if histogram.any():
            self._total += histogram / histogram.sum()
            self._count += 1

    @property
    def value(self) -> Float64Array:
        return self._total / max(self._count, 1)


def _means(histograms: Iterable[Histograms]) -> Histograms:
    """The mean histograms of ranges and of classes over all scans."""
    ranges = _Mean(RANGE_BINS)
    classes = _Mean(len(NAMES))
    for of_ranges, of_classes in histograms:
        ranges.add(of_ranges)
        classes.add(of_classes)
    return ranges.value, classes.value


def _means_of(source: Source, sensor: Sensor, jobs: int, progress: bool) -> Histograms:
    work = partial(_of_source, source, sensor)
    count = len(source)
    with map_in_processes(work, range(count), jobs, _CHUNK) as results:
        return _means(
            tqdm(
                results,
                desc="reference",
                total=count,
                unit="scan",
                disable=not progress,
            )
        )


def _of_source(source: Source, sensor: Sensor, number: int) -> Histograms:
    # not the next one instead of a scan that is skipped
    load = getattr(source, "load_or_skip", source.__getitem__)
    if (scan := load(number)) is None:
        return np.zeros(1), np.zeros(1)
    found = features(project(scan, sensor))
    return found.ranges, found.classes


def _distances(store: Store, key: str, mean: Float64Array) -> Float64Array:
    """(N,) Jensen-Shannon distance of each scan's histogram to a mean histogram."""
    # Here, as it imports torch: scores that exist are read without it.
    from lidar_synth.lab.evaluate import jensen_shannon_distance

    known = mean.any()
    found = (
        jensen_shannon_distance(row, mean) if known and row.any() else FARTHEST
        for rows in store.blocks()
        for row in rows[key]
    )
    return np.fromiter(found, np.float64, len(store))
