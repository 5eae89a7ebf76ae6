"""Rain and snow: particles along the beam attenuate it, and single ones return it.

The numbers n(D) of particles of diameter D (mm) per m^3 and mm at r mm of water / h are ::

    rain  8000 exp(-4.1 r^-0.21 D)                          (Marshall and Palmer 1948)
    snow  3800 r^-0.87 exp(-2.55 r^-0.48 D), D when melted  (Gunn and Marshall 1958)

after Kilic et al. 2021 ("Lidar light scattering augmentation") and Hahner et al. 2022
("LiDAR snowfall simulation for robust 3D object detection"). Their extinction is ::

    a = int Q(D) (pi / 4) D^2 n(D) dD

with Mie's efficiency Q. A particle of reflectance q at range r in a beam of the full
angle d fills the share (D / (r d))^2 of it, so that its signal is ::

    S = q (D / d)^2 / r^4

All particles nearer than r(D, S) have a signal of more than S. The expected number of them
in the beam's cone, over all diameters, is ::

    k(S) = (pi / 12) d^2 (q / (d^2 S))^(3/4) int D^(3/2) n(D) dD

The strongest particle on a ray has the signal for which k is a standard exponential random
number. The receiver's view of the beam near the sensor (``signal.overlap``) is applied after
the draw. This is an approximation, as it may make another particle the strongest.
"""

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from lidar_synth.geometry import Scan
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.weather.corruption import Change, Values, require_between
from lidar_synth.weather.signal import SignalLoss, overlap, ranges_of

WAVELENGTH = 905e-6
"""Wavelength of the laser, mm."""
DIVERGENCE = 3e-3
"""Full angle d of the beam, radians (HDL-64E)."""
DIAMETERS = np.linspace(0.05, 10, 400)
"""Diameters D of particles, mm; a sensor does not see smaller ones."""
FLAKE = 10 ** (1 / 3)
"""Ratio of the diameter of a flake to that of the drop to which it melts, which is Gunn and
Marshall's D: snow has a tenth of the density of water."""
_STEP = DIAMETERS[1] - DIAMETERS[0]
_LEVELS = (np.arange(1024) + 0.5) / 1024


def extinction_efficiency(diameter: Float64Array) -> Float64Array:
    """Mie's extinction efficiency Q of particles much larger than the wavelength, of any
    refractive index (Nussenzveig and Wiscombe 1980); diameters in mm."""
    size = np.pi * diameter / WAVELENGTH
    return np.asarray(2 + 1.992 * size ** (-2 / 3))


@dataclass(frozen=True)
class Precipitation(SignalLoss):
    """Particles that fall at a rate in mm of water per hour."""

    rate: float
    reflectance: ClassVar[float]
    """q."""

    def __post_init__(self) -> None:
        require_between("rate", self.rate, 0.1, 200)

    @abstractmethod
    def number(self) -> Float64Array:
        """n(D) by ``DIAMETERS``."""

    @cached_property
    def extinction(self) -> float:
        """The extinction a, 1 / m."""
        area = np.pi / 4 * (DIAMETERS * 1e-3) ** 2
        efficiency = extinction_efficiency(DIAMETERS)
        return float((efficiency * area * self.number()).sum() * _STEP)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        place, filled = self.draw_particles(len(scan), rng)
        loss = np.float32(-2 * self.extinction)
        soft = self.reflectance * filled * overlap(place) / place**2
        soft *= np.exp(loss * place)
        in_front = place < distance
        # The strongest particle also blocks its share of the pulse.
        left = np.exp(loss * distance) * (1 - filled * in_front)
        return self.strongest(scan, distance, left, soft * in_front, place, rng)

    def draw_particles(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Values, Values]:
        """Distances in metres of the strongest particles on ``count`` rays, and the
        shares of their beams that they fill."""
        weight = (DIAMETERS * 1e-3) ** 1.5 * self.number()
        share = np.cumsum(weight) / weight.sum()
        quantiles = np.interp(_LEVELS, share, DIAMETERS).astype(np.float32) * 1e-3
        diameter = quantiles[rng.integers(len(quantiles), size=count)]
        expected = np.pi / 12 * DIVERGENCE**2 * weight.sum() * _STEP
        k = rng.standard_exponential(count, np.float32)
        place = np.sqrt(diameter) * np.cbrt(k / np.float32(expected))
        place = np.maximum(place, np.float32(0.1))
        filled = np.minimum((diameter / (place * np.float32(DIVERGENCE))) ** 2, 1)
        return place, filled


@dataclass(frozen=True)
class Rain(Precipitation):
    """Rain.

    Args:
        rate: mm / h; 2.5 is light, 50 violent.

    Raises:
        ConfigError: on a rate outside 0.1 to 200 mm / h.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Rain
        >>> scan = Town(seed=0, scans=1)[0]
        >>> len(Rain(rate=50)(scan, np.random.default_rng(0))) < len(scan)
        True
    """

    name = "rain"
    SEVERE = {"rate": 5.0}, {"rate": 20.0}, {"rate": 60.0}
    reflectance = 0.02  # of water, Fresnel at normal incidence

    def number(self) -> Float64Array:
        return np.asarray(8000 * np.exp(-4.1 * self.rate**-0.21 * DIAMETERS))


@dataclass(frozen=True)
class Snow(Precipitation):
    """Snow.

    Args:
        rate: mm of water / h; 0.5 is light, 2.5 heavy.

    Raises:
        ConfigError: on a rate outside 0.1 to 200 mm / h.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Snow
        >>> scan = Town(seed=0, scans=1)[0]
        >>> len(Snow(rate=2.5)(scan, np.random.default_rng(0))) < len(scan)
        True
    """

    name = "snow"
    # As dense as the Robo3D benchmark's snow at a third of the rates: its code has twice the
    # flakes of Gunn and Marshall.
    SEVERE = {"rate": 1.5}, {"rate": 3.0}, {"rate": 7.5}
    reflectance = 0.9

    def number(self) -> Float64Array:
        density = 3800 * self.rate**-0.87 / FLAKE
        slope = 2.55 * self.rate**-0.48 / FLAKE
        return np.asarray(density * np.exp(-slope * DIAMETERS))
