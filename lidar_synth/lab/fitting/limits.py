"""Range limits, and the quantisation of range and reflectance."""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array

STEPS = (0.05, 0.04, 0.03, 0.025, 0.02, 0.01, 0.005, 0.004, 0.003, 0.0025, 0.002, 0.001)
"""Steps of the range that are tried, metres."""

SCALES = (10, 15, 31, 63, 100, 127, 128, 255, 256, 1000, 1023, 1024, 4095)
"""Divisors of whole numbers in files that are tried for the reflectance."""

COHERENT = 0.6
"""Share of a beam's points on a common phase from which its ranges are in steps."""


def range_limits(distance: Float64Array) -> tuple[float, float]:
    """The nearest and the farthest range, metres, rounded outward to centimetres."""
    return float(np.floor(distance.min() * 100) / 100), float(
        np.ceil(distance.max() * 100) / 100
    )


def range_step(
    distance: Float64Array, ring: NDArray[np.int64], beams: int
) -> float | None:
    """The largest step in which the ranges of each beam are given, metres; None if they are in
    none.

    Args:
        distance: (N,) metres from the laser's own origin.
        ring: (N,) beam; each may add a constant of its own to its ranges.
        beams: number of beams.
    """
    count = np.bincount(ring, minlength=beams)
    use = count >= 100
    if not use.any():
        return None
    for step in STEPS:
        wave = np.exp(2j * np.pi * distance / step)
        total = np.abs(
            np.bincount(ring, wave.real, beams)
            + 1j * np.bincount(ring, wave.imag, beams)
        )
        if np.median(total[use] / count[use]) > COHERENT:
            return step
    return None


def reflectance_levels(reflectance: NDArray[np.float32]) -> int | None:
    """The number of values that the reflectance can have; None if it is not in equal steps.

    Args:
        reflectance: (N,) in [0, 1].
    """
    values = np.unique(reflectance).astype(np.float64)
    if len(values) < 3:
        return None
    for scale in SCALES:
        if np.abs(values * scale - np.round(values * scale)).max() < 2e-3:
            odd_or_full = scale % 2 == 1 or values[-1] > 1 - 0.5 / scale
            return scale + 1 if odd_or_full else scale
    return None
