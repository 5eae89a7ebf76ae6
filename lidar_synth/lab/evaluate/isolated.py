"""Isolated returns: those that no surface explains. A generator that doubts which of two
surfaces a ray meets sprays returns between them, which a bird's-eye view shows as fans
along the rays and no measure of histograms sees."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidar_synth.datasets.classes import NAMES
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.statistics import Counts, Statistic

RANGE = 8.0, 35.0
"""Interval of the ranges of the returns that count, metres."""
NEIGHBOURS = 3
TOLERANCE = 0.15, 0.02
"""A return is isolated if so many neighbours are not within this distance: metres, and
metres per metre of range."""


def count_isolated(scan: Scan) -> NDArray[np.int64]:
    """(2, 20) numbers of isolated returns and of all returns between 8 and 35 m, by
    train id; the last column holds returns without a label."""
    distance = np.linalg.norm(scan.points, axis=1)
    near = (distance >= RANGE[0]) & (distance <= RANGE[1])
    kinds = np.full(near.sum(), len(NAMES))
    if scan.label is not None:
        kinds = np.minimum(scan.label[near], len(NAMES))
    found = np.ones(len(kinds), bool)
    if len(scan) > NEIGHBOURS:
        # The nearest one is the return itself.
        apart, _ = cKDTree(scan.points).query(scan.points[near], [NEIGHBOURS + 1])
        found = apart[:, 0] > TOLERANCE[0] + TOLERANCE[1] * distance[near]
    counts = [np.bincount(k, minlength=len(NAMES) + 1) for k in (kinds[found], kinds)]
    return np.array(counts, np.int64)


def share_of_isolated(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """The share of isolated returns of counts (2, ...), NaN where there is no return."""
    return np.asarray(counts[0] / np.where(counts[1] > 0, counts[1], np.nan))


def isolated_ratio(
    real: Sequence[NDArray[np.int64]], fake: Sequence[NDArray[np.int64]]
) -> Statistic:
    """The share of isolated returns of generated scans over that of real ones."""
    sums = [np.stack([one.sum(1) for one in side]) for side in (real, fake)]

    def at(a: Counts, b: Counts) -> NDArray[np.float64]:
        shares = [
            share_of_isolated((counts @ rows).T)
            for counts, rows in zip((a, b), sums, strict=True)
        ]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.divide(shares[1], shares[0])

    return Statistic(at, (len(real), len(fake)))
