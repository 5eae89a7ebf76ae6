"""Learn the skin ``pandar64`` that ships with the package, and measure it on later frames.

    python tools/research/make_pandar64_skin.py FRAMES [--measure]

FRAMES is a folder of Pandar64 scans from PandaSet as NN.npz (points, reflectance 0..255, ring) in
the sensor's frame. The skin is learnt from frames 00 to 30; ``--measure`` compares the town with
frames 60 and later instead of writing it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wasserstein_distance
from typer import run

from lidar_synth.files.parsing import read_arrays
from lidar_synth.geometry import Scan, Sensor, load_sensor
from lidar_synth.lab.town import STRETCH_FRAMES, Town, fit_skin, load_skin
from lidar_synth.lab.town.returns import LEVELS, ReturnNoise
from lidar_synth.lab.town.skin.domains import Domain, returns_of
from lidar_synth.lab.town.skin.features import BAND, STRATUM_KIND

OUT = Path("lidar_synth/lab/town/skin/pandar64.skin")
FINE = 1 / 255
"""Step of the reflectance of PandaSet and of the skin."""
LAST_LEARNT = 30
FIRST_MEASURED = 60
LICENCE = (
    "CC BY 4.0 with the PandaSet Dataset Terms: attribution to Scale AI and Hesai; no use of "
    "their names or marks beyond attribution; no attempt to identify persons"
)
SOURCE = (
    "PandaSet by Scale AI and Hesai (https://pandaset.org), sequence 002, Pandar64, "
    "frames 00 to 30"
)


def frames(folder: Path, sensor: Sensor, first: int, last: int) -> list[Scan]:
    """The frames with numbers from ``first`` to ``last``."""
    scans = []
    for path in sorted(folder.glob("[0-9][0-9].npz")):
        if first <= int(path.stem) <= last:
            a = read_arrays(path, ("points", "reflectance", "ring"))
            scans.append(
                Scan(
                    a["points"],
                    a["reflectance"].astype(np.float32) / 255,
                    sensor,
                    ring=a["ring"].astype(np.int16),
                    id=path.stem,
                )
            )
    return scans


def columns_of(domain: Domain) -> tuple[np.ndarray, list[np.ndarray]]:
    """(N,) the kind and range of each return, and (N,) its reflectance, the residual of that, and
    the residual of its range (mm)."""
    stratum = np.concatenate(domain.strata)
    bright = np.concatenate([s.bright for s in domain.scans])
    mean = np.concatenate([s.found.mean for s in domain.scans])
    residual = 1e3 * np.concatenate([s.found.residual for s in domain.scans])
    return BAND[stratum] * 3 + STRATUM_KIND[stratum], [bright, bright - mean, residual]


def distances(real: Domain, town: Domain) -> list[float]:
    """Wasserstein distances of reflectance, its residual and the range's residual (mm), weighted by
    range and kind."""
    group, one = columns_of(real)
    other_group, other = columns_of(town)
    out = []
    for a, b in zip(one, other, strict=True):
        total = weight = 0.0
        for g in np.unique(group):
            x = a[(group == g) & ~np.isnan(a)]
            y = b[(other_group == g) & ~np.isnan(b)]
            if len(x) > 1000 and len(y) > 1000:
                total += len(x) * wasserstein_distance(x[::7], y[::7])
                weight += len(x)
        out.append(total / weight)
    return out


def print_distances(folder: Path, sensor: Sensor, streets: int, seed: int) -> None:
    """Prints the distances to the measured frames of the learnt frames, the physical model and the
    skin."""
    rng = np.random.default_rng(0)

    def domain(scans: Iterable[Scan], step: float, centred: bool) -> Domain:
        return Domain.of(
            [returns_of(scan, sensor, step, rng, centred) for scan in scans]
        )

    def town(step: float, centred: bool, **options: Any) -> Domain:
        source = Town(seed, sensor, streets * STRETCH_FRAMES, **options)
        indices = range(7, len(source), STRETCH_FRAMES)
        return domain((source[i] for i in indices), step, centred)

    real = domain(frames(folder, sensor, FIRST_MEASURED, 99), FINE, True)
    learnt = domain(frames(folder, sensor, 0, LAST_LEARNT), FINE, True)
    even = ReturnNoise(gain_std=0)
    rows = {
        "frames 00 to 30": learnt,
        "physical model": town(1 / LEVELS, False),
        "lasers of equal gain": town(1 / LEVELS, False, noise=even),
        "skin": town(FINE, True, skin=load_skin(OUT)),
    }
    print(
        "| frames 60 and later against | reflectance | its residual | residual of range, mm | "
        "points |\n|---|---:|---:|---:|---:|"
    )
    for name, found in rows.items():
        a, b, c = distances(real, found)
        points = np.mean([len(s.bright) for s in found.scans])
        print(f"| {name} | {a:.3f} | {b:.3f} | {c:.1f} | {points:,.0f} |")


def main(folder: Path, measure: bool = False, streets: int = 12) -> None:
    """Writes the skin, or prints the table of a town of so many streets."""
    sensor = load_sensor("pandar64")
    if measure:
        print_distances(folder, sensor, streets, seed=7)
        return
    learnt = frames(folder, sensor, 0, LAST_LEARNT)
    fit_skin(learnt, licence=LICENCE, source=SOURCE).save(OUT)


if __name__ == "__main__":
    run(main)
