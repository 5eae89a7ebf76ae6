"""The signal of returns, its attenuation, and the signal of particles.

The signal of a surface of reflectance p at range R is p / R^2. Of the surface and of
the particles in front of it, a sensor reports the stronger one, if it is stronger than
the noise floor (Rasshofer et al. 2011, Hahner et al. 2021).
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Scan
from lidar_synth.weather.corruption import (
    SCATTERED,
    Change,
    Corruption,
    Values,
    keep_points,
)

FLOOR = 5e-5
"""Minimum signal that a sensor detects, 1 / m^2: the HDL-64E sees 10 % at 50 m and 80 % at
120 m (Velodyne's data sheet)."""
DARKEST = 0.05
"""Minimum reflectance that is assumed for a return; some are reported with 0."""
OVERLAP = 0.9, 12.0
"""Ranges in metres from which a receiver beside the laser sees a part of the beam, and all
of it. Haze with a visibility of hundreds of metres is then not detected."""


def ranges_of(scan: Scan) -> Values:
    """(N,) distances from the sensor, metres, at least 0.1."""
    x, y, z = np.ascontiguousarray(scan.points.T)
    distance: Values = np.sqrt(x * x + y * y + z * z)
    return np.asarray(np.maximum(distance, 0.1), np.float32)


def signal_of(scan: Scan, distance: Values, rng: np.random.Generator) -> Values:
    """(N,) signals in clear air, at least ``FLOOR``, because the returns were detected.

    By their reported reflectances, many far returns would be below the floor; how far they
    were above it is not known. Each signal is therefore at least ``FLOOR`` plus an excess
    from an exponential distribution of mean ``FLOOR``, which is about the mean excess of the
    far returns above it. Light weather then removes few of them.
    """
    bright = np.maximum(scan.reflectance, np.float32(DARKEST))
    excess = rng.standard_exponential(len(scan), np.float32)
    signal: Values = np.maximum(bright / (distance * distance), FLOOR * (1 + excess))
    return signal


def overlap(ranges: NDArray[Any]) -> NDArray[Any]:
    """Share of the beam that the receiver sees, by range in metres."""
    first, whole = OVERLAP
    return np.clip((ranges - first) / (whole - first), 0, 1)


@dataclass(frozen=True)
class SignalLoss(Corruption):
    """A corruption that weakens the signal.

    Args:
        compensated: share, in [0, 1], of a loss in decibels that the sensor's automatic
            power and gain make up for in the reflectance that it reports; 0 for a sensor
            that reports the signal. With the default, a network trained in clear air loses
            as much as on average in the Robo3D benchmark.
    """

    compensated: float = field(default=0.7, kw_only=True)

    def attenuate(
        self,
        scan: Scan,
        distance: Values,
        left: Values | float,
        rng: np.random.Generator,
    ) -> Change:
        """The change of a scan of N points whose surfaces return the shares ``left``, (N,)
        in [0, 1], of their signals."""
        none = np.zeros(len(scan), np.float32)
        shares = np.broadcast_to(np.float32(left), len(scan))
        return self.strongest(scan, distance, shares, none, none, rng)

    def strongest(
        self,
        scan: Scan,
        distance: Values,
        left: Values,
        soft: Values,
        place: Values,
        rng: np.random.Generator,
    ) -> Change:
        """The stronger of two returns on each ray.

        Args:
            scan: N points.
            distance: (N,) metres, ``ranges_of``.
            left: (N,) share of the surface's signal that is left.
            soft: (N,) signal of particles, 1 / m^2.
            place: (N,) their distance, metres.
            rng: for the signals that are not known, ``signal_of``.
        """
        hard = signal_of(scan, distance, rng) * left
        scattered = soft > hard
        change = keep_points(scan, np.maximum(soft, hard) >= FLOOR)
        source = change.source
        scattered = scattered[source]
        drops = source[scattered]
        change.points[scattered] *= (place[drops] / distance[drops])[:, None]
        change.reflectance[:] *= left[source] ** np.float32(1 - self.compensated)
        change.reflectance[scattered] = np.minimum(soft[drops] * place[drops] ** 2, 1)
        change.cause[scattered] = SCATTERED
        return change
