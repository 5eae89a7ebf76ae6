"""Time of turning a scan of one sensor into a scan of another, on one core.

    python tools/bench/transfer.py [SCAN.bin]

SCAN.bin is any scan of KITTI or KITTI-360; the default is a scan of the town.
"""

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from timing import print_table, time_in_turns

from lidar_synth import Scan, Town, load_sensor, project, unproject
from lidar_synth.formats.points import read_points
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.geometry.transfer.surfaces import estimate

HDL64E_FIRINGS = 2170
TARGETS = {"HDL-64E, 64 x 1024": "hdl64e_kitti360", "HDL-32E, 32 x 1024": "hdl32e_nuscenes", "OS1-128": "os1_128"}


def main() -> None:
    """Times everything in turns and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", nargs="?", type=Path, help="a .bin file")
    path: Path | None = parser.parse_args().scan
    torch.set_num_threads(1)
    sensor = replace(load_sensor("hdl64e_semantic_kitti"), firings=HDL64E_FIRINGS)
    if path is None:
        scan = Town(seed=0, scans=1)[0]
    else:
        points = read_points(path)
        scan = Scan(points[:, :3], points[:, 3], sensor)
    mount = Mount(0.2, 1.0)
    sensors = {name: load_sensor(preset) for name, preset in TARGETS.items()}
    sensors["HDL-64E, 64 x 2170"] = sensor
    calls = {f"transfer to {name}": partial(Transfer(target, mount), scan) for name, target in sensors.items()}
    surfaces, grid = "of which: rings and surfaces", "one return per cell through its centre (project, unproject)"
    calls |= {surfaces: partial(estimate, scan), grid: lambda: unproject(project(scan, sensors["OS1-128"]))}
    seconds = time_in_turns(calls, rounds=20, clock=time.process_time)
    print_table(f"{len(scan):,} points, one core", seconds, surfaces)


if __name__ == "__main__":
    main()
