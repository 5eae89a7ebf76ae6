"""Labels of KITTI-360's scans from accumulated clouds: how many are right in the town, speed and
memory.

    python tools/bench/label.py [--scans 200] [--seed 3] [--interval 0.4] [--points 10000000]

Right: a town is exported with accumulated clouds, which hold every second frame and have errors of
    the poses
(lidar_synth/lab/town/accumulate.py); labels are recovered and compared with the known ones, for
frames that the clouds hold and for frames that they do not hold. The target is 97 % of the labelled
points and 90 % of moving cars.

Speed: processor time of the whole run, with reading and writing. The target is 20 scans per second
    on 2 cores. Windows
of KITTI-360 have about 10 million points, those of the town 300,000; so a window is filled up to
``--points`` by copies of its points, moved by a few centimetres, and its scans are labelled again.
"""

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

# Set before numpy is imported: one process per core does the work, and numpy's threads would
# compete for the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from timing import machine

from lidar_synth import KITTI360
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.lab.kitti360.accumulated import (
    PROPERTIES,
    find_windows,
    read_cloud,
    write_cloud,
)
from lidar_synth.lab.kitti360.labels import label_scans
from lidar_synth.lab.kitti360.report import LabelReport
from lidar_synth.lab.town import Town, export_town
from lidar_synth.lab.town.accumulate import STEP

COPY = 0.04
"""Standard deviation, metres, by which the copies of a point are moved."""


def print_right(report: LabelReport) -> None:
    """Print the shares of right labels, for frames inside and outside the clouds."""
    print(
        "| frames | covered | right | moving cars covered | moving cars right "
        "|\n|---|---:|---:|---:|---:|"
    )
    names = {0: "in the clouds", 1: "not in the clouds"}
    for part, name in names.items():
        rows = [
            c
            for frame, c in report.compared.items()
            if (int(frame.split("/")[1]) % STEP > 0) == part
        ]
        known, covered, right, cars, seen, good = np.sum(rows, axis=0)
        shares = (
            covered / known,
            right / covered,
            seen / max(cars, 1),
            good / max(seen, 1),
        )
        print(
            f"| {name} ({len(rows)}) | "
            + " | ".join(f"{100 * s:.1f} %" for s in shares)
            + " |"
        )


def print_confidence(town: Path, out: Path) -> None:
    """Print how many labels are right by their confidence."""
    edges = np.array([0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.01])
    counts = np.zeros((2, len(edges) - 1))
    for known, scan in zip(KITTI360(town), KITTI360(town, labels=out), strict=True):
        assert (
            known.label is not None
            and scan.label is not None
            and scan.confidence is not None
        )
        both = (known.label != IGNORE) & (scan.label != IGNORE)
        for row, mask in zip(
            counts, (both, both & (known.label == scan.label)), strict=True
        ):
            row += np.histogram(scan.confidence[mask], edges)[0]
    print("\n| confidence | share of the labels | right |\n|---|---:|---:|")
    for low, high, number, right in zip(edges, edges[1:], *counts, strict=False):
        shares = f"{100 * number / counts[0].sum():.1f} % | {100 * right / max(number, 1):.1f} %"
        print(f"| {low:.1f} to {min(high, 1):.1f} | {shares} |")


def fill(root: Path, points: int) -> int:
    """Fill the first static window of a town up to a number of points, and remove the other
    windows; its points."""
    drive = next((root / "data_3d_raw").iterdir()).name
    windows = find_windows(root, drive)
    for window in windows[1:]:
        window.static.unlink()
    rng = np.random.default_rng(0)
    cloud = read_cloud(windows[0].static)
    points = max(points, len(cloud))
    values = {
        name: np.resize(cloud[name], points)
        for name in PROPERTIES
        if name != "timestamp"
    }
    for axis in "xyz":
        values[axis] = values[axis] + rng.normal(0, COPY, points).astype(np.float32)
        values[axis][: len(cloud)] = cloud[axis]
    write_cloud(windows[0].static, values)
    return points


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument(
        "--interval", type=float, default=0.4, help="seconds between scans"
    )
    parser.add_argument(
        "--points", type=int, default=10_000_000, help="points of the filled window"
    )
    arguments = parser.parse_args()
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}\n")
    with tempfile.TemporaryDirectory() as folder:
        town, out, again = (Path(folder) / name for name in ("town", "labels", "again"))
        source = Town(
            arguments.seed, "hdl64e_kitti360", arguments.scans, arguments.interval
        )
        export_town(source, town, "kitti360", camera=False, accumulate=True)
        used = time.process_time()
        clock = time.perf_counter()
        report = label_scans(town, out, against=town)
        used = time.process_time() - used
        clock = time.perf_counter() - clock
        print_right(report)
        print_confidence(town, out)
        each = used / arguments.scans
        print(
            f"\n{report.counts.points / arguments.scans:,.0f} points and {1e3 * each:.0f} ms of "
            "processor time per scan"
        )
        print(
            f"{2 / each:.1f} scans/s on 2 dedicated cores; {arguments.scans / clock:.1f} scans/s "
            "by one process here"
        )
        points = fill(town, arguments.points)
        used = time.process_time()
        report = label_scans(town, again, against=town)
        used = time.process_time() - used
        scans = sum(report.labelled.values())
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"\nA window of {points:,} points: {used:.1f} s of processor time for {scans} scans, "
            "with reading"
        )
        print(f"at most {peak:.1f} GiB of memory\n")
        print_right(report)


if __name__ == "__main__":
    main()
