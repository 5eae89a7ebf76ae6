"""Processor time of projecting points to a range image and back, on one core.

    python tools/bench/projection.py [SCAN.bin] [--rounds N]

SCAN.bin is any KITTI or KITTI-360 scan; the default is a random scan of 120,000 points.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from timing import print_table, time_in_turns

from lidar_synth.formats.points import read_points
from lidar_synth.geometry.projection import (
    locate,
    project,
    project_batch,
    unfold,
    unproject,
)
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor


def random_points(sensor: Sensor, count: int = 120_000) -> np.ndarray:
    """(N, 4) points in raw ring order, ring by ring, as an HDL-64E stores them."""
    rng = np.random.default_rng(0)
    elevation = np.repeat(sensor.laser_elevations, count // sensor.shape[0])
    azimuth = np.tile(
        np.linspace(0, 2 * np.pi, count // sensor.shape[0], endpoint=False),
        sensor.shape[0],
    )
    distance = rng.uniform(3, 70, len(elevation))
    x = np.cos(azimuth) * np.cos(elevation)
    y = np.sin(azimuth) * np.cos(elevation)
    return np.c_[
        np.stack([x, y, np.sin(elevation)], 1) * distance[:, None], rng.random(len(x))
    ].astype(np.float32)


def sort_and_scatter(
    points: np.ndarray, sensor: Sensor
) -> tuple[np.ndarray, np.ndarray]:
    """The plain numpy formula: every angle by numpy, all points sorted by range, far ones
    overwritten."""
    (height, width), up, down = (
        sensor.shape,
        np.radians(np.float32(sensor.up)),
        np.radians(np.float32(sensor.down)),
    )
    distance = np.linalg.norm(points[:, :3], axis=1)
    kept = (distance >= sensor.range_min) & (distance <= sensor.range_max)
    points = points[kept]
    distance = distance[kept]
    row = (1 - (np.arcsin(points[:, 2] / distance) - down) / (up - down)) * height
    column = (-np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1) / 2 % 1 * width
    row = np.clip(row, 0, height - 1).astype(np.int32)
    column = np.clip(column, 0, width - 1).astype(np.int32)
    order = np.argsort(-distance)
    image = np.zeros((2, height, width), np.float32)
    image[0, row[order], column[order]] = distance[order]
    image[1, row[order], column[order]] = points[order, 3]
    return image[0], image[1]


def main() -> None:
    """Times everything in turns and prints two tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scan", nargs="?", type=Path, help="a .bin file")
    parser.add_argument("--rounds", type=int, default=60)
    given = parser.parse_args()
    path: Path | None = given.scan
    torch.set_num_threads(1)
    sensor = load_sensor("hdl64e_kitti360")
    with tempfile.TemporaryDirectory() as folder:
        if path is None:
            path = Path(folder) / "random.bin"
            random_points(sensor).tofile(path)
        points = read_points(path)
        scan = Scan(points[:, :3], points[:, 3], sensor)
        image = project(scan)
        assert np.array_equal(sort_and_scatter(points, sensor)[0] > 0, image.mask)
        tensor = torch.from_numpy(points)
        offsets = torch.tensor([0, len(points)])
        ours = "points -> range image with reflectance"
        calls = {
            ours: lambda: project(scan),
            "the same, numpy sort-and-scatter": lambda: sort_and_scatter(
                points, sensor
            ),
            "the same, torch on the CPU": lambda: project_batch(
                tensor, offsets, sensor
            ),
            "index map of points and cells": lambda: locate(scan.points, sensor),
            "scan unfolding": lambda: unfold(scan),
            "range image -> points with reflectance": lambda: unproject(image),
        }
        print_table(
            f"{len(points):,} points, 64 x 1024, one core",
            time_in_turns(calls, given.rounds, time.process_time),
            ours,
        )

        def read() -> Scan:
            values = read_points(path)
            return Scan(values[:, :3], values[:, 3], sensor)

        plain = "bare read (numpy.fromfile)"
        both = "read, check, project"
        seconds = time_in_turns(
            {
                plain: lambda: np.fromfile(path, np.float32),
                "project": lambda: project(scan),
                both: lambda: project(read()),
            },
            given.rounds,
            time.process_time,
        )
        print_table("From the file to the range image", seconds, both)
        print(
            "\nread, check, project = "
            f"{seconds[both] / (seconds[plain] + seconds['project']):.2f} x (read + project)"
        )


if __name__ == "__main__":
    main()
