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

from lidar_synth.formats import KITTI360, KITTIObject, KITTIRaw, NuScenes, SemanticKITTI
from lidar_synth.geometry.agreement import MOST_OUTSIDE, Agreement, agreement
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
    for source in (
        KITTI360(REAL / "kitti360"),
        KITTIObject(REAL / "kitti_object"),
        KITTIRaw(REAL / "kitti_raw"),
    ):
        yield from (
            ("KITTI, KITTI-360 (HDL-64E)", scan.points, scan.sensor) for scan in source
        )
    for root in (REAL, LABELLED):
        for scan in SemanticKITTI(root / "semantic_kitti"):
            yield "SemanticKITTI (HDL-64E, compensated)", scan.points, scan.sensor
    yield from (
        ("nuScenes (HDL-32E)", scan.points, scan.sensor)
        for scan in NuScenes(REAL / "nuscenes")
    )
    for path in sorted((LABELLED / "pandaset" / "sensor_frame").glob("*.npz")):
        yield (
            "PandaSet (Pandar64)",
            np.load(path)["points"].astype(np.float32),
            SENSORS["Pandar64"],
        )
    yield from (
        ("town (OS1-128)", scan.points, scan.sensor) for scan in Town(0, "os1_128", 4)
    )
    for scan in KITTI360(REAL / "kitti360"):
        beams = np.sort(scan.sensor.laser_elevations)
        elevation = np.arctan2(
            scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])
        )
        number = np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation)
        yield "every 4th beam of an HDL-64E", scan.points[number % 4 == 0], scan.sensor
        yield (
            "16 neighbouring beams of an HDL-64E",
            scan.points[(number >= 40) & (number < 56)],
            scan.sensor,
        )


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
