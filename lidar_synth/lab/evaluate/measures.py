"""The kinds of measures: what each keeps of a scan, and how it compares what it kept of two sets.

To add a kind, write its two functions and add a line to ``KINDS``; a protocol in ``protocols/``
then names it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate import lidm
from lidar_synth.lab.evaluate.isolated import count_isolated, isolated_ratio
from lidar_synth.lab.evaluate.labels import CLASSES, class_histogram
from lidar_synth.lab.evaluate.r2flow import BINS, bev_histogram
from lidar_synth.lab.evaluate.ranges import range_histogram, step_histogram
from lidar_synth.lab.evaluate.statistics import (
    Rows,
    Sparse,
    Statistic,
    gaussian_mmd,
    histogram_distance,
    smallest_of_pairs,
    sparse_histogram_distance,
)


class Kind(NamedTuple):
    """A way to compare two sets of scans.

    Args:
        describe: ``(prepared scan, **options) -> description``; measures that share it share the
            description.
        compare: ``(real descriptions, generated descriptions, **options) -> Statistic``.
        labels: whether scans need labels.
    """

    describe: Callable[..., Any]
    compare: Callable[..., Statistic]
    labels: bool = False


def total_variation(p: NDArray[Any], q: NDArray[Any]) -> float:
    """Sum of |p - q| of two normalised histograms, in [0, 2], as R3DPA's code computes its TV."""
    return float(np.abs(p / p.sum() - q / q.sum()).sum())


def normalised_rows(histograms: Sequence[NDArray[Any]]) -> Rows:
    """Histograms as rows that sum to 1 each."""

    def rows(first: int, last: int) -> Tensor:
        counts = torch.from_numpy(
            np.stack(histograms[first:last]).astype(np.float32)
        ).flatten(1)
        return counts / counts.sum(1, keepdim=True)

    return rows


def normalised_sparse_rows(histograms: Sequence[Sparse], size: int) -> Rows:
    """As ``normalised_rows``, of histograms of ``size`` bins that keep only the bins that are not
    empty."""

    def rows(first: int, last: int) -> Tensor:
        dense = torch.zeros(last - first, size)
        for row, one in zip(dense, histograms[first:last], strict=True):
            amounts = torch.from_numpy(one.amounts.astype(np.float32))
            row[torch.from_numpy(one.bins).long()] = amounts / amounts.sum()
        return dense

    return rows


def _bev(scan: Scan, **options: Any) -> NDArray[np.uint32]:
    return bev_histogram(scan.points, **options)


def _occupied(scan: Scan, cell: float) -> NDArray[np.int32]:
    return lidm.find_occupied(scan.points, cell)


def _jsd(real: Sequence[Any], fake: Sequence[Any], **options: Any) -> Statistic:
    return histogram_distance(real, fake)


def _mmd(real: Sequence[Any], fake: Sequence[Any], **options: Any) -> Statistic:
    return gaussian_mmd(
        normalised_rows(real),
        normalised_rows(fake),
        (len(real), len(fake)),
        real[0].size,
    )


def _occupancy(
    distance: Callable[..., Statistic], *more: Any
) -> Callable[..., Statistic]:
    """How often each cell is occupied."""

    def compare(real: Sequence[Any], fake: Sequence[Any], cell: float) -> Statistic:
        once = [
            [Sparse(cells, np.ones(len(cells), np.uint8)) for cells in side]
            for side in (real, fake)
        ]
        return distance(*once, lidm.cells_along(cell) ** 2, *more)

    return compare


def _matching(real: Sequence[Any], fake: Sequence[Any], cell: float) -> Statistic:
    return smallest_of_pairs(lidm.matching_distances(real, fake, cell))


def _class_jsd(
    real: Sequence[Any], fake: Sequence[Any], bins: int = BINS, **options: Any
) -> Statistic:
    return sparse_histogram_distance(real, fake, CLASSES * bins**2)


def _class_mmd(
    real: Sequence[Any], fake: Sequence[Any], bins: int = BINS, **options: Any
) -> Statistic:
    size = CLASSES * bins**2
    rows = [normalised_sparse_rows(side, size) for side in (real, fake)]
    return gaussian_mmd(rows[0], rows[1], (len(real), len(fake)), size)


KINDS = {
    "bev_jsd": Kind(_bev, _jsd),
    "bev_mmd": Kind(_bev, _mmd),
    "occupancy_jsd": Kind(_occupied, _occupancy(sparse_histogram_distance)),
    "occupancy_tv": Kind(
        _occupied, _occupancy(sparse_histogram_distance, total_variation)
    ),
    "minimum_matching": Kind(_occupied, _matching),
    "class_jsd": Kind(class_histogram, _class_jsd, labels=True),
    "class_mmd": Kind(class_histogram, _class_mmd, labels=True),
    "range_jsd": Kind(range_histogram, _jsd),
    "step_mmd": Kind(step_histogram, _mmd),
    "isolated_ratio": Kind(count_isolated, isolated_ratio),
}
"""Kinds by name; those of features are in ``features.py``."""
