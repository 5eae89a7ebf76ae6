"""Speed of the town: the parts of a scan on one core, and complete scans by one process per core.

    python tools/bench/town.py [--stretches 10] [--jobs 2]

The town's target is 25 scans per second on 2 cores with 2,175 firings, with labels and boxes,
without images.
"""

import os
import time

from typer import run

# Set before numpy is imported: one process per core does the work, and numpy's threads would
# compete for the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import multiprocessing
from dataclasses import replace

import numpy as np
from timing import machine

from lidar_synth.lab.town import STRETCH_FRAMES, Town, load_skin
from lidar_synth.lab.town.solid import Solid
from lidar_synth.lab.town.world import build_world


def make(stretches: list[int]) -> tuple[float, float]:
    """Make all scans of some stretches; seconds of processor time and of the clock, without
    start-up."""
    town = Town(0, scans=10**6)
    town[10**6 - 1]
    clock = time.perf_counter()
    used = time.process_time()
    for k in stretches:
        for i in range(STRETCH_FRAMES):
            town[STRETCH_FRAMES * k + i]
    return time.process_time() - used, time.perf_counter() - clock


PARTS = (
    "sample and build the stretch",
    "its Embree BVH",
    "ray casting, returns, boxes",
)
"""The parts of a scan without image."""
IMAGE = "image"
SKIN = "a skin on its returns, if there is one"


def parts(stretches: int) -> dict[str, float]:
    """Seconds of processor time of each part, per scan."""
    town = Town(0, scans=10**6)
    town[10**6 - 1]
    spent = np.mean([stretch_parts(town, k) for k in range(stretches)], axis=0)
    used = dict(zip(PARTS, spent.tolist(), strict=True))
    start = time.process_time()
    town.image(0)
    used[IMAGE] = time.process_time() - start
    used[SKIN] = skin()
    return used


def skin() -> float:
    """Seconds of processor time of a skin on a scan; the shipped one, taken for the town's
    sensor."""
    scan = Town(0)[0]
    other = load_skin("pandar64")
    assert scan.ring is not None and scan.instance is not None
    own = replace(other, sensor=scan.sensor)
    boxed = scan.instance > 0
    rng = np.random.default_rng(0)
    own.apply(scan.points, scan.reflectance, scan.ring, boxed, rng)
    start = time.process_time()
    for _ in range(10):
        own.apply(scan.points, scan.reflectance, scan.ring, boxed, rng)
    return (time.process_time() - start) / 10


def stretch_parts(town: Town, number: int) -> tuple[float, float, float]:
    """Seconds of processor time of ``PARTS``, per scan of a stretch."""
    start = time.process_time()
    world = build_world(0, number, town.interval)
    built = time.process_time()
    Solid(world.triangles).first(world.triangles[:1, 0], world.triangles[:1, 1])
    ready = time.process_time()
    first = STRETCH_FRAMES * number
    town[first]
    begin = time.process_time()
    for i in range(1, 6):
        town[first + i]
    cast = time.process_time() - begin
    return (built - start) / STRETCH_FRAMES, (ready - built) / STRETCH_FRAMES, cast / 5


def print_together(stretches: int, jobs: int) -> None:
    """Print the rate of complete scans by several processes."""
    shares = [list(range(j, stretches, jobs)) for j in range(jobs)]
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        results = pool.map(make, shares, chunksize=1)
    count = STRETCH_FRAMES * stretches
    used, clocks = zip(*results, strict=True)
    each = sum(used) / count
    print(
        f"\n{count} scans by {jobs} processes: {1e3 * each:.1f} ms of processor time "
        f"each\n{jobs / each:.1f} scans/s on {jobs} dedicated cores; "
        f"{count / max(clocks):.1f} scans/s of wall-clock time here"
    )


def main(stretches: int = 10, jobs: int = 2) -> None:
    """Prints the table."""
    print(f"64 x 1024, {machine()}, load {os.getloadavg()[0]:.1f}\n")
    print("| part | ms of processor time per scan |\n| --- | ---: |")
    used = parts(stretches)
    for name, seconds in used.items():
        print(f"| {name} | {1e3 * seconds:.1f} |")
    whole = sum(used[name] for name in PARTS)
    print(f"| **a scan without image** | **{1e3 * whole:.1f}** |")
    print_together(stretches, jobs)


if __name__ == "__main__":
    run(main)
