"""Processor time of projecting points to a range image and back, on one core.

    python tools/bench/projection.py [SCAN.bin] [--rounds N]

SCAN.bin is any KITTI or KITTI-360 scan; the default is a random scan of 120,000 points.
"""

import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from timing import print_table, time_in_turns
from typer import Argument, run

from lidar_synth.formats.points import read_points
from lidar_synth.geometry import Scan, Sensor, load_sensor
from lidar_synth.geometry.projection import (
    locate,
    project,
    unfold,
    unproject,
)
from lidar_synth.geometry.projection.batch import project_batch


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
    points = np.stack([x, y, np.sin(elevation)], 1) * distance[:, None]
    return np.c_[points, rng.random(len(x))].astype(np.float32)


def sort_and_scatter(
    points: np.ndarray, sensor: Sensor
) -> tuple[np.ndarray, np.ndarray]:
    """The plain numpy formula: every angle by numpy, all points sorted by range, far ones
    overwritten."""
    height, width = sensor.shape
    down = np.radians(np.float32(sensor.down))
    field = np.radians(np.float32(sensor.up)) - down
    distance = np.linalg.norm(points[:, :3], axis=1)
    kept = (distance >= sensor.range_min) & (distance <= sensor.range_max)
    points = points[kept]
    distance = distance[kept]
    row = (1 - (np.arcsin(points[:, 2] / distance) - down) / field) * height
    column = (-np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1) / 2 % 1 * width
    row = np.clip(row, 0, height - 1).astype(np.int32)
    column = np.clip(column, 0, width - 1).astype(np.int32)
    order = np.argsort(-distance)
    image = np.zeros((2, height, width), np.float32)
    image[:, row[order], column[order]] = distance[order], points[order, 3]
    return image[0], image[1]


def print_projection(scan: Scan, points: np.ndarray, rounds: int) -> None:
    """Print the first table."""
    sensor = scan.sensor
    image = project(scan)
    assert np.array_equal(sort_and_scatter(points, sensor)[0] > 0, image.mask)
    tensor = torch.from_numpy(points)
    offsets = torch.tensor([0, len(points)])
    ours = "points -> range image with reflectance"
    calls = {
        ours: lambda: project(scan),
        "the same, numpy sort-and-scatter": lambda: sort_and_scatter(points, sensor),
        "the same, torch on the CPU": lambda: project_batch(tensor, offsets, sensor),
        "index map of points and cells": lambda: locate(scan.points, sensor),
        "scan unfolding": lambda: unfold(scan),
        "range image -> points with reflectance": lambda: unproject(image),
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    print_table(f"{len(points):,} points, 64 x 1024, one core", seconds, ours)


def print_reading(path: Path, sensor: Sensor, rounds: int) -> None:
    """Print the second table."""
    scan = read(path, sensor)
    plain = "bare read (numpy.fromfile)"
    both = "read, check, project"
    calls = {
        plain: lambda: np.fromfile(path, np.float32),
        "project": lambda: project(scan),
        both: lambda: project(read(path, sensor)),
    }
    seconds = time_in_turns(calls, rounds, time.process_time)
    print_table("From the file to the range image", seconds, both)
    ratio = seconds[both] / (seconds[plain] + seconds["project"])
    print(f"\nread, check, project = {ratio:.2f} x (read + project)")


def read(path: Path, sensor: Sensor) -> Scan:
    """The scan of a file."""
    points = read_points(path)
    return Scan(points[:, :3], points[:, 3], sensor)


def main(scan: Annotated[Path | None, Argument()] = None, rounds: int = 60) -> None:
    """Times everything in turns and prints two tables."""
    torch.set_num_threads(1)
    sensor = load_sensor("hdl64e_kitti360")
    with tempfile.TemporaryDirectory() as folder:
        path = scan or Path(folder) / "random.bin"
        if scan is None:
            random_points(sensor).tofile(path)
        print_projection(read(path, sensor), read_points(path), rounds)
        print_reading(path, sensor, rounds)


if __name__ == "__main__":
    run(main)
