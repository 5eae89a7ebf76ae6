"""Compare recorded scans with their own and with other sensors: the table of
docs/research/sensors.md.

    LIDAR_SYNTH_REAL_SCANS=FOLDER LIDAR_SYNTH_LABELLED_SCANS=FOLDER python tools/research/sensor_agreement.py

The first folder contains ``kitti360``, ``semantic_kitti``, ``kitti_object``, ``kitti_raw`` and
``nuscenes``, the second ``semantic_kitti`` and ``pandaset``, where the scans of a Pandar64 are in
the frame of the sensor.
"""

import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from lidar_synth.formats import open_scans
from lidar_synth.geometry.agreement import MOST_OUTSIDE, Agreement, agreement
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.lab.town import Town

REAL, LABELLED = (
    Path(os.environ[f"LIDAR_SYNTH_{name}_SCANS"]) for name in ("REAL", "LABELLED")
)

TABLE = np.loadtxt(
    LABELLED / "pandaset" / "pandar64_elevations.csv", delimiter=",", skiprows=1
)[:, 1]
HDL64 = "HDL-64E"
OWN = "its own sensor"
SENSORS = {
    HDL64: load_sensor("hdl64e_kitti"),
    "HDL-32E": load_sensor("hdl32e_nuscenes"),
    "OS1-128": load_sensor("os1_128"),
    "Pandar64": Sensor("pandar64", 1800, 0.3, 200.0, elevations=tuple(TABLE)),
    "VLP-16": Sensor(
        "vlp16",
        1800,
        0.5,
        100.0,
        elevations=tuple(float(e) for e in range(15, -16, -2)),
    ),
}
SHARES = ("outside", "gaps", "unused", "between")


def scans() -> Iterator[tuple[str, NDArray[np.float32], Sensor]]:
    """What was recorded, its points, and its sensor."""
    sources = {
        REAL / "kitti360": "KITTI, KITTI-360 (HDL-64E)",
        REAL / "kitti_object": "KITTI, KITTI-360 (HDL-64E)",
        REAL / "kitti_raw": "KITTI, KITTI-360 (HDL-64E)",
        REAL / "semantic_kitti": "SemanticKITTI (HDL-64E, compensated)",
        LABELLED / "semantic_kitti": "SemanticKITTI (HDL-64E, compensated)",
        REAL / "nuscenes": "nuScenes (HDL-32E)",
    }
    for root, name in sources.items():
        for scan in open_scans(root):
            yield name, scan.points, scan.sensor
    for path in sorted((LABELLED / "pandaset" / "sensor_frame").glob("*.npz")):
        points = np.load(path)["points"].astype(np.float32)
        yield "PandaSet (Pandar64)", points, SENSORS["Pandar64"]
    for scan in Town(0, "os1_128", 4):
        yield "town (OS1-128)", scan.points, scan.sensor
    for scan in open_scans(REAL / "kitti360"):
        yield from some_beams(scan)


def verdicts(found: list[tuple[Agreement, Sensor]]) -> str:
    """How many scans are refused, warned about and accepted if nobody named the sensor."""
    kinds = [
        "refused"
        if shares.outside > MOST_OUTSIDE
        else "warning"
        if shares.faults(sensor)
        else "accepted"
        for shares, sensor in found
    ]
    return ", ".join(
        f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(sorted(kinds))
    )


def some_beams(scan: Scan) -> Iterator[tuple[str, NDArray[np.float32], Sensor]]:
    """A scan of the HDL-64E with a part of its beams."""
    x, y, z = scan.points.T
    beams = np.sort(scan.sensor.laser_elevations)
    between = (beams[1:] + beams[:-1]) / 2
    number = np.searchsorted(between, np.arctan2(z, np.hypot(x, y)))
    kept = {
        "every 4th beam of an HDL-64E": number % 4 == 0,
        "16 neighbouring beams of an HDL-64E": (number >= 40) & (number < 56),
    }
    for name, mask in kept.items():
        yield name, scan.points[mask], scan.sensor


def main() -> None:
    """Print the table."""
    found: dict[tuple[str, str], list[tuple[Agreement, Sensor]]] = defaultdict(list)
    seconds = []
    for name, points, own in scans():
        for claimed, sensor in {OWN: own, **SENSORS}.items():
            if claimed == OWN and "beam" in name:
                continue
            start = perf_counter()
            found[name, claimed].append((agreement(points, sensor), sensor))
            seconds.append(perf_counter() - start)
    print(
        f"| points | read as | {' | '.join(SHARES)} | verdict "
        f"|\n|---|---|{'---|' * len(SHARES)}---|"
    )
    for (name, claimed), pairs in found.items():
        values = np.array(
            [[getattr(shares, share) for share in SHARES] for shares, _ in pairs]
        )
        cells = [
            f"{low:.2f} to {high:.2f}"
            for low, high in zip(values.min(0), values.max(0), strict=True)
        ]
        print(f"| {name} | {claimed} | {' | '.join(cells)} | {verdicts(pairs)} |")
    print(
        f"\n{1000 * np.median(seconds):.1f} ms per comparison (median of {len(seconds)})"
    )


if __name__ == "__main__":
    main()
