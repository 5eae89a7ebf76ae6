"""From hits to returns: losses, noise of the range, limits and quantisation of the target
sensor."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer.response import Response

DARKEST = 0.02
"""Minimum reflectance that is assumed for the strength of a signal."""


@dataclass(frozen=True)
class Measurement:
    """How the measurements of the target sensor differ from those of the recording one; by default
    they do not.

    Args:
        range_noise: metres, standard deviation of the noise that is added to the range: the part of
            the target's noise that exceeds the recording sensor's.
        loss: share of returns that are lost at random, in [0, 1).
        reach: metres at which a surface of 10 % reflectance that faces the sensor returns every
            second ray; the signal falls with the square of the distance, with the reflectance and
            with the cosine of the angle of incidence. None loses nothing.
        response: from the reflectance of the recording sensor to that of the target; None changes
            nothing.

    Raises:
        ConfigError: on values out of range.
    """

    range_noise: float = 0.0
    loss: float = 0.0
    reach: float | None = None
    response: Response | None = None

    def __post_init__(self) -> None:
        if not (
            0 <= self.range_noise <= 1
            and 0 <= self.loss < 1
            and (self.reach is None or self.reach > 0)
        ):
            raise ConfigError(
                f"range_noise={self.range_noise}, loss={self.loss}, reach={self.reach}",
                "0 to 1 m, a share below 1, and metres above 0 or None",
            )

    def returned(
        self,
        distance: NDArray[np.float64],
        reflectance: NDArray[np.float32],
        facing: NDArray[np.float32],
        at: NDArray[np.int32],
        rng: np.random.Generator,
    ) -> NDArray[np.bool_]:
        """(N,) which of N hits return.

        Args:
            distance: (N,) metres.
            reflectance: (H, F) of each ray's hit, in [0, 1].
            facing: (H, F) cosine of the angle of incidence.
            at: (N,) the ray of each hit, numbered row by row.
            rng: samples the losses.
        """
        uniform = rng.random(len(distance))
        if self.reach is None:
            return np.asarray(uniform < 1 - self.loss)
        strength = np.maximum(reflectance.take(at), DARKEST) * facing.take(at)
        signal = strength * (self.reach / distance) ** 2 / 0.1
        return np.asarray(uniform < (1 - self.loss) * (signal**2 / (1 + signal**2)))

    def ranges(
        self, distance: NDArray[np.float64], target: Sensor, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """(N,) measured ranges of hits at a distance (N,), metres, in the steps of the target."""
        if self.range_noise:
            distance = distance + self.range_noise * rng.standard_normal(len(distance))
        step = target.range_step
        return distance if step is None else np.round(distance / step) * step

    def reflectances(
        self, reflectance: NDArray[np.floating], target: Sensor
    ) -> NDArray[np.float32]:
        """(N,) measured reflectances in [0, 1], in the levels of the target: multiples of 1 /
        levels below 1."""
        if self.response is not None:
            reflectance = self.response(reflectance)
        levels = target.reflectance_levels
        if levels is not None:
            reflectance = (
                np.minimum(np.round(reflectance * levels), levels - 1) / levels
            )
        return np.asarray(np.clip(reflectance, 0, 1), np.float32)


@numba.njit(cache=True, nogil=True)
def gather_hits(rho, slope, at, distance):  # type: ignore[no-untyped-def]
    """Find the rays that hit something, row by row.

    Args:
        rho: (H, F) metres; inf = none.
        slope: (H,) of ``Rays``.
        at: (H * F,) the ray of each of N hits, numbered row by row, in the first N places.
        distance: (H * F,) metres from the laser, in the first N places.

    Returns:
        N.
    """
    found = 0
    firings = rho.shape[1]
    for r in range(rho.shape[0]):
        secant = np.sqrt(1 + slope[r] * slope[r])
        for f in range(firings):
            if rho[r, f] < np.inf:
                at[found] = r * firings + f
                distance[found] = rho[r, f] * secant
                found += 1
    return found


@numba.njit(cache=True, nogil=True)
def place_returns(at, distance, rays, low, high, points):  # type: ignore[no-untyped-def]
    """Place the returns of rays, and drop those that are out of range.

    Args:
        at: (N,) the ray of each return, numbered row by row; the M that are in range move to the
            first places.
        distance: (N,) measured from the laser, metres.
        rays: ``Rays``.
        low, high: limits of the range from the sensor's origin, metres.
        points: (N, 3) float32, metres, filled in the first M places.

    Returns:
        M.
    """
    found = 0
    for i in range(len(at)):
        r, f = divmod(at[i], rays.firings)
        rho = distance[i] / np.sqrt(1 + rays.slope[r] * rays.slope[r])
        x = np.float32(rho * rays.directions[r, f, 0])
        y = np.float32(rho * rays.directions[r, f, 1])
        z = np.float32(rays.height[r] + rho * rays.slope[r])
        away = np.sqrt(x * x + y * y + z * z)
        if rho > 0 and low <= away <= high:
            points[found, 0] = x
            points[found, 1] = y
            points[found, 2] = z
            at[found] = at[i]
            found += 1
    return found
