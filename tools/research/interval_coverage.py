"""How often do the 95 % intervals of the measures cover the truth? The table in
docs/research/measures.md.

    python tools/research/interval_coverage.py [--trials 400] [--replicates 200] [NAME ...]

Each trial draws two sets whose true distance is known, or is measured once on large sets.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typer import Argument, run

from lidar_synth.lab.evaluate.distances import (
    frechet_of_moments,
    jensen_shannon_distance,
)
from lidar_synth.lab.evaluate.intervals import bootstrap
from lidar_synth.lab.evaluate.measures import normalised_rows
from lidar_synth.lab.evaluate.statistics import (
    Statistic,
    frechet,
    gaussian_mmd,
    histogram_distance,
    polynomial_mmd,
)

WIDTH = 8
BINS = 50
LARGE = 4000

Rng = np.random.Generator


class Simulation(NamedTuple):
    """Two distributions and a distance.

    Args:
        draw: ``(rng, n) -> Statistic`` of two sets of n samples.
        samples: n.
        truth: the distance of the distributions; None = of large sets.
    """

    draw: Callable[[Rng, int], Statistic]
    samples: int
    truth: float | None = None


def features(
    shift: float, compare: Callable[..., Statistic]
) -> Callable[[Rng, int], Statistic]:
    """Gaussian features; those of the second set are shifted and wider."""
    return lambda rng, n: compare(
        rng.normal(size=(n, WIDTH)), rng.normal(shift, 1.2, (n, WIDTH))
    )


def gaussian_truth(shift: float) -> float:
    unit = np.eye(WIDTH)
    return frechet_of_moments(np.zeros(WIDTH), unit, np.full(WIDTH, shift), 1.44 * unit)


def counts(rng: Rng, n: int, slope: float) -> list[NDArray[np.int64]]:
    """Histograms of scans, which differ from one another by more than counting does."""
    return list(
        rng.poisson(5 * rng.gamma(2, 1, (n, BINS)) * np.linspace(1, slope, BINS))
    )


def jsd(rng: Rng, n: int) -> Statistic:
    return histogram_distance(counts(rng, n, 3.0), counts(rng, n, 1 / 3))


def mmd(rng: Rng, n: int) -> Statistic:
    rows = [normalised_rows(counts(rng, n, slope)) for slope in (3.0, 1 / 3)]
    return gaussian_mmd(rows[0], rows[1], (n, n), BINS)


JSD_TRUTH = jensen_shannon_distance(
    np.linspace(1, 3, BINS), np.linspace(1, 1 / 3, BINS)
)

SIMULATIONS = {
    "JSD, 30 scans": Simulation(jsd, 30, JSD_TRUTH),
    "JSD, 100 scans": Simulation(jsd, 100, JSD_TRUTH),
    "MMD of histograms, 30 scans": Simulation(mmd, 30),
    "MMD of histograms, 100 scans": Simulation(mmd, 100),
    "Frechet, 4 samples per feature": Simulation(
        features(1.0, frechet), 4 * WIDTH, gaussian_truth(1.0)
    ),
    "Frechet, 12 samples per feature": Simulation(
        features(1.0, frechet), 12 * WIDTH, gaussian_truth(1.0)
    ),
    "Frechet, small, 12 samples per feature": Simulation(
        features(0.3, frechet), 12 * WIDTH, gaussian_truth(0.3)
    ),
    "Frechet, small, 40 samples per feature": Simulation(
        features(0.3, frechet), 40 * WIDTH, gaussian_truth(0.3)
    ),
    "unbiased squared MMD, 100 samples": Simulation(features(1.0, polynomial_mmd), 100),
    "unbiased squared MMD, small, 300 samples": Simulation(
        features(0.3, polynomial_mmd), 300
    ),
}


def coverage(
    simulation: Simulation, trials: int, replicates: int
) -> tuple[float, float]:
    """Share of the trials whose interval holds the truth, and the mean width of the intervals."""
    truth = simulation.truth
    if truth is None:
        truth = simulation.draw(np.random.default_rng(2**32), LARGE).value
    found = []
    for k in range(trials):
        statistic = simulation.draw(np.random.default_rng([1, k]), simulation.samples)
        if (interval := bootstrap(statistic, replicates, seed=k)) is not None:
            found.append(interval)
    return float(np.mean([i.low <= truth <= i.high for i in found])), float(
        np.mean([i.high - i.low for i in found])
    )


def main(
    names: Annotated[list[str] | None, Argument()] = None,
    trials: int = 400,
    replicates: int = 200,
) -> None:
    print("| simulation | covered, % | mean width |\n|---|---:|---:|")
    for name in names or SIMULATIONS:
        share, width = coverage(SIMULATIONS[name], trials, replicates)
        print(f"| {name} | {100 * share:.1f} | {width:.4g} |", flush=True)


if __name__ == "__main__":
    run(main)
