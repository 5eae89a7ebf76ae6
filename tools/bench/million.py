"""A bank of a million scans: seconds and peak memory of what users do with it, each in a process of
its own.

    python tools/bench/million.py [FOLDER] [--shards N]

The bank has shards of 1,024 scans of random cells on a small sensor, by default 977 of them; FOLDER
keeps it, and a rerun finds it. Its real size, in the cells of a scan, changes none of the rows but
``verify``, whose time is that of reading. Memory is that of the process, the interpreter and its
imports included.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from bank import LARGE, tree
from timing import machine
from typer import Argument, run

OPEN = "from lidar_synth.bank import Bank; bank = Bank({root!r})"
MIX = f"{OPEN}; from lidar_synth import MixedScans"
COMMAND = (
    "import sys; from lidar_synth.cli import main; sys.argv[1:] = {words!r}; main()"
)
ACTIONS = {
    "import of banks": "import lidar_synth.bank",
    "open": OPEN,
    "open, 1,000 random reads": f"{OPEN}; [bank[n * 999_983 % len(bank)] for n in range(1000)]",
    "import of mixing": "from lidar_synth import MixedScans",
    "open, plan of an epoch": f"{MIX}; "
    "len(MixedScans(None, bank, 1.0, epoch_size=len(bank)).plan(0))",
    "`lidar-synth info`": ["info", "{root}"],
    "`lidar-synth verify`": ["verify", "{root}"],
    "`lidar-synth bake --dry-run`": [
        "bake",
        "{root}-new",
        "--count",
        "1000000",
        "--dry-run",
    ],
}
MEASURE = """
import re, sys, time
start = time.perf_counter()
try:
    exec(sys.argv[1])
finally:
    seconds = time.perf_counter() - start
    peak = int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
    print(f"MEASURED {seconds:.2f} | {peak / 1e3:.0f}")
"""
"""ru_maxrss would count the process that starts it."""


def code_of(action: str | list[str], root: str) -> str:
    """The statements of an action."""
    if isinstance(action, str):
        return action.format(root=root)
    return COMMAND.format(words=[word.format(root=root) for word in action])


def measure(code: str) -> str:
    """Seconds and MB of statements in a new process."""
    words = [sys.executable, "-c", MEASURE, code]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    return done.stdout.partition("MEASURED ")[2].strip()


def print_rows(root: Path, shards: int) -> None:
    """Prints the table."""
    if not (root / "index.json").is_file():
        tree(root, shards)
    print(f"### {shards * LARGE:,} scans in {shards:,} shards\n\n{machine()}\n")
    print("| what | s | peak memory, MB |\n|---|---:|---:|")
    for name, action in ACTIONS.items():
        print(f"| {name} | {measure(code_of(action, str(root)))} |", flush=True)


def main(folder: Annotated[Path | None, Argument()] = None, shards: int = 977) -> None:
    """Prints the table."""
    if folder is not None:
        print_rows(folder, shards)
        return
    with TemporaryDirectory() as made:
        print_rows(Path(made) / "bank", shards)


if __name__ == "__main__":
    run(main)
