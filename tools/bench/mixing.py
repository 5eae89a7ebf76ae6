"""The cost of mixing: samples per second of a mixed dataset, and of the wrapped dataset alone.

    python tools/bench/mixing.py [--real SEMANTICKITTI_ROOT] [--scans 32] [--rounds 40]

Targets: at ratio 0 at least 97 % of the dataset alone; from a bank at ratio 0.5 at least 90 % of
    real scans only, with
the same output. Without ``--real``, the real scans are the town's, written as SemanticKITTI; the
bank holds scans of the town. One process, so that workers hide nothing; processor time, so that
other programs do not count. The caches of the file system are warm.
"""

import argparse
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from timing import machine, time_in_turns

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Entry, Facts, Index, ShardWriter
from lidar_synth.files.disk import sha256
from lidar_synth.formats import WRITERS, SemanticKITTI
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan, Source
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


def write_dataset(root: Path, scans: Sequence[Scan]) -> SemanticKITTI:
    """The scans as a SemanticKITTI root."""
    writer = WRITERS["semantic_kitti"](root)
    for index, scan in enumerate(scans):
        writer.write(scan, index)
    writer.finish()
    return SemanticKITTI(root)


def write_bank(root: Path, scans: Sequence[Scan]) -> Bank:
    """The scans as a bank of one shard."""
    facts = Facts(
        scans[0].sensor,
        ("reflectance", "label"),
        "town",
        "",
        {"seed": 0},
        "generated",
        "MIT",
        "none",
    )
    entry = Entry("shard-00000.h5", 0, 0, len(scans))
    root.mkdir()
    with ShardWriter(root / entry.file, facts, entry) as writer:
        for scan in scans:
            writer.append(project(scan))
    path = root / entry.file
    write_bank_files(
        root,
        Index(
            (facts,), (replace(entry, bytes=path.stat().st_size, sha256=sha256(path)),)
        ),
    )
    return Bank(root)


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


def main() -> None:
    """Times everything in turns and prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--real", type=Path, help="root of SemanticKITTI")
    parser.add_argument(
        "--scans", type=int, default=32, help="scans, real and synthetic each"
    )
    parser.add_argument("--rounds", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        town = Town(0, scans=2 * arguments.scans)
        made = [town[i] for i in range(len(town))]
        if arguments.real:
            real: SemanticKITTI = SemanticKITTI(arguments.real)
        else:
            real = write_dataset(Path(folder) / "real", made[: arguments.scans])
        bank = write_bank(Path(folder) / "bank", made[arguments.scans :])
        print_long_plan(bank)
        points = sum(len(scan) for scan in real) / len(real)
        print(f"{len(real)} real scans of {points:,.0f} points each")

        scans = MixedScans(real, None, 0)
        wrapped = MixedScans.wrap(Trainer(real), None, 0, to_sample=to_item)
        calls = {
            "a trainer's dataset alone": epoch(
                Trainer(real), scans.plan().index.tolist()
            ),
            "wrapped, ratio 0": epoch(wrapped, range(len(real))),
            "MixedScans of the scans, ratio 0": epoch(scans, range(len(real))),
        }
        seconds = time_in_turns(calls, arguments.rounds, time.process_time)
        print_rates("Overhead at ratio 0", len(real), seconds, next(iter(calls)))
        numbers = MixedScans.wrap(range(1000), None, 0, to_sample=to_item)
        bare = time_in_turns(
            {"": lambda: [numbers[i] for i in range(1000)]},
            arguments.rounds,
            time.process_time,
        )
        print(
            f"\nWrapping alone, around a dataset of numbers: {1e3 * bare['']:.1f} µs a sample"
        )
        for form, title in (("offsets", "points"), ("range", "range images")):
            only = MixedScans(real, None, 0, collate=form)  # type: ignore[arg-type]
            half = MixedScans(
                real, bank, 0.5, epoch_size="replace", balanced=True, collate=form
            )  # type: ignore[arg-type]
            calls = {
                "real scans only": epoch(only, range(len(only)), only.collate),
                "half from a bank": epoch(half, range(len(half)), half.collate),
            }
            seconds = time_in_turns(calls, arguments.rounds, time.process_time)
            print_rates(
                f"A bank at ratio 0.5, batches of {BATCH} as {title}",
                len(real),
                seconds,
                next(iter(calls)),
            )


if __name__ == "__main__":
    main()
