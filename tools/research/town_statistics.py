"""Compare the town with real KITTI-360 scans: angles, ranges, reflectance and missing returns in
one Markdown table.

    LIDAR_SYNTH_REAL_SCANS=FOLDER python tools/research/town_statistics.py [--scans 120] [--seed 0]

FOLDER contains ``kitti360`` in the dataset's own layout. Without the variable the table has the
town only. Every figure is a mean over scans; both sides are projected onto the same 64 x 1024 range
image. docs/research/town.md has the table.
"""

import os
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm
from typer import run

from lidar_synth.formats import open_scans
from lidar_synth.geometry import RangeImage, Scan, load_sensor
from lidar_synth.geometry.projection import laser_rows, project
from lidar_synth.lab.town import STRETCH_FRAMES, Town

GROUPS = [
    (0, 4),
    (4, 8),
    (8, 12),
    (12, 16),
    (16, 24),
    (24, 32),
    (32, 40),
    (40, 48),
    (48, 56),
    (56, 64),
]
"""Rows that one line of the table takes together, 0 = highest."""
RANGES = (0, 5, 10, 15, 20, 30, 40, 60, 80)
REFLECTANCE = (0, 1 / 256, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


def is_ground(points: np.ndarray) -> np.ndarray:
    """(N,) whether points lie near the plane that a sensor 1.73 m above a level road would see."""
    distance = np.hypot(points[:, 0], points[:, 1])
    return np.abs(points[:, 2] + 1.73) < 0.2 + 0.015 * distance


def statistics(scan: Scan) -> dict[str, float]:
    """All figures of one scan by name."""
    image = project(scan, load_sensor("town"))
    return {
        "points": float(len(scan)),
        "cells filled of 65,536": image.mask.sum(),
        **of_gaps(image),
        **of_directions(scan),
        **of_ranges(image),
        **of_reflectance(scan, image),
        **of_ground(scan),
    }


def gather(scans: Iterable[Scan], count: int, name: str) -> dict[str, np.ndarray]:
    """Every figure over all scans: {name: (scans,)}."""
    rows = [statistics(s) for s in tqdm(scans, total=count, desc=name, leave=False)]
    return {key: np.array([row[key] for row in rows], float) for key in rows[0]}


def number(value: float) -> str:
    """A number with three significant digits; large numbers as integers."""
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3f}"


def of_gaps(image: RangeImage) -> dict[str, float]:
    """Figures of missing returns."""
    filled = image.mask
    figures = {
        f"empty cells, rows {a} to {b - 1}": 1 - filled[a:b].mean() for a, b in GROUPS
    }
    # A row that no beam reaches is empty, but not because returns were lost.
    lost = ~filled[:, 1:-1] & filled[:, :-2] & filled[:, 2:]
    figures["single lost cells (both neighbours filled)"] = lost.mean()
    return figures


def of_directions(scan: Scan) -> dict[str, float]:
    """Figures of angles and rings."""
    x, y, z = scan.points.T
    figures = {}
    elevation = np.degrees(np.arcsin(z / np.linalg.norm(scan.points, axis=1)))
    for share in (0.5, 5, 25, 50, 75, 95, 99.5):
        name = f"elevation, {share:g} % lower than (degrees)"
        figures[name] = float(np.percentile(elevation, share))
    azimuth = np.degrees(-np.arctan2(y, x))
    for a in range(-180, 180, 45):
        inside = (azimuth >= a) & (azimuth < a + 45)
        figures[f"share of returns at azimuth {a} to {a + 45} degrees"] = inside.mean()
    ring = laser_rows(scan, scan.sensor.by_beams())
    counts = np.bincount(ring, minlength=64) / (load_sensor("town").firings or 1)
    for a in range(0, 64, 16):
        name = f"returns per firing, rings {a} to {a + 15}"
        figures[name] = counts[a : a + 16].mean()
    return figures


def of_ranges(image: RangeImage) -> dict[str, float]:
    """Figures of ranges."""
    figures = {}
    for a, b in GROUPS:
        seen = image.range[a:b][image.mask[a:b]]
        for share in (10, 50, 90):
            name = f"range in rows {a} to {b - 1}, {share} % nearer than (m)"
            figures[name] = float(np.percentile(seen, share))
    ranges = image.range[image.mask]
    for a, b in pairwise(RANGES):
        figures[f"cells at {a} to {b} m"] = ((ranges >= a) & (ranges < b)).mean()
    return figures


def of_reflectance(scan: Scan, image: RangeImage) -> dict[str, float]:
    """Figures of reflectance."""
    assert image.reflectance is not None
    values = image.reflectance[image.mask]
    figures = {}
    for a, b in pairwise(REFLECTANCE):
        name = "reflectance 0" if a == 0 else f"reflectance {a:.1f} to {b:.1f}"
        figures[name] = ((values >= a) & (values < b)).mean()
    distance = np.linalg.norm(scan.points, axis=1)
    for a, b in pairwise((0, 10, 25, 40, 80)):
        near = (distance >= a) & (distance < b)
        figures[f"mean reflectance at {a} to {b} m"] = scan.reflectance[near].mean()
    return figures


def of_ground(scan: Scan) -> dict[str, float]:
    """Figures of the ground."""
    ground = is_ground(scan.points)
    distance = np.linalg.norm(scan.points, axis=1)
    near = scan.reflectance[ground & (distance < 20)]
    return {
        "share of ground": ground.mean(),
        "share of ground beyond 20 m": ground[distance > 20].mean(),
        "mean reflectance of ground within 20 m": near.mean(),
    }


def beside(town: np.ndarray, real: np.ndarray) -> list[str]:
    """The cells of a figure of real scans beside the town's."""
    ratio = town.mean() / real.mean() if real.mean() else float("nan")
    lowest_to_highest = f"{number(real.min())} to {number(real.max())}"
    return [number(real.mean()), lowest_to_highest, f"{ratio:.2f}"]


def town_scans(seed: int, count: int) -> Iterator[Scan]:
    """Three scans of each stretch: neighbouring scans are similar, and building a stretch takes
    time."""
    town = Town(seed, scans=STRETCH_FRAMES * -(-count // 3))
    for number in range(count):
        yield town[STRETCH_FRAMES * (number // 3) + (2, 9, 16)[number % 3]]


def main(scans: int = 120, seed: int = 0) -> None:
    """Prints the table."""
    town = gather(town_scans(seed, scans), scans, "town")
    heads = ["figure", f"town ({scans} scans)"]
    real = {}
    folder = os.environ.get("LIDAR_SYNTH_REAL_SCANS")
    if folder:
        source = open_scans(Path(folder) / "kitti360")
        real = gather(source, len(source), "KITTI-360")  # type: ignore[arg-type]
        heads += [f"real ({len(source)} scans)", "real, lowest to highest"]
        heads.append("town / real")
    print("| " + " | ".join(heads) + " |\n| --- |" + " ---: |" * (len(heads) - 1))
    for key, values in town.items():
        cells = [key, number(values.mean())]
        if real:
            cells += beside(values, real[key])
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    run(main)
