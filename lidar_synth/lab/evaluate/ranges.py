"""Distributions of range and of its steps between neighbouring returns.

R3DPA's public evaluation names such measures (djsd, gmmd) without defining them. These definitions
are the package's own.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan
from lidar_synth.geometry.projection import project

RANGE_STEP = 0.5
RANGE_BINS = 500
"""Width of a bin of the histogram of ranges in metres, and number of bins."""

STEPS = np.concatenate([[0], np.logspace(-3, 2, 51), [np.inf]])
"""Edges of the bins of steps, metres: 50 between 1 mm and 100 m, ten for each power of ten."""


def range_histogram(scan: Scan) -> NDArray[np.uint32]:
    """(500,) number of returns by range; the last bin holds all that are farther.

    Raises:
        DataError: on a scan without returns.
    """
    distance = np.linalg.norm(scan.points, axis=1)
    if not len(distance):
        raise DataError(f"scan {scan.id!r} without returns", "a scan with returns")
    bins = np.minimum(distance / RANGE_STEP, RANGE_BINS - 1).astype(np.int64)
    return np.bincount(bins, minlength=RANGE_BINS).astype(np.uint32)


def step_histogram(scan: Scan) -> NDArray[np.uint32]:
    """(2, 52) number of absolute range differences between neighbouring returns on the scan's own
    grid: along rows, where the last column is next to the first, and along columns.

    Raises:
        DataError: on a scan without two neighbouring returns.
    """
    image = project(scan, channels=())
    sides = []
    for axis in (1, 0):
        step = np.abs(image.range - np.roll(image.range, 1, axis))
        both = image.mask & np.roll(image.mask, 1, axis)
        if axis == 0:
            both[0] = False
        sides.append(np.histogram(step[both], STEPS)[0])
    if not np.sum(sides):
        raise DataError(
            f"scan {scan.id!r} without neighbouring returns", "a scan with returns"
        )
    return np.array(sides, np.uint32)
