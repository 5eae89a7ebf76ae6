"""Fidelity, diversity and copying, from distances to the nearest neighbours in a feature space."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.errors import DataError, check_count
from lidar_synth.lab.evaluate.distances import checked_features
from lidar_synth.lab.evaluate.statistics import Statistic, share

NEIGHBOURS = 5
"""The neighbour whose distance is the radius of a sample's ball: k of the papers."""

_BLOCK = 1000  # samples whose distances to all others are held at a time


class Manifold(NamedTuple):
    """Precision, recall (Kynkäänniemi et al., NeurIPS 2019), density and coverage (Naeem et al.,
    ICML 2020).

    Each is a ``Statistic`` over the set that it is a mean of; the balls of the other set stay as
    they are, so that an interval holds for these balls.

    Args:
        precision: share of generated samples within a ball of a real one, in [0, 1].
        recall: share of real samples within a ball of a generated one, in [0, 1].
        density: mean number of real balls around a generated sample, divided by k; about 1 for
            equal sets.
        coverage: share of real samples whose ball holds a generated one, in [0, 1].
    """

    precision: Statistic
    recall: Statistic
    density: Statistic
    coverage: Statistic


def manifold(
    real: NDArray[np.floating], fake: NDArray[np.floating], k: int = NEIGHBOURS
) -> Manifold:
    """Compare where two sets of features lie.

    Args:
        real: (N, D) features.
        fake: (M, D) features of the same extractor.
        k: the k-th nearest neighbour in a sample's own set gives the radius of its ball.

    Raises:
        ConfigError: on k < 1.
        DataError: as ``frechet_distance``, or with k or fewer samples in a set.
    """
    x, y = (torch.from_numpy(s) for s in checked_features(real, fake))
    check_count("k", k, 1)
    if min(len(x), len(y)) <= k:
        raise DataError(
            f"{len(x)} real and {len(y)} generated samples",
            f"more than k = {k} of each",
        )
    real_radii, fake_radii = (
        _by_rows(s, s, lambda d: d.kthvalue(k + 1).values) for s in (x, y)
    )
    # Real balls around each generated sample.
    balls = _by_rows(y, x, lambda d: (d <= real_radii).double().sum(1))
    recalled = _by_rows(x, y, lambda d: (d <= fake_radii).any(1).double())
    nearest = _by_rows(x, y, lambda d: d.min(1).values)
    count = len(x)
    other = len(y)
    return Manifold(
        precision=share((balls > 0).double().numpy(), False, count),
        recall=share(recalled.numpy(), True, other),
        density=share((balls / k).numpy(), False, count),
        coverage=share((nearest <= real_radii).double().numpy(), True, other),
    )


class Novelty(NamedTuple):
    """Distances to the nearest training sample, to find copies.

    Args:
        generated: (M,) of the generated samples.
        held_out: (N,) of real samples that are no training data.
        closer: share of the generated samples that lie closer to the training data than 95 % of the
            held-out ones do; 0.05 is expected of new samples, more points to copies.
    """

    generated: NDArray[np.float64]
    held_out: NDArray[np.float64]
    closer: float


def nearest_training(
    training: NDArray[np.floating],
    fake: NDArray[np.floating],
    held_out: NDArray[np.floating],
) -> Novelty:
    """How close generated samples are to the training data, beside held-out real samples.

    Args:
        training: (T, D) features of the training data.
        fake: (M, D) features of generated samples.
        held_out: (N, D) features of real samples that are no training data.

    Raises:
        DataError: as ``frechet_distance``.
    """
    known = torch.from_numpy(checked_features(training, fake)[0])
    generated, others = (
        _by_rows(
            torch.from_numpy(checked_features(training, s)[1]),
            known,
            lambda d: d.min(1).values,
        ).numpy()
        for s in (fake, held_out)
    )
    return Novelty(
        generated, others, float((generated < np.quantile(others, 0.05)).mean())
    )


def _by_rows(a: Tensor, b: Tensor, reduce: Callable[[Tensor], Tensor]) -> Tensor:
    """(N,) a function of the distances from each of N samples to all of another set, for bounded
    memory."""
    parts = (torch.cdist(a[i : i + _BLOCK], b) for i in range(0, len(a), _BLOCK))
    return torch.cat([reduce(part) for part in parts])
