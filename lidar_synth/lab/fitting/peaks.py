"""Beams as peaks of the distribution of elevations, for points without rings and in any order."""

import itertools

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array

BIN = np.radians(0.004)
"""Width of a bin of the histogram of elevations, radians."""

CONTRAST = 2.0
"""A peak is a beam if the density falls to less than this fraction of it, 1 / CONTRAST, on both
sides."""

SMALLEST = 0.04
"""A beam's peak has at least this share of the median peak's points."""


def density(
    elevations: Float64Array, width: float
) -> tuple[Float64Array, Float64Array]:
    """The smoothed histogram of elevations: (K,) points per bin, and (K,) the bins' centres,
    radians.

    Args:
        elevations: (N,) radians.
        width: standard deviation of the smoothing, radians.
    """
    count = round(np.pi / BIN)
    histogram = np.histogram(elevations, count, (-np.pi / 2, np.pi / 2))[0].astype(
        np.float64
    )
    reach = int(np.ceil(3 * width / BIN))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * BIN / width) ** 2)
    centres = (np.arange(count) + 0.5) * np.pi / count - np.pi / 2
    return np.convolve(histogram, kernel / kernel.sum(), "same"), centres


def beam_peaks(elevations: Float64Array, width: float) -> Float64Array:
    """(B,) elevations of the beams, highest first, radians.

    Args:
        elevations: (N,) radians.
        width: standard deviation of the smoothing, radians.
    """
    values, centres = density(elevations, width)
    top, bottom = _extrema(values)
    top, bottom = _persistent(values, top, bottom)
    if not len(top):
        return np.zeros(0)
    cut = np.concatenate([[0], bottom, [len(values)]])
    total = np.concatenate([[0], np.cumsum(values)])
    points = total[cut[1:]] - total[cut[:-1]]
    top = top[points >= SMALLEST * np.median(points)]
    return np.asarray(centres[top][::-1])


def _extrema(values: Float64Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Local maxima (P,), and the minima (P - 1,) between them."""
    rising = np.diff(np.concatenate([[0.0], values, [0.0]]))
    sign = np.sign(rising)
    known = np.flatnonzero(sign)
    turns = known[:-1][(sign[known[:-1]] > 0) & (sign[known[1:]] < 0)]
    bounds = list(itertools.pairwise(turns))
    return turns, np.array([a + np.argmin(values[a:b]) for a, b in bounds], np.intp)


def _persistent(
    values: Float64Array, top: NDArray[np.intp], bottom: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The peaks that remain when those without contrast to a neighbour are merged into it, weakest
    first."""
    top = top.copy()
    bottom = bottom.copy()
    while len(bottom):
        lower = np.minimum(values[top[:-1]], values[top[1:]])
        noise = 4 * np.sqrt(lower)  # of the count in a bin
        excess = (lower - noise) / np.maximum(values[bottom], 1e-9)
        weakest = int(np.argmin(excess))
        if excess[weakest] >= CONTRAST:
            break
        keep_left = values[top[weakest]] >= values[top[weakest + 1]]
        top = np.delete(top, weakest + 1 if keep_left else weakest)
        bottom = np.delete(bottom, weakest)
    return top, bottom
