"""Fog: hard returns are attenuated, and the fog itself returns a part of the pulse.

Rasshofer et al. 2011 ("Influences of weather phenomena on automotive laser radar
systems") and Hahner et al. 2021 ("Fog simulation on real LiDAR point clouds"): in fog of
extinction a (1 / m) and backscatter b (1 / m / sr), a target of reflectance p at range R,
and the fog in front of it, return ::

    hard  p exp(-2 a R) / R^2
    soft  pi b max_r int_0^2T sin^2(pi t / 2T) x(s) exp(-2 a s) / s^2 (c / 2) dt,  s = r - c t / 2

in the same unit, where T is the half-power width of the pulse and x(s) how much of the
beam the receiver sees. The stronger of the two is detected, if it is strong enough.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.scan import Scan
from lidar_synth.weather.corruption import (
    FLOOR,
    Change,
    Corruption,
    move_returns,
    ranges_of,
    require_between,
    signal_of,
)

LIGHT = 299_792_458.0
"""m / s."""
WIDTH = 20e-9
"""T, seconds."""
OVERLAP = 0.9, 12.0
"""Ranges from which a receiver beside the laser begins to see, and wholly sees, the beam,
metres. Haze with a visibility of hundreds of metres is then not detected."""
BACKSCATTER = 0.046
"""b times the meteorological optical range (Rasshofer et al. 2011)."""
UNEVEN = 0.5
"""Standard deviation of the logarithm of the fog's density from ray to ray."""
STEP = 0.1
"""Metres between the ranges for which the soft return is computed."""


def extinction_at(visibility: float) -> float:
    """The extinction (1 / m) at a meteorological optical range (m), over which light
    loses 95 %."""
    return float(np.log(20) / visibility)


@dataclass(frozen=True)
class Fog(Corruption):
    """Fog.

    Args:
        visibility: the meteorological optical range in metres; dense fog has 50.

    Raises:
        ConfigError: on a visibility outside 5 m to 100 km.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Fog
        >>> scan = Town(seed=0, scans=1)[0]
        >>> foggy = Fog(visibility=60)(scan, np.random.default_rng(0))
        >>> len(foggy) < len(scan), bool(np.linalg.norm(foggy.points, axis=1).max() < 70)
        (True, True)
    """

    visibility: float
    SEVERE = tuple({"visibility": np.log(20) / a} for a in (0.008, 0.05, 0.2))

    def __post_init__(self) -> None:
        require_between("visibility", self.visibility, 5, 1e5)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        extinction = extinction_at(self.visibility)
        hard = signal_of(scan, distance) * np.exp(-2 * extinction * distance)
        peak, strength = find_soft_return(extinction, BACKSCATTER / self.visibility)
        index = np.minimum(distance / STEP, len(peak) - 1).astype(int)
        soft = strength[index] * np.exp(
            UNEVEN * rng.standard_normal(len(scan), np.float32)
        )
        scattered = soft > hard
        seen = np.where(scattered, soft, hard) > FLOOR
        spread = LIGHT * WIDTH / 8 * rng.standard_normal(len(scan), np.float32)
        place = np.clip(peak[index] + np.abs(spread), STEP, np.maximum(distance, STEP))
        where = np.where(scattered, place, distance)
        signal = np.where(scattered, soft, hard)
        return move_returns(scan, distance, where, signal, scattered, seen)


@lru_cache(maxsize=16)
def find_soft_return(
    extinction: float, backscatter: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The place (m) and the strength of the fog's own return in front of a target, by
    the target's range in steps of ``STEP`` up to 200 m."""
    half = LIGHT / 2
    time = np.linspace(0, 2 * WIDTH, 200)
    pulse = np.sin(np.pi * time / (2 * WIDTH)) ** 2 * half * (time[1] - time[0])
    ranges = np.arange(0, 200, STEP)
    path = ranges[:, None] - half * time
    seen = np.clip((path - OVERLAP[0]) / (OVERLAP[1] - OVERLAP[0]), 0, 1)
    safe = np.maximum(path, OVERLAP[0])
    answer = (pulse * seen * np.exp(-2 * extinction * safe) / safe**2).sum(1)
    best = np.maximum.accumulate(answer)
    place = np.maximum.accumulate(np.where(answer >= best, ranges, 0))
    return place, np.pi * backscatter * best
