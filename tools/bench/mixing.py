"""The cost of mixing: samples per second of a mixed dataset, and of the wrapped dataset alone.

    python tools/bench/mixing.py [--real SEMANTICKITTI_ROOT] [--scans 32] [--rounds 40]

Targets: at ratio 0 at least 97 % of the dataset alone; from a bank at ratio 0.5 at least 90 % of
real scans only, with the same output. Without ``--real``, the real scans are the town's, written as
SemanticKITTI; the bank holds scans of the town. One process, so that workers hide nothing;
processor time, so that other programs do not count. The caches of the file system are warm.
"""

import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from bank import write
from timing import machine, time_in_turns
from typer import run

from lidar_synth.bank import Bank
from lidar_synth.formats import WRITERS, SemanticKITTI
from lidar_synth.geometry import Scan, Source
from lidar_synth.geometry.projection import project
from lidar_synth.lab.town import Town
from lidar_synth.mixing import MixedScans, to_item
from lidar_synth.noise import keyed_rng

BATCH = 4


class Trainer:
    """A trainer's own dataset: reads a scan and makes the trainer's sample."""

    def __init__(self, scans: Source) -> None:
        self.scans = scans

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return dict(to_item(self.scans[index], keyed_rng(0, index)))


def write_dataset(root: Path, scans: Sequence[Scan]) -> None:
    """Write the scans as a SemanticKITTI root."""
    writer = WRITERS["semantic_kitti"](root)
    for index, scan in enumerate(scans):
        writer.write(scan, index)
    writer.finish()


def epoch(
    samples: Any, order: Sequence[int], collate: Callable[[list[Any]], Any] = list
) -> Callable[[], None]:
    """A pass through an epoch, batch by batch."""

    def go_through() -> None:
        for start in range(0, len(order), BATCH):
            collate([samples[i] for i in order[start : start + BATCH]])

    return go_through


def print_rates(title: str, samples: int, seconds: dict[str, float], base: str) -> None:
    """Print a Markdown table of samples per second, also relative to one of the rows."""
    print(
        f"\n### {title}\n\n{machine()}\n\n| what | samples/s | share of '{base}' |\n|---|---:|---:|"
    )
    for name, value in seconds.items():
        print(f"| {name} | {samples / value:.1f} | {seconds[base] / value:.1%} |")


def print_long_plan(bank: Bank, samples: int = 10**8) -> None:
    """Print the time of a long plan to its first batch, and Python's peak memory meanwhile."""
    start = time.perf_counter()
    train = MixedScans.wrap(
        range(samples * 3 // 4), bank, 0.25, to_sample=to_item, compare=False
    )
    next(iter(train.batches(BATCH)))
    train.plan()[samples // 2]
    seconds = time.perf_counter() - start
    tracemalloc.start()
    train.set_epoch(1)
    next(iter(train.batches(BATCH)))
    train.plan()[samples // 2]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    print(
        f"\nA plan of {len(train):,} samples: {1e3 * seconds:.0f} ms to the first batch, "
        f"{peak / 2**20:.2f} MiB at most"
    )


def print_overhead(real: SemanticKITTI, rounds: int) -> None:
    """Print the cost of a mixture without synthetic scans."""
    scans = MixedScans(real, None, 0)
    wrapped = MixedScans.wrap(Trainer(real), None, 0, to_sample=to_item)
    alone = "a trainer's dataset alone"
    order = range(len(real))
    calls = {
        alone: epoch(Trainer(real), scans.plan().index.tolist()),
        "wrapped, ratio 0": epoch(wrapped, order),
        "MixedScans of the scans, ratio 0": epoch(scans, order),
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    print_rates("Overhead at ratio 0", len(real), seconds, alone)
    numbers = MixedScans.wrap(range(1000), None, 0, to_sample=to_item)
    through = {"": lambda: [numbers[i] for i in range(1000)]}
    bare = time_in_turns(through, rounds, time.process_time)[""]
    print(
        f"\nWrapping alone, around a dataset of numbers: {1e3 * bare:.1f} µs a sample"
    )


def print_bank(real: SemanticKITTI, bank: Bank, form: Any, rounds: int) -> None:
    """Print the cost of batches of a form of which half are from a bank."""
    only = MixedScans(real, None, 0, collate=form)
    half = MixedScans(
        real, bank, 0.5, epoch_size="replace", balanced=True, collate=form
    )
    calls = {
        "real scans only": epoch(only, range(len(only)), only.collate),
        "half from a bank": epoch(half, range(len(half)), half.collate),
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    title = f"A bank at ratio 0.5, batches of {BATCH}, collate={form!r}"
    print_rates(title, len(real), seconds, "real scans only")


def main(real: Path | None = None, scans: int = 32, rounds: int = 100) -> None:
    """Times everything in turns and prints the tables."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        town = list(Town(0, scans=2 * scans))
        root = real or Path(folder) / "real"
        if real is None:
            write_dataset(root, town[:scans])
        own = SemanticKITTI(root)
        images = [project(scan) for scan in town[scans:]]
        bank = write(Path(folder) / "bank", images, ("reflectance", "label"))
        print_long_plan(bank)
        points = sum(len(scan) for scan in own) / len(own)
        print(f"{len(own)} real scans of {points:,.0f} points each")
        print_overhead(own, rounds)
        print_bank(own, bank, "offsets", rounds)
        print_bank(own, bank, "range", rounds)


if __name__ == "__main__":
    run(main)
