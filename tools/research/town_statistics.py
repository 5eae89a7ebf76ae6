"""Compare the town with real KITTI-360 scans: angles, ranges, reflectance and missing returns in
one Markdown table.

    LIDAR_SYNTH_REAL_SCANS=FOLDER python tools/research/town_statistics.py [--scans 120] [--seed 0]

FOLDER contains ``kitti360`` in the dataset's own layout. Without the variable the table has the
town only. Every figure is a mean over scans; both sides are projected onto the same 64 x 1024 range
image. docs/research/town.md has the table.
"""

import os
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm
from typer import run

from lidar_synth.formats import open_scans
from lidar_synth.geometry.projection import project, ring_numbers
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor
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
    sensor = load_sensor("town")
    image = project(scan, sensor)
    filled = image.mask
    ranges = image.range
    assert image.reflectance is not None
    distance = np.linalg.norm(scan.points, axis=1)
    assert sensor.firings is not None
    rings = (
        np.bincount(
            ring_numbers(scan.points) if scan.ring is None else scan.ring, minlength=64
        )[:64]
        / sensor.firings
    )
    figures = {"points": float(len(scan)), "cells filled of 65,536": filled.sum()}
    for a, b in GROUPS:
        figures[f"empty cells, rows {a} to {b - 1}"] = 1 - filled[a:b].mean()
    # A row that no beam reaches is empty, but not because returns were lost.
    lost = ~filled[:, 1:-1] & filled[:, :-2] & filled[:, 2:]
    figures["single lost cells (both neighbours filled)"] = lost.mean()
    elevation = np.degrees(np.arcsin(scan.points[:, 2] / distance))
    for share in (0.5, 5, 25, 50, 75, 95, 99.5):
        figures[f"elevation, {share:g} % lower than (degrees)"] = float(
            np.percentile(elevation, share)
        )
    azimuth = np.degrees(-np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    for a in range(-180, 180, 45):
        inside = (azimuth >= a) & (azimuth < a + 45)
        figures[f"share of returns at azimuth {a} to {a + 45} degrees"] = inside.mean()
    for a, b in ((0, 16), (16, 32), (32, 48), (48, 64)):
        figures[f"returns per firing, rings {a} to {b - 1}"] = rings[a:b].mean()
    for a, b in GROUPS:
        seen = ranges[a:b][filled[a:b]]
        for share in (10, 50, 90):
            figures[f"range in rows {a} to {b - 1}, {share} % nearer than (m)"] = float(
                np.percentile(seen, share)
            )
    for a, b in pairwise(RANGES):
        figures[f"cells at {a} to {b} m"] = (
            (ranges >= a) & (ranges < b) & filled
        ).sum() / filled.sum()
    for a, b in pairwise(REFLECTANCE):
        value = image.reflectance[filled]
        name = "reflectance 0" if a == 0 else f"reflectance {a:.1f} to {b:.1f}"
        figures[name] = ((value >= a) & (value < b)).mean()
    for a, b in ((0, 10), (10, 25), (25, 40), (40, 80)):
        near = (distance >= a) & (distance < b)
        figures[f"mean reflectance at {a} to {b} m"] = scan.reflectance[near].mean()
    ground = is_ground(scan.points)
    figures["share of ground"] = ground.mean()
    figures["share of ground beyond 20 m"] = ground[distance > 20].mean()
    figures["mean reflectance of ground within 20 m"] = scan.reflectance[
        ground & (distance < 20)
    ].mean()
    return figures


def gather(scans: Iterable[Scan], count: int, name: str) -> dict[str, np.ndarray]:
    """Every figure over all scans: {name: (scans,)}."""
    rows = [statistics(s) for s in tqdm(scans, total=count, desc=name, leave=False)]
    return {key: np.array([row[key] for row in rows], float) for key in rows[0]}


def number(value: float) -> str:
    """A number with three significant digits; large numbers as integers."""
    return (
        f"{value:,.0f}"
        if abs(value) >= 1000
        else f"{value:.1f}"
        if abs(value) >= 10
        else f"{value:.3f}"
    )


def main(
    scans: int = 120,
    seed: int = 0,
) -> None:
    """Prints the table."""
    # Three scans of each stretch: neighbouring scans are similar, and building a stretch takes
    # time.
    stretches = -(-scans // 3)
    town = Town(seed, scans=STRETCH_FRAMES * stretches)
    picked = [STRETCH_FRAMES * k + f for k in range(stretches) for f in (2, 9, 16)][
        :scans
    ]
    sides = {"town": gather((town[i] for i in picked), len(picked), "town")}
    folder = os.environ.get("LIDAR_SYNTH_REAL_SCANS")
    if folder:
        scans = open_scans(Path(folder) / "kitti360")
        sides["real"] = gather(scans, len(scans), "KITTI-360")  # type: ignore[arg-type]
    print(
        "| figure | "
        + " | ".join(
            f"{name} ({len(next(iter(s.values())))} scans)" for name, s in sides.items()
        )
        + (" | real, lowest to highest | town / real |" if folder else " |")
    )
    print("| --- |" + " ---: |" * (len(sides) + 2 * bool(folder)))
    for key, values in sides["town"].items():
        cells = [key, number(values.mean())]
        if folder:
            real = sides["real"][key]
            ratio = values.mean() / real.mean() if real.mean() else float("nan")
            cells += [
                number(real.mean()),
                f"{number(real.min())} to {number(real.max())}",
                f"{ratio:.2f}",
            ]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    run(main)
