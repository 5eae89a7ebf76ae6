"""How often the intervals of ``lidar-synth prove`` hold the true difference, in a simulation.

    python tools/research/interval_of_places.py [--trials 600]

Differences of places are normal with one standard deviation, those of seeds within a place with
another. The table is that of docs/research/proof.md.
"""

import numpy as np
from typer import run

from lidar_synth.lab.proof.scores import interval


def coverage(
    places: int, seeds: int, between: float, within: float, trials: int
) -> float:
    """Share of the simulated comparisons whose 95 % interval holds the true mean."""
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(trials):
        values = rng.normal(0, between, (places, 1)) + rng.normal(
            0, within, (places, seeds)
        )
        ends = interval(values, seed=trial, draws=1500)
        held += ends is not None and ends[0] <= 0 <= ends[1]
    return held / trials


def main(
    trials: int = 600,
) -> None:
    """Prints the table."""
    spreads = {
        "places and seeds alike": (1, 1),
        "mostly places": (1, 0.2),
        "mostly seeds": (0.2, 1),
    }
    print(
        f"| places | seeds | {' | '.join(spreads)} |\n|---:|---:|{'---:|' * len(spreads)}"
    )
    for places in (6, 7, 11):
        for seeds in (1, 2, 3):
            cells = [
                f"{100 * coverage(places, seeds, *spread, trials):.1f}"
                for spread in spreads.values()
            ]
            print(f"| {places} | {seeds} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    run(main)
