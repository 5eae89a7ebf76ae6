"""Distances between two distributions of histograms or feature vectors."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import rel_entr

from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Float64Array


def jensen_shannon_distance(p: NDArray[np.number], q: NDArray[np.number]) -> float:
    """Square root of the Jensen-Shannon divergence (natural logarithm), in [0, sqrt(log 2)]; LiDM
    and R2Flow both report it as JSD.

    Args:
        p: non-negative weights of any shape; need not be normalised.
        q: weights of the same shape.

    Raises:
        DataError: on weights that are not a distribution, or of two shapes.
    """
    if p.shape != q.shape or not all(
        (w >= 0).all() and 0 < w.sum() < np.inf for w in (p, q)
    ):
        raise DataError(
            f"weights of shape {p.shape} and {q.shape} with sums {p.sum()} and {q.sum()}",
            "two non-negative histograms of one shape, neither of them empty",
        )
    p = p.ravel() / p.sum()
    q = q.ravel() / q.sum()
    mean = (p + q) / 2
    total = rel_entr(p, mean).sum() + rel_entr(q, mean).sum()
    return float(np.sqrt(max(total / 2, 0.0)))


def frechet_distance(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Squared Frechet distance of the Gaussians that fit two sets of features (Dowson and Landau,
    1982)::

        |m_a - m_b|^2 + tr(S_a + S_b - 2 (S_a^1/2 S_b S_a^1/2)^1/2)

    The symmetric form keeps every root real, also where a covariance is singular.

    Args:
        a: (N, D) features.
        b: (M, D) features of the same extractor.

    Raises:
        DataError: on other shapes, fewer than two samples, or features that are not finite.
    """
    a, b = checked_features(a, b)
    cov_a, cov_b = (
        np.atleast_2d(np.cov(features, rowvar=False)) for features in (a, b)
    )
    return frechet_of_moments(a.mean(0), cov_a, b.mean(0), cov_b)


def frechet_of_moments(
    mean_a: Float64Array,
    cov_a: Float64Array,
    mean_b: Float64Array,
    cov_b: Float64Array,
) -> float:
    """As ``frechet_distance``, from means (D,) and covariances (D, D)."""
    values, vectors = np.linalg.eigh(cov_a)
    root = (vectors * np.sqrt(values.clip(0))) @ vectors.T
    cross = np.sqrt(np.linalg.eigvalsh(root @ cov_b @ root).clip(0)).sum()
    squared = (
        np.square(mean_a - mean_b).sum() + np.trace(cov_a) + np.trace(cov_b) - 2 * cross
    )
    return float(max(squared, 0.0))  # rounding leaves equal sets a little below 0


class Chooser(Protocol):
    """A sampler for ``squared_mmd``: a ``numpy.random.Generator`` or a ``RandomState``."""

    def choice(self, a: int, size: int, replace: bool) -> NDArray[np.int64]: ...


def squared_mmd(
    real: NDArray[np.floating],
    generated: NDArray[np.floating],
    rng: Chooser | None = None,
    subsets: int = 100,
    size: int = 1000,
) -> float:
    """Unbiased squared maximum mean discrepancy of features under the kernel (x . y / D + 1)^3,
    averaged over random subsets (the kernel distance of Binkowski et al., ICLR 2018, as R2Flow
    reports it).

    Args:
        real: (N, D) features.
        generated: (M, D) features of the same extractor.
        rng: samples the subsets; by default with seed 0.
        subsets: number of subsets.
        size: maximum size of a subset; also limited by N and M.

    Raises:
        DataError: as ``frechet_distance``.
    """
    real, generated = checked_features(real, generated)
    rng = np.random.default_rng(0) if rng is None else rng
    size = min(len(real), len(generated), size)
    if size == len(real) == len(generated):
        subsets = 1  # each would hold all samples
    total = 0.0
    for _ in range(subsets):
        x = generated[rng.choice(len(generated), size, replace=False)]
        y = real[rng.choice(len(real), size, replace=False)]
        xx, yy, xy = (
            (p @ q.T / real.shape[1] + 1) ** 3 for p, q in ((x, x), (y, y), (x, y))
        )
        within = xx.sum() - np.trace(xx) + yy.sum() - np.trace(yy)
        total += within / (size - 1) - 2 * xy.sum() / size
    return float(total / subsets / size)


def checked_features(
    a: NDArray[np.floating], b: NDArray[np.floating]
) -> tuple[Float64Array, Float64Array]:
    """(N, D) and (M, D) features in float64.

    Raises:
        DataError: on other shapes, fewer than two samples, or features that are not finite.
    """
    sets = a, b
    a, b = (np.asarray(features).astype(np.float64) for features in sets)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise DataError(
            f"features of shape {a.shape} and {b.shape}", "(N, D) and (M, D)"
        )
    if min(len(a), len(b)) < 2:
        raise DataError(
            f"features of {len(a)} and {len(b)} scans",
            "at least two of each for a distance of features",
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise DataError("features that are not finite", "finite numbers")
    return a, b
