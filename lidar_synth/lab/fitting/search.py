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

from lidar_synth.geometry.deskew import rotate
from lidar_synth.geometry.lines import CAP, Cloud, Model, nearest_beams, residuals

Floats = NDArray[np.float64]

SCANS = 3
"""Number of scans that are searched."""

POINTS = 40_000
"""Number of points of each that the search uses."""

REACH = (2.0, 2.0, 3.0)
"""Largest distance of the sensor from the frame's origin along x, y and z, metres."""

TILT = np.radians(6.0)
"""Largest tilt about x and y, radians."""

SHIFTS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0)
"""Distances driven during a turn that ``find_motion`` tries, metres."""

MOTION_POINTS = 4000
"""Number of points with which it does."""

GRID_POINTS = 9000
"""Number of points with which the grid is searched; they fill whole sectors, where pairs of points
tell beams."""

_BIN = np.radians(0.05)
_NARROW = 128  # sectors within which a tilt of a degree moves no point by more than 0.05 degrees
_SECTORS = (64, 32, 16, 8, 4, 2, 1)


def find_mount(scans: Sequence[Floats], seed: int = 0) -> tuple[Floats, Floats]:
    """(3,) offset and (3, 3) rotation of the sensor in the frame of the points.

    Each of some scans is searched alone, because the car's motion blurs some of them; the sharpest
    one decides.

    Args:
        scans: (N, 3) metres each.
        seed: of the choice of points.
    """
    chosen = [
        scans[i] for i in np.unique(np.linspace(0, len(scans) - 1, SCANS).round().astype(int))
    ]
    found = [_place_in(scan, seed) for scan in chosen if len(scan)]
    _, place = max(found, key=lambda item: item[0])
    return place[:3], tilt_of(place[3:])


def find_motion(cloud: Cloud, model: Model, scan: int) -> Floats:
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

    def mean_residual(motion: Floats) -> float:
        moved = replace(model, motion=motion[None])
        points = moved.aligned(part)
        ring = part.ring if cloud.kept else nearest_beams(points, model.tangents, model.heights)
        residual = residuals(points, ring, model.tangents, model.heights)
        return float(np.minimum(np.abs(residual), CAP).mean())

    step = np.array([0.1, 0.1, 0.05, 0.004, 0.004, 0]) / duration
    return climb(lambda motion: -mean_residual(motion), min(tried, key=mean_residual), step, 4)


def _place_in(points: Floats, seed: int) -> tuple[float, Floats]:
    """The sharpness of one scan's elevations at its best place, and the place."""
    points = points[np.hypot(points[:, 0], points[:, 1]) > 0.5]
    part = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    dense = points[(part * _NARROW / 2).astype(np.int64) % max(len(points) // GRID_POINTS, 1) == 0]
    if len(points) > POINTS:
        points = points[np.random.default_rng(seed).choice(len(points), POINTS, replace=False)]
    place = _best_on_grid(dense)
    for sectors in _SECTORS:
        step = np.array([0.1, 0.1, 0.1, 0.004, 0.004]) * (1 if sectors > 8 else 0.5)
        step = step * (1 if sectors < 32 else 4)
        place = climb(
            partial(_sharpness_within, dense if sectors > 32 else points, sectors), place, step
        )
    return sector_sharpness(points, place, 1), place


def tilt_of(angles: Floats) -> Floats:
    """(3, 3) rotation by small angles about x and y, radians."""
    return rotate(np.eye(3), np.broadcast_to(np.array([angles[0], angles[1], 0.0]), (3, 3))).T


def sector_sharpness(points: Floats, place: Floats, sectors: int) -> float:
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
    row = np.clip(((elevation / np.pi + 0.5) * rows).astype(np.int64), 0, rows - 1)
    sector = np.minimum((azimuth * sectors).astype(np.int64), sectors - 1)
    fine = np.bincount(sector * rows + row, minlength=rows * sectors).astype(np.float64)
    total = np.concatenate([[0.0], np.cumsum(fine)])
    coarse = total[5:] - total[:-5]
    # Pairs of points in a bin; counting a point with itself would reward emptiness where points are
    # few.
    return float(25 * (fine * (fine - 1)).sum() / max((coarse * (coarse - 1)).sum(), 1.0))


def _sharpness_within(points: Floats, sectors: int, place: Floats) -> float:
    limit = np.array([*REACH, TILT, TILT])
    return sector_sharpness(points, place, sectors) if (np.abs(place) <= limit).all() else 0.0


def _best_on_grid(points: Floats) -> Floats:
    sides = (-1.2, 0.0, 1.2)
    heights = (-0.2, 0.6, 1.4, 2.2)
    tilts = np.radians([-5.0, -2.5, 0.0, 2.5, 5.0])
    places = [np.array(place) for place in itertools.product(sides, sides, heights, tilts, tilts)]
    return max(places, key=lambda place: sector_sharpness(points, place, _NARROW))


def climb(
    value: Callable[[Floats], float], place: Floats, step: Floats, halvings: int = 6
) -> Floats:
    """Pattern search: the best neighbour along each axis, with steps that halve when none is
    better.

    Args:
        value: what to make as large as possible.
        place: (K,) where to start.
        step: (K,) length of the first steps; axes with 0 stay.
        halvings: number of times that the steps halve.
    """
    best = value(place)
    moves = np.concatenate([np.diag(step), -np.diag(step)])[np.tile(step > 0, 2)]
    for _ in range(halvings):
        while True:
            near = [place + move for move in moves]
            values = [value(other) for other in near]
            if max(values) <= best + 1e-6 * abs(best):
                break
            best = max(values)
            place = near[int(np.argmax(values))]
        moves = moves / 2
    return place
