"""Processor time of every corruption on a scan of about 120,000 points, on one core.

python tools/bench/weather.py [--rounds N]
"""

import time
from functools import partial

import numpy as np
from timing import print_table, time_in_turns
from typer import run

from lidar_synth import Town
from lidar_synth.weather import CORRUPTIONS


def main(rounds: int = 20) -> None:
    """Prints the table."""
    scan = Town(0, "hdl64e_lasers", scans=1, motion=False)[0]

    calls = {
        name: partial(kind.at("moderate"), scan, np.random.default_rng(0))
        for name, kind in CORRUPTIONS.items()
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    print_table(f"Corruptions of {len(scan)} points", seconds, "fog")


if __name__ == "__main__":
    run(main)
