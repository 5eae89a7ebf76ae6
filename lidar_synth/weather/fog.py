"""Fog: hard returns are attenuated, and the fog itself returns a part of the pulse.

Rasshofer et al. 2011 ("Influences of weather phenomena on automotive laser radar
systems") and Hahner et al. 2021 ("Fog simulation on real LiDAR point clouds"): in fog of
extinction a (1 / m) and backscatter b (1 / m / sr), a target of reflectance p at range R,
and the fog in front of it, return ::

    hard  p exp(-2 a R) / R^2
    soft  pi b max_r int_0^2T sin^2(pi t / 2T) x(s) exp(-2 a s) / s^2 (c / 2) dt,  s = r - c t / 2

in the same unit, where T is the half-power width of the pulse and x(s) the share of the
beam that the receiver sees (``signal.overlap``).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Scan
from lidar_synth.weather.corruption import Change, require_between
from lidar_synth.weather.signal import OVERLAP, SignalLoss, overlap, ranges_of

LIGHT = 299_792_458.0
"""m / s."""
WIDTH = 20e-9
"""T, seconds."""
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
class Fog(SignalLoss):
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
    name = "fog"
    SEVERE = {"visibility": 374.0}, {"visibility": 60.0}, {"visibility": 15.0}

    def __post_init__(self) -> None:
        require_between("visibility", self.visibility, 5, 1e5)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        extinction = extinction_at(self.visibility)
        left = np.exp(np.float32(-2 * extinction) * distance)
        peak, strength = find_soft_return(extinction, BACKSCATTER / self.visibility)
        index = np.minimum(distance / STEP, len(peak) - 1).astype(np.int32)
        noise = rng.standard_normal((2, len(scan)), np.float32)
        soft = strength[index] * np.exp(UNEVEN * noise[0])
        place = peak[index] + np.float32(LIGHT * WIDTH / 8) * np.abs(noise[1])
        place = np.minimum(place, distance)
        return self.strongest(scan, distance, left, soft, place, rng)


@lru_cache(maxsize=16)
def find_soft_return(
    extinction: float, backscatter: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The place (m) and the strength (1 / m^2) of the fog's own return in front of a
    target, by the target's range in steps of ``STEP`` up to 200 m."""
    half = LIGHT / 2
    time = np.linspace(0, 2 * WIDTH, 200)
    pulse = np.sin(np.pi * time / (2 * WIDTH)) ** 2 * half * (time[1] - time[0])
    ranges = np.arange(0, 200, STEP)
    path = np.maximum(ranges[:, None] - half * time, OVERLAP[0])
    received = overlap(path) * np.exp(-2 * extinction * path) / path**2
    answer = received @ pulse
    best = np.maximum.accumulate(answer)
    place = np.maximum.accumulate(np.where(answer >= best, ranges, 0))
    strength = np.pi * backscatter * best
    return place.astype(np.float32), strength.astype(np.float32)
