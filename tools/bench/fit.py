"""Speed of ``fit_sensor`` and ``assign_beams`` on scans of the town.

python tools/bench/fit.py [--rounds N] [--sensor os1_128] [--scans 5]
"""

import time
from dataclasses import replace

import numpy as np
from timing import print_table, time_in_turns
from typer import run

from lidar_synth import Town, assign_beams, fit_sensor


def main(rounds: int = 1, sensor: str = "os1_128", scans: int = 5) -> None:
    """Prints the table."""
    given = list(Town(0, sensor, scans))
    raw = [replace(scan, ring=None) for scan in given]
    rng = np.random.default_rng(0)
    shuffled = [scan[rng.permutation(len(scan))] for scan in raw]
    calls = {
        "fit_sensor, rings given": lambda: fit_sensor(given),
        "fit_sensor, points ring by ring": lambda: fit_sensor(raw),
        "fit_sensor, points in any order": lambda: fit_sensor(shuffled),
        "assign_beams, one scan": lambda: assign_beams(raw[0], given[0].sensor),
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    points = sum(map(len, given))
    title = f"Fitting a sensor to {scans} scans ({points:,} points), processor time"
    print_table(title, seconds, next(iter(calls)))


if __name__ == "__main__":
    run(main)
