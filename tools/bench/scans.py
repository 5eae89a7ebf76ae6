"""Time of a labelled scan by model, steps and columns, against a large matrix product.

    python tools/bench/scans.py [MODEL ...] [--rounds N] [--threads N] [--busy]

MODEL is a shipped model or a checkpoint, by default "town". Each scan is generated from its noise to points with
labels. All measurements take turns. With --busy, processor time replaces wall-clock time, for a machine that does other
work.
"""

import argparse
import time
from itertools import count
from pathlib import Path

import torch
from timing import print_table, time_in_turns

from lidar_synth.generate.generator import load_generator

STEPS = (4, 2, 1)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="*", default=["town"])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--busy", action="store_true", help="measure processor time")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    a, index = torch.randn(4096, 4096), count()
    calls = {"product of 4096 x 4096 (137 GFLOP)": lambda: a @ a}
    for model in given.model:
        generator = load_generator(model)
        for width in getattr(generator.autoencoder, "widths", (generator.sensor.columns,)):
            narrow = load_generator(model, columns=width)
            for steps in STEPS:
                name = f"{Path(model).stem}, 64 x {width}, {steps} steps"
                calls[name] = lambda narrow=narrow, steps=steps: narrow.scans(0, [next(index)], steps=steps)
    seconds = time_in_turns(calls, given.rounds, time.process_time if given.busy else time.perf_counter)
    what = "processor time" if given.busy else "wall time"
    title = f"A labelled scan on the CPU, {given.threads} threads, float32, {what}; torch {torch.__version__}"
    print_table(title, seconds, next(iter(calls)))


if __name__ == "__main__":
    main()
