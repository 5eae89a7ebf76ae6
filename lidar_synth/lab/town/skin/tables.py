"""Quantiles by stratum, and the monotone map from the quantiles of one domain to those of
another."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float32Array

FEWEST = 400
"""Values of a group in both domains from which its own quantiles are taken; smaller groups use
coarser ones."""


def grouped_quantiles(
    value: Float32Array,
    group: NDArray[np.integer],
    groups: int,
    count: int,
) -> tuple[Float32Array, Float32Array]:
    """Quantiles of values by group.

    Args:
        value: (N,) finite values.
        group: (N,) group of each value, 0 to ``groups - 1``.
        groups: G.
        count: Q, quantiles from 0 to 1 in even steps.

    Returns:
        (G, Q) quantiles, 0 for empty groups, and (G,) the number of values.
    """
    ordered = _sorted_in_groups(value, group)
    number = np.bincount(group, minlength=groups)
    start = np.cumsum(number) - number
    place = (
        start[:, None]
        + np.linspace(0, 1, count)[None] * np.maximum(number - 1, 0)[:, None]
    )
    place = np.clip(place, 0, max(len(value) - 1, 0))
    low = np.floor(place).astype(np.int64)
    high = np.minimum(low + 1, np.maximum(start + number - 1, low[:, 0])[:, None])
    table = ordered[low] + (place - low) * (ordered[high] - ordered[low])
    return np.where(number[:, None] > 0, table, 0).astype(np.float32), number.astype(
        np.float32
    )


def _sorted_in_groups(value: Float32Array, group: NDArray[np.integer]) -> Float32Array:
    """(N,) the values in the order of groups, ascending within each; by one sort of integers, which
    is fast."""
    bits = np.ascontiguousarray(value, np.float32).view(np.uint32)
    negative = (bits >> np.uint32(31)).astype(bool)
    ascending = np.where(negative, ~bits, bits | np.uint32(1 << 31))
    keys = np.sort(group.astype(np.uint64) << np.uint64(32) | ascending)
    low = keys.astype(np.uint32)
    positive = (low >> np.uint32(31)).astype(bool)
    return (
        np.where(positive, low & np.uint32(0x7FFFFFFF), ~low)
        .astype(np.uint32)
        .view(np.float32)
    )


def pool_quantiles(
    pairs: Sequence[tuple[Float32Array, NDArray[np.integer]]],
    levels: Sequence[NDArray[np.integer]],
    count: int,
) -> list[Float32Array]:
    """Quantiles of several domains by group, where a group with few values takes those of a coarser
    one.

    Args:
        pairs: of each domain, (N,) values and (N,) groups.
        levels: from fine to coarse, (G,) the set to which each group belongs; the first is
            ``arange(G)``, the last 0.
        count: Q, quantiles.

    Returns:
        Of each domain, (G, Q) quantiles.
    """
    tables = [np.zeros((len(levels[0]), count), np.float32) for _ in pairs]
    missing = np.ones(len(levels[0]), bool)
    for level in levels:
        found = [
            grouped_quantiles(value, level[group], int(level.max()) + 1, count)
            for value, group in pairs
        ]
        enough = np.min([number for _, number in found], axis=0) >= FEWEST
        now = missing & enough[level]
        for table, (quantiles, _) in zip(tables, found, strict=True):
            table[now] = quantiles[level[now]]
        missing &= ~now
    return tables


def lookup(
    source: Float32Array, target: Float32Array, grid: Float32Array
) -> Float32Array:
    """(G, len(grid)) images of the values of ``grid`` by the map from quantiles (G, Q) to quantiles
    (G, Q).

    Values beyond the outer quantiles keep their distance from them.
    """
    out = np.empty((len(source), len(grid)), np.float32)
    for k, (x, y) in enumerate(
        zip(source.astype(float), target.astype(float), strict=True)
    ):
        x, first = np.unique(x, return_index=True)
        # Equal quantiles of the source map to the mean of their targets.
        last = np.append(first[1:], len(y))
        sums = np.concatenate([[0.0], np.cumsum(y)])
        y = (sums[last] - sums[first]) / (last - first)
        beyond = np.minimum(grid - x[0], 0) + np.maximum(grid - x[-1], 0)
        out[k] = np.interp(grid, x, y) + beyond
    return out
