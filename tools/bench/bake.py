"""The cost of a bake: generating alone and with writing, one process and two, memory of short and
long bakes.

    python tools/bench/bake.py [--model town] [--count 256] [--lengths 400 4000] [--rounds 3]

Speeds are those of the named model. Memory is measured with a fast model with random weights,
because the memory per scan does not depend on the model. Every bake runs in its own process with
one thread per worker; the machine has to be idle. Compared runs take turns; the table has medians.
"""

import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

from timing import machine
from typer import run
from untrained import write_untrained

from lidar_synth.bake import BakeJob, BakePlan, Resources, bake, make_plan
from lidar_synth.bake.shard import images, load_checked, torch_threads


def alone(call: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a call in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


def plan_of(out: Path, model: str, count: int, shard_size: int) -> BakePlan:
    """A plan with default settings except these."""
    return make_plan(out, BakeJob(model=model, count=count, shard_size=shard_size))


def by_processes(out: Path, model: str, count: int, workers: int) -> float:
    """Seconds of a complete bake, including the start of the workers."""
    plan = plan_of(out, model, count, max(1, count // 16))
    start = time.perf_counter()
    bake(plan, "processes", Resources(workers), progress=False)
    return time.perf_counter() - start


def generated_and_baked(
    out: Path, model: str, count: int, rounds: int
) -> list[tuple[float, float]]:
    """Seconds of generating the scans and of baking them, in turns."""
    found = []
    for number in range(rounds + 1):
        plan = plan_of(out / str(number), model, count, count)
        generator = load_checked(plan.job, plan.facts)
        start = time.perf_counter()
        with torch_threads(plan.job.threads):
            for _ in images(generator, plan.job, plan.shards[0]):
                pass
        middle = time.perf_counter()
        bake(plan, progress=False)
        found.append((middle - start, time.perf_counter() - middle))
    return found[1:]  # the first warms up


def peak_memory(out: Path, model: str, count: int) -> float:
    """Peak resident memory of a process that bakes this many scans, in megabytes."""
    bake(plan_of(out, model, count, min(count, 1024)), progress=False)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def print_processes(root: Path, model: str, count: int, rounds: int) -> None:
    """Print the time of a bake by one process and by two."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(rounds):
        for workers, times in seconds.items():
            out = root / f"{turn} by {workers}"
            times.append(alone(by_processes, out, model, count, workers))
    one = median(seconds[1])
    two = median(seconds[2])
    print(f"| {count} scans by one process | {one:.1f} s |")
    print(f"| by two processes | {two:.1f} s, {one / two:.2f} times as fast |")


def print_writing(root: Path, model: str, count: int, rounds: int) -> None:
    """Print the rate of generating alone and with writing."""
    turns = alone(generated_and_baked, root, model, count, rounds)
    plain, whole = (median(times) for times in zip(*turns, strict=True))
    print(f"| generating only, in one process | {count / plain:.2f} scans/s |")
    print(
        f"| generating and writing | {count / whole:.2f} scans/s, {1 - plain / whole:.1%} "
        "of the time for writing |"
    )


def main(
    model: str = "town",
    count: int = 256,
    lengths: tuple[int, int] = (400, 4000),
    rounds: int = 3,
) -> None:
    """Prints the tables."""
    print(f"\n### Baking\n\n{machine()}\n\n| what | |\n|---|---:|")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        print_processes(root, model, count, rounds)
        print_writing(root / "turns", model, max(1, count // 4), rounds)
        untrained = str(write_untrained(root / "untrained.safetensors"))
        for length in lengths:
            megabytes = alone(peak_memory, root / f"{length} scans", untrained, length)
            print(f"| peak memory of a bake of {length} scans | {megabytes:.0f} MB |")


if __name__ == "__main__":
    run(main)
