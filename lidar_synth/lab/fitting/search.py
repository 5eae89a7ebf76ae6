"""A first guess of where the sensor stands in the frame of the points, from points alone.

Seen from the sensor, elevations concentrate on the beams; seen from elsewhere, they do not. A tilt
hides this all around, but within a narrow sector of azimuth it is only a constant. So offset and
tilt are tried on a grid first, by the sharpness of the elevations within many narrow sectors, and
made exact as sectors are joined.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidar_synth.geometry import spread
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.lines import nearest_beams, residuals
from lidar_synth.lab.fitting.model import CAP, Cloud, Model

SCANS = 3
"""Number of scans that are searched."""

POINTS = 40_000
"""Number of points of each that the search uses."""

REACH = (2.0, 2.0, 3.0)
"""Largest distance of the sensor from the frame's origin along x, y and z, metres."""

TILT = np.radians(6.0)
"""Largest tilt about x and y, radians."""

STARTS = 5
"""Places of the grid from which a search starts, until one leads to sharp elevations; scans share
them."""

SHARP = 2.0
"""Sharpness all around from which a place is the sensor's; at a wrong one it is 1 to 1.8."""

FLAT = 1.15
"""Sharpness up to which there are no beams."""

SHIFTS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0)
"""Distances driven during a turn that ``find_motion`` tries, metres."""

MOTION_POINTS = 4000
"""Number of points with which it does."""

GRID_POINTS = 9000
"""Number of points with which the grid is searched; they fill whole sectors, where pairs of points
tell beams."""

WIDE = 5
"""Bins of a window, with whose pairs of points those within one bin are compared."""

_BIN = np.radians(0.05)
_NARROW = 128  # sectors within which a tilt of a degree moves no point by more than 0.05 degrees
_SECTORS = (64, 32, 16, 8, 4, 2, 1)


