"""The cost of reading a scan from a rolling bank.

    python tools/bench/service.py [--model NAME|FILE] [--threads 1]

Scans are 64 x 1024 with reflectance, labels and confidence; by default from an untrained network,
because training does not change these times. The target is a copied scan in less than 1 ms.
"""

import tempfile
from itertools import count
from pathlib import Path

import torch
from timing import print_table, time_in_turns
from typer import run
from untrained import write_untrained

from lidar_synth.geometry.projection import unproject
from lidar_synth.mixing.service import RollingBank

COPIED = "copied scan (ask, copy, check the sum)"
ALL = "bank[n], all of it"


def print_idle(bank: RollingBank, rounds: int) -> None:
    """Print the parts of reading a scan while the generator waits."""
    arrays = bank.read(0)[1]
    encoding = bank._slots.encoding
    image = encoding.decode(arrays)
    size = sum(values.nbytes for values in arrays.values())
    parts = {
        "copy of the bytes alone": lambda: [
            values.copy() for values in arrays.values()
        ],
        COPIED: lambda: bank.read(0),
        "decode to a range image": lambda: encoding.decode(arrays),
        "range image to points": lambda: unproject(image),
        ALL: lambda: bank[0],
    }
    bank.expect([])  # the generator is idle after the scans that it has started
    bank.read(1)
    seconds = time_in_turns(parts, rounds)
    print_table(f"{size:,} bytes per scan, generator idle", seconds, ALL)


def print_busy(bank: RollingBank, rounds: int) -> None:
    """Print the time of reading a scan while the generator runs."""
    bank.expect(range(10**6))
    numbers = count()
    calls = {
        COPIED: lambda: bank.read(next(numbers)),
        ALL: lambda: bank[next(numbers)],
    }
    print_table("The same, generator running", time_in_turns(calls, rounds), ALL)


def main(model: str | None = None, threads: int = 1, rounds: int = 200) -> None:
    """Prints the tables."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        given = model or write_untrained(Path(folder) / "untrained.safetensors")
        with RollingBank(given, slots=16, starved="reuse", threads=threads) as bank:
            print_idle(bank, rounds)
            print_busy(bank, 10 * rounds)
            print(f"\n{bank.counts()}")


if __name__ == "__main__":
    run(main)
