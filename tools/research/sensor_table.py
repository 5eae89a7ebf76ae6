"""The table of docs/research/fitted-sensors.md: ``fit_sensor`` on real scans and on the town,
beside what is known.

    python tools/research/sensor_table.py REAL_SCANS LABELLED_SCANS

The folders are laid out as LIDAR_SYNTH_REAL_SCANS and LIDAR_SYNTH_LABELLED_SCANS of the tests.
"error" is the largest difference of an elevation from a table: Hesai's for the Pandar64, that of
the casting sensor for the town; for two disjoint halves of the frames, it is the difference between
both fits.
"""

import time
from collections.abc import Sequence
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


def print_pandar(labelled: Path) -> None:
    """The lines of the Pandar64."""
    table = labelled / "pandaset/pandar64_elevations.csv"
    hesai = np.loadtxt(table, delimiter=",", skiprows=1)[:, 1].tolist()
    scans = pandar(labelled)
    row("Pandar64 (PandaSet), sensor frame", scans, hesai)
    row("the same without times", [replace(s, time=None) for s in scans], hesai)
    forward = [s[s.points[:, 0] > abs(s.points[:, 1])] for s in scans]
    row("the same, forward quarter", forward, hesai)
    row("the same, every fourth beam", pandar(labelled, rings=4), hesai[::4])


def print_hdl64(real: Path, labelled: Path) -> None:
    """The lines of the HDL-64E."""
    roots = {
        "KITTI": real / "kitti_object" / "training" / "velodyne",
        "SemanticKITTI": labelled / "semantic_kitti",
        "KITTI-360": real / "kitti360",
    }
    for name, root in roots.items():
        files = sorted(root.rglob("*.bin"))
        fit = row(f"HDL-64E ({name}), even frames", raw(files[::2]), None)
        table = fit.sensor.elevations or ()
        row(f"HDL-64E ({name}), odd frames", raw(files[1::2]), table)
    row("HDL-64E (KITTI-360), points shuffled", without_rings(raw(files[:5])), table)


def row(name: str, scans: list[Scan], table: Sequence[float] | None) -> SensorFit:
    """Fit, and print a line of the table."""
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


def main(real: Path, labelled: Path) -> None:
    """Prints the table."""
    print(
        "| scans | frames | beams | error (degrees) | within 0.05 | firings | offsets by | range "
        "step | seconds |\n|---|---:|---:|---:|---:|---:|---|---:|---:|"
    )
    print_pandar(labelled)
    print_hdl64(real, labelled)
    nominal = np.linspace(10.67, -30.67, 32).tolist()
    row("HDL-32E (nuScenes)", list(open_scans(real / "nuscenes")), nominal)
    for preset in ("town", "os1_128", "hdl32e_nuscenes"):
        town = Town(0, preset, motion=False)
        elevations = np.degrees(town.sensor.optics()[0]).tolist()
        row(f"town, `{preset}`", [town[i] for i in range(3)], elevations)


if __name__ == "__main__":
    run(main)
