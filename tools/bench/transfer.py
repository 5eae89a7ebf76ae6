"""Processor time of turning a scan of one sensor into a scan of another, on one core.

    python tools/bench/transfer.py [SCAN.bin] [--rounds N]

SCAN.bin is any scan of KITTI or KITTI-360; the default is a scan of the shipped model, and one of
the town.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from timing import print_table, time_in_turns

from lidar_synth import Scan, Town, load_generator, load_sensor, project, unproject
from lidar_synth.formats.points import read_points
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.geometry.transfer.surfaces import estimate

HDL64E_FIRINGS = 2170
MOUNT = Mount(1.0, 0.2)
TARGETS = {
    "HDL-64E, 64 x 1024": "hdl64e_kitti360",
    "HDL-32E, 32 x 1024": "hdl32e_nuscenes",
    "OS1-128": "os1_128",
}


def main() -> None:
    """Times everything in turns and prints a table of each scan."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scan", nargs="?", type=Path, help="a .bin file")
    parser.add_argument("--rounds", type=int, default=20)
    given = parser.parse_args()
    path: Path | None = given.scan
    torch.set_num_threads(1)
    sensor = replace(load_sensor("hdl64e_semantic_kitti"), firings=HDL64E_FIRINGS)
    if path is None:
        scans = {
            "the shipped model": load_generator("town").scans(seed=0, indices=[0])[0]
        }
        scans["the town"] = Town(seed=0, scans=1)[0]
    else:
        points = read_points(path)
        scans = {path.name: Scan(points[:, :3], points[:, 3], sensor)}
    sensors = {name: load_sensor(preset) for name, preset in TARGETS.items()}
    sensors["HDL-64E, 64 x 2170"] = sensor
    for name, scan in scans.items():
        calls: dict[str, Callable[[], object]] = {
            f"as {one}": partial(Transfer(target), scan)
            for one, target in sensors.items()
        }
        calls["as HDL-64E, 64 x 2170, 1 m higher, pitched by 0.2 degrees"] = partial(
            Transfer(sensor, MOUNT), scan
        )
        surfaces = "of which: rings and surfaces"
        grid = "one return per cell (project, unproject)"
        calls |= {
            surfaces: partial(estimate, scan),
            grid: partial(_through_cells, scan, sensors["OS1-128"]),
        }
        seconds = time_in_turns(calls, given.rounds, time.process_time)
        print_table(
            f"A scan of {name}, {len(scan):,} points, one core", seconds, surfaces
        )


def _through_cells(scan: Scan, sensor: Sensor) -> Scan:
    return unproject(project(scan, sensor))


if __name__ == "__main__":
    main()
