"""The cost of reading a scan from a rolling bank.

    python tools/bench/service.py [--model NAME|FILE] [--threads 1]

Scans are 64 x 1024 with reflectance, labels and confidence; by default from an untrained network,
because training does not change these times. The target is a copied scan in less than 1 ms.
"""

import argparse
import tempfile
from itertools import count
from pathlib import Path

import torch
from timing import print_table, time_in_turns
from untrained import write_untrained

from lidar_synth.geometry.projection import unproject
from lidar_synth.mixing.service import RollingBank


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", help="a shipped model or a checkpoint")
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        help="threads of torch in the generator process",
    )
    parser.add_argument("--rounds", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        model = options.model or write_untrained(Path(folder) / "untrained.safetensors")
        with RollingBank(
            model, slots=16, starved="reuse", threads=options.threads
        ) as bank:
            arrays = bank.read(0)[1]
            image = bank._slots.encoding.decode(arrays)
            size = sum(values.nbytes for values in arrays.values())
            parts = {
                "copy of the bytes alone": lambda: {
                    name: values.copy() for name, values in arrays.items()
                },
                "copied scan (ask, copy, check the sum)": lambda: bank.read(0),
                "decode to a range image": lambda: bank._slots.encoding.decode(arrays),
                "range image to points": lambda: unproject(image),
                "bank[n], all of it": lambda: bank[0],
            }
            bank.expect([])  # the generator is idle after the scans that it has started
            bank.read(1)
            print_table(
                f"{size:,} bytes per scan, generator idle",
                time_in_turns(parts, options.rounds),
                "bank[n], all of it",
            )
            bank.expect(range(10**6))
            numbers = count()
            busy = {
                "copied scan (ask, copy, check the sum)": lambda: bank.read(
                    next(numbers)
                ),
                "bank[n], all of it": lambda: bank[next(numbers)],
            }
            print_table(
                "The same, generator running",
                time_in_turns(busy, 10 * options.rounds),
                "bank[n], all of it",
            )
            print(f"\n{bank.counts()}")


if __name__ == "__main__":
    main()
