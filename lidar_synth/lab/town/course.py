"""From street coordinates to the world: a curved centre line and the hills under it.

Street coordinates are (s, t): metres along the centre line, and metres to its left.
"""

import numpy as np
from numpy.typing import ArrayLike

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import Rng


class Course:
    """The curved centre line of a street, which maps street coordinates to the world.

    Args:
        start, end: metres, the interval of s that is curved; beyond it the street is straight.
        bend: largest curvature, 1/m.
        rng: samples the curvature.
    """

    def __init__(
        self,
        start: float,
        end: float,
        bend: float,
        rng: Rng,
    ) -> None:
        self._s = np.arange(start, end + 1.0)
        waves = sum(
            rng.normal()
            * np.sin(2 * np.pi * self._s / rng.uniform(90, 260) + rng.uniform(0, 6.3))
            for _ in range(3)
        )
        curvature = bend * np.tanh(waves)
        self._yaw = np.cumsum(curvature) - curvature.sum() / 2
        self._xy = np.cumsum(np.stack([np.cos(self._yaw), np.sin(self._yaw)]), 1)

    def heading(self, s: ArrayLike) -> Float64Array:
        """Heading of the centre line at s, radians counter-clockwise from the world's +x."""
        return np.asarray(np.interp(np.asarray(s, float), self._s, self._yaw))

    def points(self, s: ArrayLike, t: ArrayLike) -> Float64Array:
        """(..., 2) x and y in the world of street coordinates, metres."""
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        yaw = self.heading(s)
        beyond = s - np.clip(s, self._s[0], self._s[-1])
        cosine = np.cos(yaw)
        sine = np.sin(yaw)
        x = np.interp(s, self._s, self._xy[0]) + beyond * cosine - t * sine
        y = np.interp(s, self._s, self._xy[1]) + beyond * sine + t * cosine
        return np.stack([x, y], -1)


class Relief:
    """The heights of the terrain: gentle hills, banks beside the street, and high ground far away.

    Args:
        grade: standard deviation of the slopes, e.g. 0.012.
        rng: samples hills, banks and slopes.
    """

    def __init__(self, grade: float, rng: Rng) -> None:
        self._length = rng.uniform(70, 240, 4)
        self._phase = rng.uniform(0, 2 * np.pi, 4)
        self._way = rng.uniform(-0.6, 0.6, 4)
        self._height = grade * rng.normal(0, 0.6, 4) * self._length / (2 * np.pi)
        self._slope = grade * rng.normal()
        self._banks = np.clip(rng.normal(0, 2.5 * grade, 2), -0.06, 0.10)
        self._far = rng.uniform(1, 9, 2)

    def __call__(self, s: ArrayLike, t: ArrayLike) -> Float64Array:
        """Height at street coordinates, metres."""
        s = np.asarray(s, float)
        t = np.asarray(t, float)
        ways = s[..., None] * np.cos(self._way) + t[..., None] * np.sin(self._way)
        along = ways / self._length
        waves = np.sin(2 * np.pi * along + self._phase)
        hills = (self._height * waves).sum(-1)
        left = t > 0
        out = np.abs(t)
        bank = np.where(left, *self._banks) * np.clip(out - 9, 0, 40)
        beyond = np.clip((out - 90) / 100, 0, 1)
        far = np.where(left, *self._far) * beyond**2
        return np.asarray(hills + self._slope * s + bank + far)
