"""The rays of a sensor: where each laser starts, its elevation, and its azimuth at each firing."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.sensor import Sensor


class Rays(NamedTuple):
    """H lasers with F firings each. Laser h fires at azimuth ``first[h] + f * step`` for f = 0 .. F
    - 1.

    Args:
        slope: (H,) tangent of the elevation.
        height: (H,) metres above the sensor's origin at which the laser starts.
        first: (H,) radians, clockwise.
        step: radians; F steps are a full turn.
        firings: F.
        directions: (H, F, 2) x and y of each ray's direction, per unit of horizontal distance.
    """

    slope: Float64Array
    height: Float64Array
    first: Float64Array
    step: float
    firings: int
    directions: Float64Array


def rays_from(
    slope: Float64Array,
    height: Float64Array,
    first: Float64Array,
    firings: int,
) -> Rays:
    """The rays of H lasers (H,) with F firings each, see ``Rays``."""
    step = 2 * np.pi / firings
    turned = first[:, None] + np.arange(firings) * step
    return Rays(
        slope,
        height,
        first,
        step,
        firings,
        np.stack([np.cos(turned), -np.sin(turned)], -1),
    )


@lru_cache(maxsize=16)
def rays_of(sensor: Sensor) -> Rays:
    """The rays of a sensor."""
    elevation, height = sensor.optics()
    azimuth = sensor.firing_azimuths()
    return rays_from(np.tan(elevation), height, azimuth[:, 0].copy(), azimuth.shape[1])
