"""Time and memory of a labelled scan by model, steps and columns, against a large matrix product.

    python tools/bench/scans.py [MODEL ...] [--steps 4 --steps 2] [--rounds N] [--threads N]
        [--busy]

MODEL is a shipped model or a checkpoint, by default "town". Each scan is generated from its noise
to points with labels. All measurements of the first table take turns. With --busy, processor time
replaces wall-clock time, for a machine that does other work. The second table has the peak memory
of a process that generates scans one by one, and how many scans one process of one thread for each
core generate together, as those of ``bake --engine processes`` do.
"""

import os
import time
from collections.abc import Callable
from itertools import count
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from timing import CLOCKS, print_table, time_in_turns
from typer import Argument, run

from lidar_synth import Generator, Scan, Town, load_generator

PRODUCT = "product of 4096 x 4096 (137 GFLOP)"
TOGETHER = 6
"""Scans of each process in the second table."""


class Kind(NamedTuple):
    """What is generated."""

    model: str
    columns: int
    steps: int

    def __str__(self) -> str:
        return f"{Path(self.model).stem}, 64 x {self.columns}, {self.steps} steps"

    def generator(self) -> Generator:
        """A generator with these columns."""
        return load_generator(self.model, columns=self.columns)


def conditions(generator: Generator) -> list[Scan] | None:
    """A scan of the town, from which a conditional model takes its condition; None for an
    unconditional one."""
    return None if generator.condition is None else [Town(0, generator.sensor, 1)[0]]


def kinds(models: list[str], numbers: list[int]) -> list[Kind]:
    """All columns and steps of the models."""
    found = []
    for model in models:
        generator = load_generator(model)
        widths = getattr(generator.autoencoder, "widths", (generator.sensor.columns,))
        found += [Kind(model, width, steps) for width in widths for steps in numbers]
    return found


def _start(barrier: Barrier) -> None:
    global _barrier
    _barrier = barrier
    torch.set_num_threads(1)


def _alone(kind: Kind) -> tuple[float, float]:
    """Scans per second of this process, beside others that began at the same time; its peak memory
    in megabytes."""
    generator = kind.generator()
    given = conditions(generator)
    generator.scans(0, [0], given, steps=kind.steps)
    _barrier.wait()
    start = time.perf_counter()
    for index in range(1, TOGETHER + 1):
        generator.scans(0, [index], given, steps=kind.steps)
    return TOGETHER / (time.perf_counter() - start), _peak()


def _peak() -> float:
    """Peak memory of this process in megabytes; ``ru_maxrss`` of a spawned process begins with that
    of its parent."""
    words = Path("/proc/self/status").read_text().split()
    return int(words[words.index("VmHWM:") + 1]) / 1e3


def together(kind: Kind) -> tuple[float, float]:
    """Scans per second of one process for each core, and the peak memory of one of them in
    megabytes."""
    cores = os.cpu_count() or 1
    context = get_context("spawn")
    with context.Pool(cores, _start, (context.Barrier(cores),)) as pool:
        found = pool.map(_alone, [kind] * cores, chunksize=1)
    return sum(rate for rate, _ in found), max(memory for _, memory in found)


def calls_of(every: list[Kind]) -> dict[str, Callable[[], object]]:
    """What the first table measures, the product first."""
    a = torch.randn(4096, 4096)
    index = count()
    calls: dict[str, Callable[[], object]] = {PRODUCT: lambda: a @ a}
    for kind in every:
        generator = kind.generator()
        streets = conditions(generator)
        calls[str(kind)] = lambda g=generator, k=kind, c=streets: g.scans(
            0, [next(index)], c, steps=k.steps
        )
    return calls


def print_together(every: list[Kind], product: float) -> None:
    """Print the second table; ``product`` is the time of a product in seconds."""
    print(
        f"\n| {os.cpu_count()} processes of one thread | scans/s | scans in the time of a "
        "product | MB of each |\n|---|---:|---:|---:|"
    )
    for kind in every:
        rate, memory = together(kind)
        print(
            f"| {kind} | {rate:.2f} | {rate * product:.1f} | {memory:.0f} |", flush=True
        )


def main(
    model: Annotated[list[str] | None, Argument()] = None,
    steps: list[int] | None = None,
    rounds: int = 10,
    threads: int = torch.get_num_threads(),
    busy: bool = False,
) -> None:
    """Prints the tables."""
    torch.set_num_threads(threads)
    every = kinds(model or ["town"], steps or [4, 2, 1])
    what, clock = CLOCKS[busy]
    seconds = time_in_turns(calls_of(every), rounds, clock)
    title = (
        f"A labelled scan on the CPU, {threads} threads, float32, {what}; torch "
        f"{torch.__version__}"
    )
    print_table(title, seconds, PRODUCT)
    print_together(every, seconds[PRODUCT])


if __name__ == "__main__":
    run(main)
