"""Speed of ``fit_sensor`` and ``assign_beams`` on scans of the town.

python tools/bench/fit.py [--rounds N] [--sensor os1_128] [--scans 5]
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from timing import machine, time_in_turns

from lidar_synth import Town, assign_beams, fit_sensor


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--sensor", default="os1_128")
    parser.add_argument("--scans", type=int, default=5)
    given = parser.parse_args()
    scans = list(Town(0, given.sensor, given.scans))
    raw = [replace(scan, ring=None) for scan in scans]
    rng = np.random.default_rng(0)
    shuffled = [scan[rng.permutation(len(scan))] for scan in raw]
    sensor = scans[0].sensor
    calls = {
        "fit_sensor, rings given": lambda: fit_sensor(scans),
        "fit_sensor, points ring by ring": lambda: fit_sensor(raw),
        "fit_sensor, points in any order": lambda: fit_sensor(shuffled),
        "assign_beams, one scan": lambda: assign_beams(raw[0], sensor),
    }
    seconds = time_in_turns(calls, given.rounds, time.process_time)
    points = sum(map(len, scans))
    print(
        f"\n### Fitting a sensor to {len(scans)} scans ({points:,} points), processor "
        f"time\n\n{machine()}\n"
    )
    print("| operation | seconds |\n|---|---:|")
    for name, value in seconds.items():
        print(f"| {name} | {value:.2f} |")


if __name__ == "__main__":
    main()
