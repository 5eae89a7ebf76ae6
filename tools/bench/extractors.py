"""Time of every feature extractor on one scan of the town's sensor, with random weights of the
published shapes.

python tools/bench/extractors.py [--rounds N] [--busy] [--only NAME]
"""

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from timing import CLOCKS, print_table, time_in_turns
from typer import run

from lidar_synth.lab.evaluate.extractors import EXTRACTORS, load_extractor
from lidar_synth.lab.town import Town

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from random_archives import write


def main(rounds: int = 3, busy: bool = False, only: list[str] | None = None) -> None:
    """Print the table."""
    scan = Town(seed=0, scans=1)[0]
    calls: dict[str, Callable[[], object]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in only or EXTRACTORS:
            try:
                extract = load_extractor(name, write(name, Path(folder) / name))
            except ImportError:
                print(f"{name} left out: timm is not installed")
                continue
            calls[name] = partial(extract, [scan])
        what, clock = CLOCKS[busy]
        seconds = time_in_turns(calls, rounds, clock)
    title = f"one scan of {len(scan)} points, {torch.get_num_threads()} threads, {what}"
    print_table(title, seconds, next(iter(seconds)))


if __name__ == "__main__":
    run(main)
