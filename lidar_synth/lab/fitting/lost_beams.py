"""Beams that have too few points to be peaks."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.lines import nearest_beams
from lidar_synth.lab.fitting.model import Model

STRAY = np.radians(0.06)
"""Points farther than this from all beams may be those of a lost one."""

WINDOW = np.radians(0.025)
"""The points of a lost beam lie within this distance of it."""

LOST = 15
"""A lost beam has at least as many points."""

LOST_NEAREST = 1.5
"""Metres; nearer points are none of a lost beam: there, a laser that stands 5 mm off leaves its
line by 0.2 degrees."""


def add_lost_beams(model: Model, points: Float64Array) -> Model:
    """The model with beams that have too few points to be peaks beside the others, such as those
    that see the sky.

    A beam is found among the points beyond ``STRAY`` of all others: where they lie close together,
    with a valley between them and the next beam on either side, so that the tail of a strong beam
    is none.

    Args:
        model: with beams in any order.
        points: (N, 3) metres, in the sensor's frame.
    """
    ring = nearest_beams(points, model.tangents, model.heights)
    rho = np.hypot(points[:, 0], points[:, 1])
    above = points[:, 2] - model.heights[ring]
    elevation = np.sort(np.arctan2(above, rho)[rho > LOST_NEAREST])
    beams = list(np.arctan(model.tangents))
    heights = list(model.heights)
    stray = elevation[_distance(elevation, np.array(beams)) > STRAY]
    while len(stray) >= LOST:
        count = _count(stray, stray)
        densest = stray[np.abs(stray - stray[int(np.argmax(count))]) < WINDOW]
        place = float(np.median(densest))
        if count.max() < LOST:
            break
        if _stands_alone(elevation, place, np.array(beams), int(count.max())):
            heights.append(heights[int(np.abs(np.array(beams) - place).argmin())])
            beams.append(place)
        stray = stray[np.abs(stray - place) > STRAY]
    return replace(model, tangents=np.tan(beams), heights=np.array(heights))


def _distance(elevation: Float64Array, beams: Float64Array) -> Float64Array:
    """(N,) radians from each elevation to the nearest beam."""
    up = np.sort(beams)
    nearest = np.searchsorted((up[1:] + up[:-1]) / 2, elevation)
    return np.asarray(np.abs(elevation - up[nearest]))


def _count(elevation: Float64Array, places: Float64Array) -> NDArray[np.intp]:
    """Number of elevations (sorted) within ``WINDOW`` of each place."""
    above = np.searchsorted(elevation, places + WINDOW)
    return np.asarray(above - np.searchsorted(elevation, places - WINDOW), np.intp)


def _stands_alone(
    elevation: Float64Array, place: float, beams: Float64Array, points: int
) -> bool:
    """Whether fewer than a third as many points lie somewhere between a place and the next beam on
    either side."""
    for side in (1, -1):
        gaps = side * (beams - place)
        gap = min(gaps[gaps > 0], default=4 * STRAY)
        between = place + side * np.linspace(WINDOW, min(gap, 4 * STRAY) - WINDOW, 16)
        if gap < 3 * WINDOW or _count(elevation, between).min() >= points / 3:
            return False
    return True
