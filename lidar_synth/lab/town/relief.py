"""Relief of soft surfaces: value noise in three octaves, fixed in the world, so that all scans of a
stretch agree."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float32Array

SIZES = (0.12, 0.4, 1.3)
"""Metres, cell sizes of the octaves."""
WEIGHTS = (0.45, 0.7, 1.0)
"""Amplitudes of the octaves."""
_SCALE = 1 / np.sqrt(sum(w * w for w in WEIGHTS) / 12 * 0.41)


@njit(cache=True)
def _corner(
    x: int,
    y: int,
    z: int,
    octave: int,
) -> float:
    """A pseudo-random value in [0, 1) of a lattice point."""
    h = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(y) * np.uint64(
        0xC2B2AE3D27D4EB4F
    )
    h ^= np.uint64(z) * np.uint64(0x165667B19E3779F9) + np.uint64(octave)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x94D049BB133111EB)
    return float(h >> np.uint64(40)) / 16777216.0


@njit(cache=True)
def _noise(
    points: Float32Array,
    sizes: NDArray[np.float64],
    weights: NDArray[np.float64],
    out: Float32Array,
) -> None:
    for i in range(len(points)):
        total = 0.0
        for k in range(len(sizes)):
            u = points[i, 0] / sizes[k]
            v = points[i, 1] / sizes[k]
            w = points[i, 2] / sizes[k]
            x = int(np.floor(u))
            y = int(np.floor(v))
            z = int(np.floor(w))
            u = u - x
            v = v - y
            w = w - z
            u = u * u * (3 - 2 * u)
            v = v * v * (3 - 2 * v)
            w = w * w * (3 - 2 * w)
            value = 0.0
            for a in range(2):
                for b in range(2):
                    for c in range(2):
                        weight = (
                            (u if a else 1 - u)
                            * (v if b else 1 - v)
                            * (w if c else 1 - w)
                        )
                        value += weight * _corner(x + a, y + b, z + c, k)
            total += weights[k] * (value - 0.5)
        out[i] = total


def sample_relief(points: Float32Array) -> Float32Array:
    """(N,) displacement at points (N, 3) of the world in metres, with mean 0 and standard deviation
    1."""
    out = np.empty(len(points), np.float32)
    _noise(points, np.array(SIZES), np.array(WEIGHTS) * _SCALE, out)
    return out
