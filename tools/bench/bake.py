"""What a bake costs beside its generating: a second process, the writing, memory as it gets longer.

    python tools/bench/bake.py [--model town] [--count 256] [--lengths 400 4000]

Speeds are those of the named model; memory is that of a quick one that has learnt nothing, because what is kept of a
scan does not depend on its model. Every bake runs in a process of its own with one thread per worker; the machine has
to be quiet. What is compared takes turns, three times, and medians count.
"""

import argparse
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
from untrained import write_untrained

from lidar_synth.bake import BakeJob, BakePlan, Resources, bake, make_plan
from lidar_synth.bake.shard import images, load_checked, torch_threads

ROUNDS = 3


def alone(call: Callable[..., Any], *arguments: Any) -> Any:
    """What a call returns in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


def plan_of(out: Path, model: str, count: int, shard_size: int) -> BakePlan:
    """A plan with the default settings otherwise."""
    return make_plan(out, BakeJob(model=model, count=count, shard_size=shard_size))


def by_processes(out: Path, model: str, count: int, workers: int) -> float:
    """Seconds of a whole bake, the start of the workers included."""
    plan = plan_of(out, model, count, max(1, count // 16))
    start = time.perf_counter()
    bake(plan, "processes", Resources(workers), progress=False)
    return time.perf_counter() - start


def generated_and_baked(out: Path, model: str, count: int) -> list[tuple[float, float]]:
    """Seconds of generating the scans and of baking them, in turns."""
    found = []
    for number in range(ROUNDS + 1):
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
    """Largest resident size of a process that bakes so many scans, in megabytes."""
    bake(plan_of(out, model, count, min(count, 1024)), progress=False)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="town", help="a shipped model or a checkpoint")
    parser.add_argument("--count", type=int, default=256, help="scans of a bake whose time is taken")
    parser.add_argument("--lengths", type=int, nargs=2, default=(400, 4000), help="scans of the bakes for memory")
    given = parser.parse_args()
    print(f"\n### Baking\n\n{machine()}\n\n| what | |\n|---|---:|")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for turn in range(ROUNDS):
            for workers, times in seconds.items():
                times.append(alone(by_processes, root / f"{turn} by {workers}", given.model, given.count, workers))
        one, two = (median(times) for times in seconds.values())
        print(f"| {given.count} scans by one process | {one:.1f} s |")
        print(f"| by two | {two:.1f} s, {one / two:.2f} times as fast |")
        few = max(1, given.count // 4)
        turns = alone(generated_and_baked, root / "turns", given.model, few)
        plain, whole = (median(times) for times in zip(*turns, strict=True))
        print(f"| generating alone, in this process | {few / plain:.2f} scans/s |")
        print(f"| the bake | {few / whole:.2f} scans/s, {1 - plain / whole:.1%} of its time for writing |")
        untrained = str(write_untrained(root / "untrained.safetensors"))
        for count in given.lengths:
            megabytes = alone(peak_memory, root / f"{count} scans", untrained, count)
            print(f"| peak memory of a bake of {count} scans | {megabytes:.0f} MB |")


if __name__ == "__main__":
    main()
