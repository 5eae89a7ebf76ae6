"""Distances between two sets as functions of how often each sample counts, from which ``intervals``
resamples.

A ``Statistic`` takes the counts of R resamples of both sets, (R, N) and (R, M), and returns R
values. With every count 1 it is the distance itself.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.evaluate.distances import (
    checked_features,
    frechet_of_moments,
    jensen_shannon_distance,
)

Counts = NDArray[np.integer[Any]]

_BLOCK = 1000  # samples compared with one another at a time: 4 MB of kernel values in float32
_NUMBERS = 25_000_000  # numbers of the samples of a block: 100 MB in float32


class Statistic(NamedTuple):
    """A distance between N real and M generated samples.

    Args:
        at: ``(counts (R, N), counts (R, M)) -> (R,)`` values.
        sizes: (N, M).
    """

    at: Callable[[Counts, Counts], Float64Array]
    sizes: tuple[int, int]

    @property
    def value(self) -> float:
        """The distance of the two sets as they are."""
        return float(self.at(*(np.ones((1, n), np.int64) for n in self.sizes))[0])


def histogram_distance(
    real: Sequence[NDArray[Any]],
    fake: Sequence[NDArray[Any]],
    distance: Callable[[NDArray[Any], NDArray[Any]], float] = jensen_shannon_distance,
) -> Statistic:
    """A distance between the sums of two sets of histograms, each an array of counts of one
    shape."""
    return sparse_histogram_distance(
        [_sparse(h) for h in real], [_sparse(h) for h in fake], real[0].size, distance
    )


def sparse_histogram_distance(
    real: Sequence["Sparse"],
    fake: Sequence["Sparse"],
    size: int,
    distance: Callable[[NDArray[Any], NDArray[Any]], float] = jensen_shannon_distance,
) -> Statistic:
    """As ``histogram_distance``, of histograms of ``size`` bins that keep only the bins that are
    not empty.

    Only the bins that some histogram uses are compared: of the 4 million cells of LiDM's grid, the
    fewest.
    """
    filled = np.zeros(size, bool)
    for one in (*real, *fake):
        filled[one.bins] = True
    place = np.cumsum(filled, dtype=np.int32) - 1
    used = int(filled.sum())

    def at(a: Counts, b: Counts) -> Float64Array:
        sums = (
            (_sum(real, p, place, used), _sum(fake, q, place, used))
            for p, q in zip(a, b, strict=True)
        )
        return np.array([distance(p, q) for p, q in sums])

    return Statistic(at, (len(real), len(fake)))


class Sparse(NamedTuple):
    """A histogram: the numbers of its bins that are not empty, and what they hold."""

    bins: NDArray[np.int32]
    amounts: NDArray[Any]


def _sparse(histogram: NDArray[Any]) -> Sparse:
    bins = np.flatnonzero(histogram)
    return Sparse(bins.astype(np.int32), histogram.ravel()[bins])


def _sum(
    histograms: Sequence[Sparse],
    counts: NDArray[Any],
    place: NDArray[np.int32],
    size: int,
) -> NDArray[np.int64]:
    """(size,) weighted sum of histograms; ``place`` says where each of their bins lies in it."""
    total = np.zeros(size, np.int64)
    for one, count in zip(histograms, counts, strict=True):
        if count:
            # A bin occurs once in a histogram.
            total[place[one.bins]] += one.amounts * np.int64(count)
    return total


Rows = Callable[[int, int], Tensor]
"""``(first, last) -> (last - first, D)`` samples as vectors, float32 or float64."""


def gaussian_mmd(
    real: Rows,
    fake: Rows,
    sizes: tuple[int, int],
    width: int,
) -> Statistic:
    """Squared maximum mean discrepancy, kernel exp(-|p - q|^2 / (2 sigma^2)) with sigma = 0.5,
    including pairs of a sample with itself (Gretton et al., JMLR 2012, the biased form).

    The kernel of normalised histograms is close to 1 everywhere and the ones cancel in the sum, so
    that float32 suffices without them.

    Args:
        real, fake: the samples.
        sizes: numbers of samples.
        width: D of the samples.
    """
    block = max(16, min(_BLOCK, _NUMBERS // width))

    def less_one(p: Tensor, q: Tensor) -> Tensor:
        own = p.square().sum(1)
        squared = own[:, None] + q.square().sum(1) - 2 * p @ q.T
        return torch.expm1(-2 * squared.clamp_(min=0))

    def at(a: Counts, b: Counts) -> Float64Array:
        mean = [
            _mean_kernel(less_one, *pair, block)
            for pair in ((real, a, real, a), (fake, b, fake, b), (real, a, fake, b))
        ]
        return mean[0] + mean[1] - 2 * mean[2]

    return Statistic(at, sizes)


def _mean_kernel(
    kernel: Callable[[Tensor, Tensor], Tensor],
    p: Rows,
    a: Counts,
    q: Rows,
    b: Counts,
    size: int,
) -> Float64Array:
    """(R,) mean of the kernel over all pairs, by the counts (R, N) and (R, M); ``size`` samples at
    a time."""
    left, right = (torch.from_numpy(np.asarray(c, np.float32)) for c in (a, b))
    same = p is q and a is b
    total = torch.zeros(len(left), dtype=torch.float64)
    for i in range(0, left.shape[1], size):
        x = p(i, min(i + size, left.shape[1]))
        for j in range(i if same else 0, right.shape[1], size):
            y = x if same and j == i else q(j, min(j + size, right.shape[1]))
            block = kernel(x, y)
            part = (
                (
                    (left[:, i : i + size].to(block) @ block)
                    * right[:, j : j + size].to(block)
                )
                .double()
                .sum(1)
            )
            total += 2 * part if same and j > i else part
    pairs = left.double().sum(1) * right.double().sum(1)
    return (total / pairs).numpy()


def frechet(real: NDArray[np.floating], fake: NDArray[np.floating]) -> Statistic:
    """Squared Fréchet distance of the Gaussians that fit (N, D) and (M, D) features; see
    ``frechet_distance``.

    Raises:
        DataError: as ``frechet_distance``.
    """
    sets = checked_features(real, fake)

    def at(a: Counts, b: Counts) -> Float64Array:
        return np.array(
            [
                frechet_of_moments(*_moments(sets[0], p), *_moments(sets[1], q))
                for p, q in zip(a, b, strict=True)
            ]
        )

    return Statistic(at, (len(sets[0]), len(sets[1])))


def _moments(
    features: Float64Array, counts: Counts
) -> tuple[Float64Array, Float64Array]:
    kept = counts > 0
    features = features[kept]
    counts = counts[kept]
    mean = np.average(features, axis=0, weights=counts)
    return mean, np.atleast_2d(np.cov(features, rowvar=False, fweights=counts))


def polynomial_mmd(real: NDArray[np.floating], fake: NDArray[np.floating]) -> Statistic:
    """Unbiased squared maximum mean discrepancy under the kernel (x . y / D + 1)^3 over all pairs
    of different samples (Binkowski et al., ICLR 2018). In a resample, copies of a sample are no
    pair of different samples either.

    Raises:
        DataError: as ``frechet_distance``.
    """
    sets = checked_features(real, fake)
    x, y = (torch.from_numpy(s) for s in sets)
    rows = [lambda i, j, s=s: s[i:j] for s in (x, y)]
    diagonals = []
    for features in (x, y):
        squared = features.square().sum(1)
        diagonals.append(((squared / features.shape[1] + 1) ** 3).numpy())

    def kernel(p: Tensor, q: Tensor) -> Tensor:
        return (p @ q.T / x.shape[1] + 1) ** 3

    def within(k: int, counts: Counts) -> Float64Array:
        pairs = counts.sum(1).astype(np.float64) ** 2
        own = counts.astype(np.float64) ** 2
        total = (
            _mean_kernel(kernel, rows[k], counts, rows[k], counts, _BLOCK) * pairs
            - own @ diagonals[k]
        )
        # copies of one sample only: there is no pair
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(total / (pairs - own.sum(1)))

    def at(a: Counts, b: Counts) -> Float64Array:
        return (
            within(0, a)
            + within(1, b)
            - 2 * _mean_kernel(kernel, rows[0], a, rows[1], b, _BLOCK)
        )

    return Statistic(at, (len(x), len(y)))


def smallest_of_pairs(distances: NDArray[np.floating]) -> Statistic:
    """Mean over N real samples of the smallest distance to a generated one (Achlioptas et al., ICML
    2018).

    Args:
        distances: (N, M) of every pair.
    """

    def at(a: Counts, b: Counts) -> Float64Array:
        values = []
        for p, q in zip(a, b, strict=True):
            nearest = distances[:, q > 0].min(1).astype(np.float64)
            values.append(np.average(nearest, weights=p))
        return np.array(values)

    rows, columns = distances.shape
    return Statistic(at, (rows, columns))


def share(hits: NDArray[np.floating], of_real: bool, other: int) -> Statistic:
    """Mean of one value per sample of one set, for instance precision; the other set is taken as it
    is.

    Args:
        hits: (N,) values of the real samples or (M,) of the generated ones.
        of_real: whose they are.
        other: number of samples of the other set.
    """

    def at(a: Counts, b: Counts) -> Float64Array:
        counts = a if of_real else b
        return np.asarray(counts @ hits / counts.sum(1))

    return Statistic(at, (len(hits), other) if of_real else (other, len(hits)))
