"""The table of docs/research/fitted-sensors.md: ``fit_sensor`` on real scans and on the town,
beside what is known.

    python tools/research/sensor_table.py REAL_SCANS LABELLED_SCANS

The folders are laid out as LIDAR_SYNTH_REAL_SCANS and LIDAR_SYNTH_LABELLED_SCANS of the tests.
"error" is the largest difference of an elevation from a table: Hesai's for the Pandar64, that of
the casting sensor for the town; for two disjoint halves of the frames, it is the difference between
both fits.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from typer import run

from lidar_synth import Scan, Town, fit_sensor, load_sensor, open_scans
from lidar_synth.formats.points import read_points
from lidar_synth.lab.fitting import SensorFit

SENSOR = load_sensor("town")
FRAMES = (0, 20, 40, 60, 70)


def pandar(
    labelled: Path, frames: Sequence[int] = FRAMES, rings: int = 1
) -> list[Scan]:
    """Frames of the Pandar64 without rings, or every so many rings of them."""
    scans = []
    for frame in frames:
        with np.load(labelled / f"pandaset/sensor_frame/{frame:02d}.npz") as file:
            kept = file["ring"] % rings == 0
            reflectance = file["reflectance"].astype(np.float32) / 255
            scan = Scan(
                file["points"],
                reflectance,
                SENSOR,
                time=file["time"],
                id=f"{frame:02d}",
            )
        scans.append(scan[kept])
    return scans


def raw(files: Sequence[Path]) -> list[Scan]:
    """Scans of KITTI's order of points."""
    points = [read_points(path) for path in files]
    return [
        Scan(p[:, :3], p[:, 3], SENSOR, id=path.stem)
        for p, path in zip(points, files, strict=True)
    ]


def without_rings(scans: Sequence[Scan]) -> list[Scan]:
    """The scans without rings, their points in random order."""
    rng = np.random.default_rng(0)
    return [replace(scan, ring=None)[rng.permutation(len(scan))] for scan in scans]


def largest_error(fit: SensorFit, table: Sequence[float]) -> float:
    """The largest difference of a fitted beam from a table, degrees; infinite if the numbers of
    beams differ."""
    found = np.asarray(fit.sensor.elevations)
    if len(found) != len(table):
        return float("inf")
    return float(np.abs(found - np.asarray(table)).max())


def row(
    name: str, make: Callable[[], list[Scan]], table: Sequence[float] | None
) -> SensorFit:
    """Fit, and print a line of the table."""
    scans = make()
    start = time.process_time()
    fit = fit_sensor(scans)
    seconds = time.process_time() - start
    error = "" if table is None else f"{largest_error(fit, table):.4f}"
    step = f"{1000 * fit.sensor.range_step:.0f} mm" if fit.sensor.range_step else ""
    print(
        f"| {name} | {len(scans)} | {len(fit.points)} | {error} | {fit.share:.2%} | "
        f"{fit.sensor.firings} | {fit.azimuths.known} | {step} | {seconds:.1f} |",
        flush=True,
    )
    return fit


def main(
    real: Path,
    labelled: Path,
) -> None:
    """Prints the table."""
    real = real
    labelled = labelled
    hesai = np.loadtxt(
        labelled / "pandaset/pandar64_elevations.csv", delimiter=",", skiprows=1
    )[:, 1].tolist()
    print(
        "| scans | frames | beams | error (degrees) | within 0.05 | firings | offsets by | range "
        "step | seconds |"
    )
    print("|---|---:|---:|---:|---:|---:|---|---:|---:|")
    row("Pandar64 (PandaSet), sensor frame", lambda: pandar(labelled), hesai)
    row(
        "the same without times",
        lambda: [replace(s, time=None) for s in pandar(labelled)],
        hesai,
    )
    row(
        "the same, forward quarter",
        lambda: [s[s.points[:, 0] > abs(s.points[:, 1])] for s in pandar(labelled)],
        hesai,
    )
    row("the same, every fourth beam", lambda: pandar(labelled, rings=4), hesai[::4])
    tables: dict[str, Sequence[float]] = {}
    for name, files in {
        "KITTI-360": sorted((real / "kitti360").rglob("*.bin")),
        "KITTI": sorted(
            (real / "kitti_object" / "training" / "velodyne").glob("*.bin")
        ),
        "SemanticKITTI": sorted((labelled / "semantic_kitti").rglob("*.bin")),
    }.items():
        first = row(
            f"HDL-64E ({name}), even frames", lambda files=files: raw(files[::2]), None
        )  # type: ignore[misc]
        table = first.sensor.elevations or ()
        tables[name] = table
        row(
            f"HDL-64E ({name}), odd frames", lambda files=files: raw(files[1::2]), table
        )  # type: ignore[misc]
    row(
        "HDL-64E (KITTI-360), points shuffled",
        lambda: without_rings(raw(sorted((real / "kitti360").rglob("*.bin"))[:5])),
        tables["KITTI-360"],
    )
    row(
        "HDL-32E (nuScenes)",
        lambda: list(open_scans(real / "nuscenes")),
        np.linspace(10.67, -30.67, 32).tolist(),
    )
    for preset in ("town", "os1_128", "hdl32e_nuscenes"):
        sensor = load_sensor(preset)
        elevations = np.degrees(sensor.optics()[0]).tolist()
        row(
            f"town, `{preset}`",
            lambda p=preset: [Town(0, p, motion=False)[i] for i in range(3)],
            elevations,
        )  # type: ignore[misc]


if __name__ == "__main__":
    run(main)
