"""Time of every feature extractor on one scan of the town's sensor, with random weights of the
published shapes.

python tools/bench/extractors.py [--rounds N] [--cpu-time] [--only NAME ...]
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from timing import print_table, time_in_turns

from lidar_synth.lab.evaluate.extractors import EXTRACTORS, load_extractor
from lidar_synth.lab.town import Town

sys.path.insert(0, str(Path(__file__).parents[1] / "research" / "extractors"))
from random_archives import (
    write,
)  # the folder of tools/extractors is on the path from here on


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--cpu-time",
        action="store_true",
        help="time of this process alone, on a busy machine",
    )
    parser.add_argument(
        "--only", nargs="*", default=list(EXTRACTORS), choices=list(EXTRACTORS)
    )
    given = parser.parse_args()
    scan = Town(seed=0, scans=1)[0]
    calls: dict[str, Callable[[], object]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in given.only:
            try:
                extract = load_extractor(name, write(name, Path(folder) / name))
            except ImportError:
                print(f"{name} left out: timm is not installed")
                continue
            calls[name] = lambda extract=extract: extract([scan])
        clock = time.process_time if given.cpu_time else time.perf_counter
        seconds = time_in_turns(calls, given.rounds, clock)
    print_table(
        f"one scan of {len(scan)} points, {torch.get_num_threads()} threads",
        seconds,
        next(iter(seconds)),
    )


if __name__ == "__main__":
    main()
