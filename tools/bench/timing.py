"""Timing for the benchmark scripts: all rows of a table are measured in one run, in turns."""

import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

import numpy as np
from tqdm import tqdm

CLOCKS = {
    False: ("wall time", time.perf_counter),
    True: ("processor time", time.process_time),
}
"""What is measured, and its clock, by whether the machine does other work."""


def seconds(
    call: Callable[[], object], clock: Callable[[], float] = time.perf_counter
) -> float:
    """Seconds that one call takes, of wall time by default."""
    start = clock()
    call()
    return clock() - start


def time_in_turns(
    calls: Mapping[str, Callable[[], object]],
    rounds: int = 60,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of each call; the calls take turns, so that other load affects all of them
    alike.

    On a busy machine, ``clock=time.process_time`` measures only the work of this process.
    """
    for call in calls.values():
        call()
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in tqdm(range(rounds), desc="timing", leave=False):
        for name, call in calls.items():
            taken[name].append(seconds(call, clock))
    return {name: median(values) for name, values in taken.items()}


def machine() -> str:
    """A line that describes the machine: processor, cores, AVX-512, Python and numpy."""
    info = Path("/proc/cpuinfo")
    text = info.read_text() if info.exists() else ""
    model = next(
        (
            line.split(":")[1].strip()
            for line in text.splitlines()
            if line.startswith("model name")
        ),
        "",
    )
    cores = text.count("processor\t") or 1
    vector = "AVX-512" if "avx512f" in text else "no AVX-512"
    return (
        f"{model or platform.processor() or platform.machine()}, {cores} cores, {vector}; "
        f"Python {platform.python_version()}, numpy {np.__version__}; {time.strftime('%Y-%m-%d')}"
    )


def print_table(title: str, seconds: Mapping[str, float], base: str) -> None:
    """Print a Markdown table of milliseconds, and of ratios to one of the rows."""
    print(
        f"\n### {title}\n\n{machine()}\n\n| operation | ms | ratio to '{base}' |\n|---|---:|---:|"
    )
    for name, value in seconds.items():
        print(f"| {name} | {1e3 * value:.3f} | {value / seconds[base]:.2f} |")