def find_mount(scans: Sequence[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """(3,) offset and (3, 3) rotation of the sensor in the frame of the points.

    Each of some scans is searched alone, because the car's motion blurs some of them; the sharpest
    one decides.

    Args:
        scans: (N, 3) metres each.
    """
    chosen = [scans[i] for i in spread(range(len(scans)), SCANS) if len(scans[i])]
    best = FLAT
    place = np.zeros(5)
    for scan in chosen:
        sharp, found = _place_in(scan, -(-STARTS // len(chosen)))
        if sharp > best:
            best = sharp
            place = found
    return place[:3], tilt_of(place[3:])


def find_motion(cloud: Cloud, model: Model, scan: int) -> Float64Array:
    """(6,) the motion of one scan for which its points lie best on the beams of the model.

    Args:
        cloud: the points of all scans.
        model: with its beams.
        scan: number of the scan.
    """
    use = np.flatnonzero(cloud.scan == scan)
    use = use[:: max(len(use) // MOTION_POINTS, 1)]
    part = Cloud(
        cloud.points[use],
        np.zeros(len(use), np.int64),
        cloud.time[use],
        cloud.ring[use],
        cloud.kept,
    )
    duration = max(float(np.ptp(part.time)), 1e-6)
    angles = np.arange(12) * np.pi / 6
    tried = [model.motion[scan], np.zeros(6)]
    tried += [
        np.array([s * np.cos(a), s * np.sin(a), 0, 0, 0, 0]) / duration
        for s in SHIFTS
        for a in angles
    ]

    def mean_residual(motion: Float64Array) -> float:
        moved = replace(model, motion=motion[None])
        points = moved.aligned(part)
        ring = (
            part.ring
            if cloud.kept
            else nearest_beams(points, model.tangents, model.heights)
        )
        residual = residuals(points, ring, model.tangents, model.heights)
        return float(np.minimum(np.abs(residual), CAP).mean())

    step = np.array([0.1, 0.1, 0.05, 0.004, 0.004, 0]) / duration
    return climb(
        lambda motion: -mean_residual(motion), min(tried, key=mean_residual), step, 4
    )


def _place_in(points: Float64Array, starts: int) -> tuple[float, Float64Array]:
    """The sharpness of one scan's elevations at its best place, and the place, from some starts on
    the grid."""
    points = points[np.hypot(points[:, 0], points[:, 1]) > 0.5]
    part = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    every = max(len(points) // GRID_POINTS, 1)
    dense = points[(part * _NARROW / 2).astype(np.int64) % every == 0]
    if len(points) > POINTS:
        rng = np.random.default_rng(0)
        points = rng.choice(points, POINTS, replace=False)
    best = FLAT
    found = np.zeros(5)
    for start in _best_on_grid(dense, starts):
        sharp, place = _sharpen(start, dense, points, best)
        if sharp > best:
            best = sharp
            found = place
        if best > SHARP:
            break
    return best, found


def _sharpen(
    place: Float64Array, dense: Float64Array, points: Float64Array, least: float
) -> tuple[float, Float64Array]:
    """The best sharpness near a place, and where; given up when it is not above ``least``."""
    for sectors in _SECTORS:
        value = partial(_sharpness_within, dense if sectors > 32 else points, sectors)
        step = np.array([0.1, 0.1, 0.1, 0.004, 0.004]) * (1 if sectors > 8 else 0.5)
        place = climb(value, place, step * (1 if sectors < 32 else 4))
        sharp = value(place)
        if sharp <= least:  # fewer sectors do not raise it
            break
    return sharp, place


def tilt_of(angles: Float64Array) -> Float64Array:
    """(3, 3) rotation by small angles about x and y, radians."""
    turned = Rotation.from_rotvec([angles[0], angles[1], 0.0])
    return np.asarray(turned.as_matrix())


def sector_sharpness(points: Float64Array, place: Float64Array, sectors: int) -> float:
    """How much the elevations concentrate within each of some sectors of azimuth, seen from a
    place.

    Args:
        points: (N, 3) metres.
        place: (5,) offset in metres, tilt about x and y in radians.
        sectors: number of sectors around the sensor.
    """
    seen = (points - place[:3]) @ tilt_of(place[3:])
    elevation = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1]))
    azimuth = np.arctan2(seen[:, 1], seen[:, 0]) / (2 * np.pi) + 0.5
    rows = round(np.pi / _BIN)
    height = (elevation / np.pi + 0.5) * rows
    row = np.clip(height, 0, rows - 1).astype(np.int32)
    sector = np.minimum((azimuth * sectors).astype(np.int32), sectors - 1)
    return _measure_concentration(np.sort(sector * np.int32(rows) + row))


def _measure_concentration(ordered: NDArray[np.int32]) -> float:
    """How much points concentrate in few of their bins, given the bins (N,) in ascending order."""
    # Bins that hold points, since most hold none.
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    count = np.diff(first, append=len(ordered)).astype(np.float64)
    filled = ordered[first]
    # Pairs of points in a bin; counting a point with itself would reward emptiness where points are
    # few.
    fine = float((count * (count - 1)).sum())
    coarse = WIDE * fine
    for lag in range(1, WIDE):
        shared = np.maximum(WIDE - (filled[lag:] - filled[:-lag]), 0)
        coarse += float(2 * (shared * count[lag:] * count[:-lag]).sum())
    return WIDE**2 * fine / max(coarse, 1.0)


def _sharpness_within(points: Float64Array, sectors: int, place: Float64Array) -> float:
    limit = np.array([*REACH, TILT, TILT])
    if (np.abs(place) <= limit).all():
        return sector_sharpness(points, place, sectors)
    return 0.0


def _best_on_grid(points: Float64Array, count: int) -> list[Float64Array]:
    """The places of the grid where elevations concentrate most within narrow sectors, the best one
    first."""
    sides = (-1.2, 0.0, 1.2)
    heights = (-0.2, 0.6, 1.4, 2.2)
    tilts = np.radians([-5.0, -2.5, 0.0, 2.5, 5.0])
    places = [
        np.array(place)
        for place in itertools.product(sides, sides, heights, tilts, tilts)
    ]
    places = sorted(places, key=lambda at: -sector_sharpness(points, at, _NARROW))
    return places[:count]


def climb(
    value: Callable[[Float64Array], float],
    place: Float64Array,
    step: Float64Array,
    halvings: int = 6,
) -> Float64Array:
    """Pattern search (Hooke and Jeeves): steps along each axis in turn, then as far again the same
    way while it helps.

    Args:
        value: what to make as large as possible.
        place: (K,) where to start.
        step: (K,) length of the first steps, which halve when none is better; axes with 0 stay.
        halvings: number of times that the steps halve.
    """
    best = value(place)
    for _ in range(halvings):
        found, reached = _explored(value, place, best, step)
        while reached > best:
            ahead = 2 * found - place
            place = found
            best = reached
            found, reached = _explored(value, ahead, value(ahead), step)
            if reached <= best:
                found, reached = _explored(value, place, best, step)
        step = step / 2
    return place


def _explored(
    value: Callable[[Float64Array], float],
    place: Float64Array,
    best: float,
    step: Float64Array,
) -> tuple[Float64Array, float]:
    """The place after one step along each axis, where it is better, and its value."""
    for axis in np.flatnonzero(step):
        for side in (step[axis], -step[axis]):
            other = place.copy()
            other[axis] += side
            reached = value(other)
            if reached > best + 1e-6 * abs(best):
                place = other
                best = reached
                break
    return place, best
