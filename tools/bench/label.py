"""Labels of KITTI-360's scans from accumulated clouds: how many are right in the town, speed and
memory.

    python tools/bench/label.py [--scans 200] [--seed 3] [--interval 0.4] [--points 10000000]

Right: a town is exported with accumulated clouds, which hold every second frame and have errors of
the poses (lidar_synth/lab/town/accumulate.py); labels are recovered and compared with the known
ones, for frames that the clouds hold and for frames that they do not hold. The target is 97 % of
the labelled points and 90 % of moving cars.

Speed: processor time of the whole run, with reading and writing. The target is 20 scans per second
on 2 cores. Windows of KITTI-360 have about 10 million points, those of the town 300,000; so a
window is filled up to ``--points`` by copies of its points, moved by a few centimetres, and its
scans are labelled again.
"""

import os
import resource
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from typer import run

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
    labelled = np.zeros(len(edges) - 1)
    right = np.zeros(len(edges) - 1)
    for known, scan in zip(KITTI360(town), KITTI360(town, labels=out), strict=True):
        both = (known.label != IGNORE) & (scan.label != IGNORE)
        confidence = scan.confidence[both]
        equal = (known.label == scan.label)[both]
        labelled += np.histogram(confidence, edges)[0]
        right += np.histogram(confidence[equal], edges)[0]
    shares = 100 * labelled / labelled.sum()
    good = 100 * right / np.maximum(labelled, 1)
    print("\n| confidence | share of the labels | right |\n|---|---:|---:|")
    for i, (low, high) in enumerate(pairwise(np.minimum(edges, 1))):
        print(f"| {low:.1f} to {high:.1f} | {shares[i]:.1f} % | {good[i]:.1f} % |")


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


def label(town: Path, out: Path) -> tuple[LabelReport, float]:
    """Recover the labels of a town; seconds of processor time."""
    start = time.process_time()
    report = label_scans(town, out, against=town)
    return report, time.process_time() - start


def print_filled(town: Path, out: Path, points: int) -> None:
    """Print time and memory of a window with so many points, and the shares of right labels."""
    points = fill(town, points)
    report, used = label(town, out)
    scans = sum(report.labelled.values())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"\nA window of {points:,} points: {used:.1f} s of processor time for {scans} scans, "
        f"with reading\nat most {peak:.1f} GiB of memory\n"
    )
    print_right(report)


def main(
    scans: int = 200,
    seed: int = 3,
    interval: float = 0.4,
    points: int = 10_000_000,
) -> None:
    """Prints the tables."""
    print(f"{machine()}, load {os.getloadavg()[0]:.1f}\n")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        town = root / "town"
        source = Town(seed, "hdl64e_kitti360", scans, interval)
        export_town(source, town, "kitti360", camera=False, accumulate=True)
        clock = time.perf_counter()
        report, used = label(town, root / "labels")
        clock = time.perf_counter() - clock
        print_right(report)
        print_confidence(town, root / "labels")
        print(
            f"\n{report.counts.points / scans:,.0f} points and {1e3 * used / scans:.0f} ms "
            f"of processor time per scan\n{2 * scans / used:.1f} scans/s on 2 dedicated "
            f"cores; {scans / clock:.1f} scans/s by one process here"
        )
        print_filled(town, root / "again", points)


if __name__ == "__main__":
    run(main)
