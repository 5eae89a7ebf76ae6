"""The kinds of measures: what each keeps of a scan, and how it compares what it kept of two sets.

To add a kind, write its two functions and add a line to ``KINDS``; a protocol in ``protocols/``
then names it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.geometry.scan import Scan
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

Options = Mapping[str, Any]


class Kind(NamedTuple):
    """A way to compare two sets of scans.

    Args:
        describe: ``(prepared scan, options) -> description``; measures that share it share the
            description.
        compare: ``(real descriptions, generated descriptions, options) -> Statistic``.
        labels: whether scans need labels.
    """

    describe: Callable[[Scan, Options], Any]
    compare: Callable[[Sequence[Any], Sequence[Any], Options], Statistic]
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


def _bev(scan: Scan, options: Options) -> NDArray[np.uint32]:
    return bev_histogram(scan.points, **options)


def _occupied(scan: Scan, options: Options) -> NDArray[np.int32]:
    return lidm.find_occupied(scan.points, options["cell"])


def _classes(scan: Scan, options: Options) -> Sparse:
    return class_histogram(scan, **options)


def _ranges(scan: Scan, options: Options) -> NDArray[np.uint32]:
    return range_histogram(scan)


def _steps(scan: Scan, options: Options) -> NDArray[np.uint32]:
    return step_histogram(scan)


def _isolated(scan: Scan, options: Options) -> NDArray[np.int64]:
    return count_isolated(scan)


def _isolated_ratio(
    real: Sequence[Any], fake: Sequence[Any], options: Options
) -> Statistic:
    return isolated_ratio(real, fake)


def _jsd(real: Sequence[Any], fake: Sequence[Any], options: Options) -> Statistic:
    return histogram_distance(real, fake)


def _mmd(real: Sequence[Any], fake: Sequence[Any], options: Options) -> Statistic:
    return gaussian_mmd(
        normalised_rows(real),
        normalised_rows(fake),
        (len(real), len(fake)),
        real[0].size,
    )


def _occupancy(
    distance: Callable[..., Statistic], *more: Any
) -> Callable[[Sequence[Any], Sequence[Any], Options], Statistic]:
    """How often each cell is occupied."""

    def compare(
        real: Sequence[Any], fake: Sequence[Any], options: Options
    ) -> Statistic:
        once = [
            [Sparse(cells, np.ones(len(cells), np.uint8)) for cells in side]
            for side in (real, fake)
        ]
        return distance(*once, lidm.cells_along(options["cell"]) ** 2, *more)

    return compare


def _matching(real: Sequence[Any], fake: Sequence[Any], options: Options) -> Statistic:
    return smallest_of_pairs(lidm.matching_distances(real, fake, options["cell"]))


def _class_jsd(real: Sequence[Any], fake: Sequence[Any], options: Options) -> Statistic:
    return sparse_histogram_distance(real, fake, _class_bins(options))


def _class_mmd(real: Sequence[Any], fake: Sequence[Any], options: Options) -> Statistic:
    bins = _class_bins(options)
    rows = [normalised_sparse_rows(side, bins) for side in (real, fake)]
    return gaussian_mmd(rows[0], rows[1], (len(real), len(fake)), bins)


def _class_bins(options: Options) -> int:
    return CLASSES * int(options.get("bins", BINS)) ** 2


KINDS = {
    "bev_jsd": Kind(_bev, _jsd),
    "bev_mmd": Kind(_bev, _mmd),
    "occupancy_jsd": Kind(_occupied, _occupancy(sparse_histogram_distance)),
    "occupancy_tv": Kind(
        _occupied, _occupancy(sparse_histogram_distance, total_variation)
    ),
    "minimum_matching": Kind(_occupied, _matching),
    "class_jsd": Kind(_classes, _class_jsd, labels=True),
    "class_mmd": Kind(_classes, _class_mmd, labels=True),
    "range_jsd": Kind(_ranges, _jsd),
    "step_mmd": Kind(_steps, _mmd),
    "isolated_ratio": Kind(_isolated, _isolated_ratio),
}
"""Kinds by name; those of features are in ``features.py``."""
