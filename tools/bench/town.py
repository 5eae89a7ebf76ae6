"""Speed of the town: the parts of a scan on one core, and complete scans by one process per core.

    python tools/bench/town.py [--stretches 10] [--jobs 2]

The town's target is 25 scans per second on 2 cores with 2,175 firings, with labels and boxes,
without images.
"""

import argparse
import os
import time

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
    "image",
)
SKIN = "a skin on its returns, if there is one"


def parts(stretches: int) -> dict[str, float]:
    """Seconds of processor time of each part, per scan."""
    town = Town(0, scans=10**6)
    town[10**6 - 1]
    used = dict.fromkeys(PARTS, 0.0)
    for k in range(stretches):
        start = time.process_time()
        world = build_world(0, k, town.interval)
        built = time.process_time()
        Solid(world.triangles).first(world.triangles[:1, 0], world.triangles[:1, 1])
        ready = time.process_time()
        town[STRETCH_FRAMES * k]
        begin = time.process_time()
        for i in range(1, 6):
            town[STRETCH_FRAMES * k + i]
        cast = time.process_time()
        spent = (
            (built - start) / STRETCH_FRAMES,
            (ready - built) / STRETCH_FRAMES,
            (cast - begin) / 5,
        )
        for part, seconds in zip(PARTS, spent, strict=False):
            used[part] += seconds / stretches
    start = time.process_time()
    town.image(0)
    used["image"] = time.process_time() - start
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


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--stretches",
        type=int,
        default=10,
        help=f"stretches of {STRETCH_FRAMES} scans each",
    )
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    print(f"64 x 1024, {machine()}, load {os.getloadavg()[0]:.1f}\n")
    print("| part | ms of processor time per scan |\n| --- | ---: |")
    used = parts(arguments.stretches)
    for name, seconds in used.items():
        print(f"| {name} | {1e3 * seconds:.1f} |")
    whole = sum(used.values()) - used["image"] - used[SKIN]
    print(f"| **a scan without image** | **{1e3 * whole:.1f}** |")
    shares = [
        list(range(j, arguments.stretches, arguments.jobs))
        for j in range(arguments.jobs)
    ]
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        results = pool.map(make, shares, chunksize=1)
    count = STRETCH_FRAMES * arguments.stretches
    seconds = sum(r[0] for r in results)
    rate = arguments.jobs * count / seconds
    clock = count / max(r[1] for r in results)
    print(
        f"\n{count} scans by {arguments.jobs} processes: {1e3 * seconds / count:.1f} ms of "
        "processor time each"
    )
    print(
        f"{rate:.1f} scans/s on {arguments.jobs} dedicated cores; {clock:.1f} scans/s of "
        "wall-clock time here"
    )


if __name__ == "__main__":
    main()
