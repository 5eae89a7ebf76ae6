"""Learn a skin from unlabelled real scans: the same features of real scans and of scans of the
town, tabulated.

Within each stratum, the map from the town's quantiles to the real ones keeps the town's order of
materials and gives it the real distribution.
"""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Sensor, Source, check_source, load_sensor
from lidar_synth.lab.town.returns import LEVELS, ReturnNoise
from lidar_synth.lab.town.skin.domains import Domain, returns_of
from lidar_synth.lab.town.skin.estimate import estimate_skin
from lidar_synth.lab.town.skin.skin import Skin
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES

FEWEST_SCANS = 5
STREETS = 32
"""Streets of the town that the real scans are compared with, each with two scans."""
_STEPS = (1 / 100, 1 / 255, 1 / 256)
"""Steps of reflectance that sensors and datasets use."""


def fit_skin(
    scans: Source | Sequence[Scan],
    sensor: str | Path | Sensor | None = None,
    *,
    licence: str = "not stated",
    source: str = "",
    seed: int = 0,
    streets: int = STREETS,
    lasers: bool = False,
    progress: bool = True,
) -> Skin:
    """Learn the look of a sensor's returns from real scans of it; their labels are not used.

    Args:
        scans: 20 to 100 scans of many places, in ring order or with ring numbers; at least 5.
        sensor: the sensor that recorded them; by default that of the first scan.
        licence: the licence of the scans, which the skin's provenance states.
        source: a name for the scans.
        seed: of the town that they are compared with.
        streets: of that town, each with two scans.
        lasers: whether each laser gets the offset of reflectance that it has in the scans.
        progress: whether to show progress bars.

    Raises:
        ConfigError: on an unknown sensor, or a path, which ``open_scans`` opens.
        DataError: on fewer than 5 scans, on scans of another sensor, not in ring order, or without
            reflectance; on range images with fewer columns than the sensor fires.

    Example:
        >>> from lidar_synth import Town, fit_skin
        >>> scans = Town(seed=5, scans=6)
        >>> skin = fit_skin(scans, licence="none", streets=2, progress=False)
        >>> skin.provenance["scans"], skin.sensor.name
        (6, 'town')
    """
    check_source(scans)
    if len(scans) < FEWEST_SCANS:
        raise DataError(
            f"{len(scans)} scans",
            f"at least {FEWEST_SCANS} scans of one sensor, better 20 to 100",
        )
    own = scans[0].sensor if sensor is None else load_sensor(sensor)
    rng = np.random.Generator(np.random.Philox(key=seed))
    step = _step(np.concatenate([scans[i].reflectance for i in range(FEWEST_SCANS)]))
    digest = hashlib.sha256()
    real = []
    for i in tqdm(range(len(scans)), desc="real scans", disable=not progress):
        scan = scans[i]
        digest.update(
            np.ascontiguousarray(scan.points).tobytes() + scan.reflectance.tobytes()
        )
        real.append(returns_of(scan, own, step, rng, centred=True))
    town = Town(seed, own, streets * STRETCH_FRAMES, noise=ReturnNoise(gain_std=0))
    picked = [
        STRETCH_FRAMES * street + frame
        for street in range(streets)
        for frame in (4, 14)
    ]
    cast = [
        returns_of(town[i], own, 1 / LEVELS, rng, centred=False)
        for i in tqdm(picked, desc="town", disable=not progress)
    ]
    provenance = {
        "source": source,
        "licence": licence,
        "scans": len(scans),
        "sha256": digest.hexdigest(),
        "town": {"version": version("lidar_synth"), "seed": seed, "scans": len(picked)},
    }
    return estimate_skin(
        Domain.of(real),
        Domain.of(cast),
        own,
        step,
        provenance,
        lasers,
    )


def _step(reflectance: NDArray[np.float32]) -> float:
    """The step of reflectance, 0 if it is none of the usual ones.

    Raises:
        DataError: if all values are equal.
    """
    if np.ptp(reflectance) == 0:
        raise DataError(
            "scans whose reflectance is the same everywhere", "scans with reflectance"
        )
    for step in _STEPS:
        if np.abs(reflectance / step - np.round(reflectance / step)).max() < 0.01:
            return step
    return 0.0
