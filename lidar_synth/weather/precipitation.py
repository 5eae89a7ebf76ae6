"""Rain and snow: particles along the beam attenuate it, and single ones return it.

The numbers of particles of diameter D (mm) per m^3 and mm at a rate of r mm / h are ::

    rain  8000 exp(-4.1 r^-0.21 D)                          (Marshall and Palmer 1948)
    snow  7600 r^-0.87 exp(-2.55 r^-0.48 D)                 (Gunn and Marshall 1958)

after Kilic et al. 2021 ("Lidar Light Scattering Augmentation") and Hahner et al. 2022
("LiDAR snowfall simulation for robust 3D object detection"). All of them are much larger
than the wavelength of 905 nm, where Mie's extinction efficiency is 2: the extinction is
twice the area of the particles per m^3.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

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

EFFICIENCY = 2.0
"""Mie's extinction efficiency of particles much larger than the wavelength."""
DIVERGENCE = 3e-3
"""Full angle of the beam, radians (HDL-64E)."""
DIAMETERS = np.linspace(0.05, 10, 400)
"""Of particles, mm; a sensor does not see smaller ones."""
NEAREST, FARTHEST = 1.0, 40.0
"""Distances of particles that may return a pulse, metres: beyond, one fills too little of
the beam."""


def count_drops(rate: float) -> NDArray[np.float64]:
    """Raindrops per m^3 and mm, by ``DIAMETERS``, at a rate in mm / h."""
    return np.asarray(8000 * np.exp(-4.1 * rate**-0.21 * DIAMETERS))


def count_flakes(rate: float) -> NDArray[np.float64]:
    """Snowflakes per m^3 and mm, by ``DIAMETERS``, at a rate in mm of water / h."""
    density = 7600 * rate**-0.87
    return np.asarray(density * np.exp(-2.55 * rate**-0.48 * DIAMETERS))


def extinction_of(counts: NDArray[np.float64]) -> float:
    """The extinction (1 / m) of particles per m^3 and mm, by ``DIAMETERS``."""
    area = np.pi / 4 * (DIAMETERS * 1e-3) ** 2
    step = DIAMETERS[1] - DIAMETERS[0]
    return float(EFFICIENCY * (area * counts).sum() * step)


@dataclass(frozen=True)
class _Particles(Corruption):
    """Precipitation of a rate in mm of water per hour."""

    rate: float
    reflectance: ClassVar[float]

    def __post_init__(self) -> None:
        require_between("rate", self.rate, 0.1, 200)

    @abstractmethod
    def count(self) -> NDArray[np.float64]:
        """Particles per m^3 and mm, by ``DIAMETERS``."""

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        counts = self.count()
        loss = 2 * extinction_of(counts)
        distance = ranges_of(scan)
        place, share = nearest_particles(counts, distance, rng)
        # What the particle lets pass, and what it returns.
        hard = signal_of(scan, distance) * np.exp(-loss * distance) * (1 - share)
        soft = self.reflectance * share / place**2 * np.exp(-loss * place)
        scattered = (soft > hard) & (place < distance)
        signal = np.where(scattered, soft, hard)
        where = np.where(scattered, place, distance)
        return move_returns(scan, distance, where, signal, scattered, signal > FLOOR)


@dataclass(frozen=True)
class Rain(_Particles):
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

    SEVERE = {"rate": 5.0}, {"rate": 20.0}, {"rate": 60.0}
    reflectance = 0.02  # of water, Fresnel at normal incidence

    def count(self) -> NDArray[np.float64]:
        return count_drops(self.rate)


@dataclass(frozen=True)
class Snow(_Particles):
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

    SEVERE = {"rate": 0.5}, {"rate": 1.0}, {"rate": 2.5}
    reflectance = 0.9

    def count(self) -> NDArray[np.float64]:
        return count_flakes(self.rate)


def nearest_particles(
    counts: NDArray[np.float64],
    distance: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The particle on each ray that returns most of the pulse.

    Args:
        counts: particles per m^3 and mm, by ``DIAMETERS``.
        distance: (N,) of the targets, metres.
        rng: source of the random numbers.

    Returns:
        (N,) distances of the particles in metres, and the shares of the beam's area that
        they fill, 0 where there is none.
    """
    numbers = counts * (DIAMETERS[1] - DIAMETERS[0])
    reach = np.clip(distance, NEAREST, FARTHEST)
    slope = DIVERGENCE / 2
    # Expected number in the beam's cone, and a place in it by its volume.
    volume = np.pi / 3 * slope**2 * (reach**3 - NEAREST**3)
    place = np.cbrt(NEAREST**3 + rng.random(len(distance)) * (reach**3 - NEAREST**3))
    # Of many particles in the beam, the one that is nearest to the sensor returns most.
    many = np.maximum(volume * numbers.sum(), 1e-12)
    found = rng.poisson(many)
    nearest = NEAREST + (place - NEAREST) / np.maximum(found, 1) ** (1 / 3)
    shares = np.cumsum(numbers) / numbers.sum()
    drawn = np.searchsorted(shares, rng.random(len(distance)))
    diameter = DIAMETERS[np.minimum(drawn, len(DIAMETERS) - 1)] * 1e-3
    filled = np.minimum((diameter / (2 * slope * nearest)) ** 2, 1)
    return nearest, np.where(found > 0, filled, 0)
