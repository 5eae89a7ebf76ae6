"""Scores of all scans of a bank, and the file that keeps them.

The file is numpy's ``.npz``, nothing pickled: ``bank``, the identity of the bank that it belongs to, ``reference``,
what the histograms were compared with ("" = the bank's own mean), ``twin``, and one array (N,) per score.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.bake.curate.duplicates import most_alike
from lidar_synth.bake.curate.features import MEASURES, Features, features
from lidar_synth.bank import Bank
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.evaluate import jensen_shannon_distance
from lidar_synth.files import write_file
from lidar_synth.formats.convert import in_processes
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.parsing import read_arrays

FILE = "scores.npz"
"""Name of the file, in the bank's folder."""

FARTHEST = float(np.sqrt(np.log(2)))
"""The Jensen-Shannon distance of what has nothing in common; also that of a scan without anything to compare."""

MEANINGS: dict[str, str] = {
    "range": "Jensen-Shannon distance of the range histogram to the mean one, 0 to 0.83",
    "labels": "Jensen-Shannon distance of the class histogram to the mean one, 0 to 0.83",
    "duplicate": "likeness to the most similar earlier scan, seen from above, 0 to 1",
} | {name: measure.meaning for name, measure in MEASURES.items()}
"""What each score says."""

_CHUNK = 16  # scans that a worker takes at a time


@dataclass(frozen=True)
class Scores:
    """Of all scans of a bank.

    Args:
        bank: its identity.
        reference: what the histograms were compared with; "" for the bank's own mean.
        values: {name: (N,) float64}, of ``MEANINGS`` those that the bank's fields allow.
        twin: (N,) number of the earlier scan that ``duplicate`` compares with, -1 for the first.
    """

    bank: str
    reference: str
    values: dict[str, NDArray[np.float64]]
    twin: NDArray[np.int64]


def score(
    bank: Bank, reference: Source | None = None, *, name: str = "", jobs: int = 1, progress: bool = True
) -> Scores:
    """Score every scan of a bank.

    Args:
        bank: whose scans.
        reference: scans whose mean histograms to compare with, projected onto the bank's sensor; by default the
            bank's own. Without labels there is no score ``labels``.
        name: what to call the reference.
        jobs: worker processes.
        progress: show bars.

    Raises:
        ConfigError: on fewer than one job, or an empty reference.
        DataError, FileError: where a scan cannot be read.
    """
    if jobs < 1 or (reference is not None and len(reference) == 0):
        raise ConfigError(f"{jobs} jobs, a reference of {name!r}", "at least one job, and one scan")
    found = _all_features(partial(_of_bank, bank), len(bank), jobs, progress)
    others = found
    if reference is not None:
        others = _all_features(partial(_of_source, reference, bank.sensor), len(reference), jobs, progress)
    values = {"range": _distances([f.ranges for f in found], [f.ranges for f in others])}
    if "label" in bank.fields and any(f.classes.any() for f in others):
        values["labels"] = _distances([f.classes for f in found], [f.classes for f in others])
    values |= {key: np.array([f.numbers[key] for f in found]) for key in found[0].numbers}
    values["duplicate"], twin = most_alike(np.stack([f.signature for f in found]), progress)
    return Scores(bank.identity, name, {n: values[n] for n in MEANINGS if n in values}, twin)


def write_scores(path: Path, scores: Scores) -> None:
    """The file; ``read_scores`` is the inverse.

    Raises:
        FileError: where it cannot be written.
    """
    arrays = {"bank": np.array(scores.bank), "reference": np.array(scores.reference), "twin": scores.twin}
    write_file(path, lambda file: np.savez(file, allow_pickle=False, **arrays, **scores.values))


def read_scores(path: Path) -> Scores:
    """Scores from their file.

    Raises:
        FileError: where it cannot be read.
        DataError: where it is damaged or something else.
    """
    arrays = read_arrays(path, most=1 << 32)
    values = {name: arrays[name] for name in MEANINGS if name in arrays}
    shapes = {array.shape for name, array in arrays.items() if name in MEANINGS or name == "twin"}
    if not {"bank", "reference", "twin", "range"} <= set(arrays) or len(shapes) != 1:
        raise DataError(f"{path} holds {sorted(arrays)}", "the scores of a bank", "Remove it, and curate again.")
    return Scores(str(arrays["bank"]), str(arrays["reference"]), values, arrays["twin"])


def _all_features(work: "partial[Features]", count: int, jobs: int, progress: bool) -> list[Features]:
    with in_processes(work, range(count), jobs, _CHUNK) as results:
        return list(tqdm(results, desc="scores", total=count, unit="scan", disable=not progress))


def _of_bank(bank: Bank, number: int) -> Features:
    return features(bank.image(number))


def _of_source(source: Source, sensor: Sensor, number: int) -> Features:
    return features(project(source[number], sensor))


def _distances(histograms: Sequence[NDArray[np.int64]], reference: Sequence[NDArray[np.int64]]) -> NDArray[np.float64]:
    """(N,) from each histogram to the mean of the reference, in which every scan that has one counts alike."""
    mean = np.mean([h / h.sum() for h in reference if h.any()] or [np.zeros(len(reference[0]))], axis=0)
    known = mean.any()
    return np.array([jensen_shannon_distance(h, mean) if known and h.any() else FARTHEST for h in histograms])
