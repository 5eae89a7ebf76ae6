"""Real scans turned into scans of another sensor, beside real scans of that sensor.

    python tools/transfer_statistics.py SEMANTIC_KITTI PANDASET NUSCENES

The arguments are those of ``tools/transfer_trial.py``, and a folder with sweeps of nuScenes. Rows
tell the share of returns within 0.01 degrees of a beam of the target, the fill (returns per ray, of
the beams that all sensors cover) and quantiles of the range over those beams. "To itself" is the
share of a scan's returns that the same sensor in the same place gives back in the same ray, within
10 cm or 1 %.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from transfer_trial import HDL64E_FIRINGS, read_pandaset, read_semantic_kitti, road_height

from lidar_synth import Scan, Sensor, load_sensor, open_scans
from lidar_synth.geometry.projection import ring_numbers
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.geometry.transfer.rays import rays_of

HDL32E_FIRINGS = 1084
BAND = -12.0, -1.0
"""Degrees of elevation that all sensors cover, also from the other mounts: only these beams are
compared."""
NUSCENES_HEIGHT = 1.84
"""Metres of nuScenes' LiDAR above the road."""


def described(name: str, scans: Sequence[Scan], low: float, high: float) -> str:
    """One row of the table, for the beams between two elevations in degrees."""
    sensor = scans[0].sensor
    rays = rays_of(sensor)
    beams = np.degrees(np.arctan(rays.slope))
    counted = (beams >= low) & (beams <= high)
    near = []
    fill = []
    ranges = []
    for scan in scans:
        ring = ring_numbers(scan.points) if scan.ring is None else scan.ring
        elevation = np.arctan2(
            scan.points[:, 2] - rays.height[ring], np.hypot(*scan.points[:, :2].T)
        )
        near.append(np.mean(np.abs(np.degrees(elevation) - beams[ring]) < 0.01))
        kept = counted[ring]
        fill.append(kept.sum() / (counted.sum() * rays.firings))
        ranges.append(np.linalg.norm(scan.points[kept], axis=1))
    quantiles = np.quantile(np.concatenate(ranges), [0.05, 0.25, 0.5, 0.75, 0.95])
    return (
        f"| {name} | {len(scans)} | {100 * np.mean(near):.1f} | {100 * np.mean(fill):.1f} | "
        + " | ".join(f"{q:.1f}" for q in quantiles)
        + " |"
    )


def to_itself(scan: Scan) -> float:
    """Share of a scan's returns that the same sensor in the same place gives back."""
    found = Transfer(scan.sensor)(scan)
    images = [_image(s) for s in (scan, found)]
    there = images[0] > 0
    return float((np.abs(images[0] - images[1]) < np.maximum(0.1, 0.01 * images[0]))[there].mean())


def _image(scan: Scan) -> NDArray[np.float64]:
    rays = rays_of(scan.sensor)
    image = np.zeros((len(rays.slope), rays.firings))
    assert scan.ring is not None
    firing = (-np.arctan2(scan.points[:, 1], scan.points[:, 0]) - rays.first[scan.ring]) / rays.step
    image[scan.ring, np.rint(firing).astype(int) % rays.firings] = np.linalg.norm(
        scan.points, axis=1
    )
    return image


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kitti", type=Path)
    parser.add_argument("pandaset", type=Path)
    parser.add_argument("nuscenes", type=Path)
    given = parser.parse_args()
    kitti = read_semantic_kitti(given.kitti)
    panda = read_pandaset(given.pandaset)
    hdl32e: Sensor = replace(load_sensor("hdl32e_nuscenes"), firings=HDL32E_FIRINGS)
    nuscenes = [replace(s) for s in open_scans(given.nuscenes, sensor=hdl32e)]
    height = {
        "kitti": road_height(kitti),
        "panda": road_height(panda),
        "nuscenes": -NUSCENES_HEIGHT,
    }
    print(
        "| scans | number | on a beam, % | fill, % | 5 % | 25 % | median | 75 % | 95 % of ranges, "
        "m |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name, source, own, target, real in (
        ("SemanticKITTI as Pandar64", kitti, "kitti", "panda", panda),
        ("SemanticKITTI as HDL-32E", kitti, "kitti", "nuscenes", nuscenes),
        ("PandaSet as HDL-64E", panda, "panda", "kitti", kitti),
    ):
        transfer = Transfer(real[0].sensor, Mount(round(height[own] - height[target], 2)))
        print(
            described(
                f"{name}, {transfer.mount.z:+.2f} m", [transfer(scan) for scan in source], *BAND
            )
        )
        print(described(f"real {real[0].sensor.name}", real, *BAND))
    print()
    print(
        f"PandaSet to itself: {100 * np.mean([to_itself(scan) for scan in panda[::8]]):.1f} % of "
        "returns come back"
    )
    print(f"firings of an HDL-64E: {HDL64E_FIRINGS}; of an HDL-32E: {HDL32E_FIRINGS}")


if __name__ == "__main__":
    main()
