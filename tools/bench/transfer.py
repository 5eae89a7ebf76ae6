"""Processor time of turning a scan of one sensor into a scan of another, on one core.

    python tools/bench/transfer.py [SCAN.bin] [--rounds N]

SCAN.bin is any scan of KITTI or KITTI-360; the default is a scan of the shipped model, and one of
the town.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
from timing import print_table, time_in_turns
from typer import Argument, run

from lidar_synth import Scan, Town, load_generator, load_sensor, project, unproject
from lidar_synth.formats.points import read_points
from lidar_synth.geometry import Sensor
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.geometry.transfer.surfaces import estimate

HDL64E_FIRINGS = 2170
MOUNT = Mount(1.0, 0.2)
TARGETS = {
    "HDL-64E, 64 x 1024": "hdl64e_kitti360",
    "HDL-32E, 32 x 1024": "hdl32e_nuscenes",
    "OS1-128": "os1_128",
}


def scans_of(path: Path | None, sensor: Sensor) -> dict[str, Scan]:
    """The scan of a file, or one of the shipped model and one of the town."""
    if path is None:
        [made] = load_generator("town").scans(seed=0, indices=[0])
        return {"the shipped model": made, "the town": Town(seed=0, scans=1)[0]}
    points = read_points(path)
    return {path.name: Scan(points[:, :3], points[:, 3], sensor)}


def main(scan: Annotated[Path | None, Argument()] = None, rounds: int = 20) -> None:
    """Times everything in turns and prints a table of each scan."""
    torch.set_num_threads(1)
    sensor = replace(load_sensor("hdl64e_semantic_kitti"), firings=HDL64E_FIRINGS)
    ways = {f"as {n}": Transfer(load_sensor(preset)) for n, preset in TARGETS.items()}
    same = "as HDL-64E, 64 x 2170"
    ways[same] = Transfer(sensor, recast=True)
    ways[f"{same}, 1 m higher, pitched by 0.2 degrees"] = Transfer(sensor, MOUNT)
    surfaces = "of which: rings and surfaces"
    cells = partial(project, sensor=load_sensor("os1_128"))
    for name, one in scans_of(scan, sensor).items():
        calls = {way: partial(transfer, one) for way, transfer in ways.items()}
        calls[surfaces] = partial(estimate, one)
        grid = "one return per cell (project, unproject)"
        calls[grid] = lambda one=one: unproject(cells(one))
        seconds = time_in_turns(calls, rounds, time.process_time)
        title = f"A scan of {name}, {len(one):,} points, one core"
        print_table(title, seconds, surfaces)


if __name__ == "__main__":
    run(main)
