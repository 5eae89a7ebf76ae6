"""Confidence intervals of distances between two sets, and the Fréchet distance of infinitely many
samples."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.lab.evaluate.distances import checked_features, frechet_distance
from lidar_synth.lab.evaluate.statistics import Statistic

REPLICATES = 200
FEWEST = 20
"""Usual and least numbers of resamples."""
LEVEL = 0.95
_BATCH = 50  # resamples that are evaluated at a time


class Interval(NamedTuple):
    """A confidence interval, ends included, and the value without the bias of its resamples."""

    low: float
    high: float
    corrected: float

    def __str__(self) -> str:
        return f"[{self.low:.4g}, {self.high:.4g}]"


def _resample(statistic: Statistic, replicates: int, seed: int) -> NDArray[np.floating]:
    """(replicates,) values of the statistic of resamples."""
    rng = np.random.default_rng(seed)
    values = []
    for first in range(0, replicates, _BATCH):
        count = min(_BATCH, replicates - first)
        values.append(
            statistic.at(
                *(rng.multinomial(n, np.full(n, 1 / n), count) for n in statistic.sizes)
            )
        )
    return np.concatenate(values)


def bootstrap(
    statistic: Statistic,
    replicates: int = REPLICATES,
    level: float = LEVEL,
    seed: int = 0,
    smallest: float = -np.inf,
    largest: float = np.inf,
) -> Interval | None:
    """The basic bootstrap interval (Davison and Hinkley, 1997, section 5.2.1): twice the value less
    the quantiles of its resamples. Both sets are resampled with replacement.

    Resampling biases a distance as sampling does; the basic interval takes that bias off, so that
    it can lie below a value which too few samples raise.

    Args:
        statistic: of two sets.
        replicates: number of resamples.
        level: of confidence, in (0, 1).
        seed: of the resamples.
        smallest, largest: the values between which the interval is cut, for instance 0 and 1 of a
            share.

    Returns:
        The interval; None where the statistic of a resample is not a number, as those of few
        samples may be which
        compare different ones: a resample may hold copies of one only.

    Raises:
        ConfigError: on a level outside (0, 1) or fewer than ``FEWEST`` resamples.
        DataError: with a set of one sample.
    """
    if not 0 < level < 1 or replicates < FEWEST:
        raise ConfigError(
            f"level {level} and {replicates} resamples",
            f"a level in (0, 1) and at least {FEWEST} resamples",
        )
    if min(statistic.sizes) < 2:
        raise DataError(
            f"{statistic.sizes[0]} real and {statistic.sizes[1]} generated samples",
            "at least two of each for an interval",
        )
    values = _resample(statistic, replicates, seed)
    if not np.isfinite(values).all():
        return None
    tails = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    ends = 2 * statistic.value - np.array([*tails[::-1], values.mean()])
    return Interval(*np.clip(ends, smallest, largest).tolist())


def extrapolated_frechet(
    real: NDArray[np.floating], fake: NDArray[np.floating]
) -> float:
    """The Fréchet distance extrapolated to infinitely many samples (Chong and Forsyth, CVPR 2020).

    The distance of finite sets is too large by about c / n. It is measured on parts of both sets of
    ten sizes, from half to all, and a line through the values over 1 / size gives the value at 0.
    It can fall below 0.

    Args:
        real: (N, D) features.
        fake: (M, D) features of the same extractor.

    Raises:
        DataError: as ``frechet_distance``, or where the smallest part does not have more samples
            than features: there the distance is no line over 1 / size.
    """
    real, fake = checked_features(real, fake)
    if min(len(real), len(fake)) // 2 <= real.shape[1]:
        raise DataError(
            f"{len(real)} and {len(fake)} samples of {real.shape[1]} features",
            f"more than {2 * real.shape[1]} samples of each set to extrapolate from",
        )
    rng = np.random.default_rng(0)
    shares = 1 / np.linspace(1, 2, 10)
    values = [
        frechet_distance(
            *(
                s[rng.choice(len(s), round(share * len(s)), replace=False)]
                for s in (real, fake)
            )
        )
        for share in shares
    ]
    return float(np.polyfit(1 / shares, values, 1)[1])
