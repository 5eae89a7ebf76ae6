"""Ring numbers from the order of the points, for complete and cropped scans, and a check that they
are plausible.

Lasers rotate counter-clockwise, so the azimuth (from straight ahead) increases within a ring, and a
decrease marks the start of the next ring. The decrease is a full turn in a complete scan, and less
in a scan cropped to a sector. Two other cases look like the start of a ring: a stray point, and a
step back caused by motion compensation, which changes the azimuth of near points more than that of
distant ones.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.projection.kernels import (
    count_octants,
    decreases,
    elevations_from,
    heights_of,
    medians,
    spreads,
    steps_at,
    turns_of,
)
from lidar_synth.geometry.sensor import Sensor

MIN_DECREASE = np.radians(2.0)
"""Smallest decrease of the azimuth at the start of a ring, radians."""

MOTION = 0.3
"""Largest relative shift of neighbouring points by motion compensation, metres; twice that of
SemanticKITTI's scans."""

MIN_DECREASE_ALL_AROUND = np.radians(90.0)
"""Smallest decrease of the azimuth at the start of a ring in a scan that covers all directions,
radians."""

STRAYS = 5
"""Number of points before and after the start of a ring whose median azimuth must decrease, so that
stray points do not start a ring."""

FRAGMENT = 0.05
"""A ring with less than this share of the median number of points may be a fragment of a
neighbouring ring."""


def ring_bounds(points: Float32Array) -> NDArray[np.int64]:
    """(R + 1,) the first point of each ring, and N, for a scan of N points in raw ring order or a
    crop of one."""
    groups = _start_candidates(points)
    starts = [_best_candidate(group, points) for group in groups]
    return _without_fragments(np.array([0, *starts, len(points)], np.int64), points)


def fault_of(points: Float32Array, bounds: NDArray[np.int64], lasers: Sensor) -> str:
    """Why the rings from ``ring_bounds`` cannot be those of a sensor, as a text; "" if they can.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
        bounds: (R + 1,) the first point of each ring, and N.
        lasers: the sensor, with one row per laser.
    """
    if not len(points):
        return ""
    count = len(bounds) - 1
    if count > lasers.shape[0]:
        return (
            f"{count} rings found for the {lasers.shape[0]} lasers of {lasers.name!r}"
        )
    everywhere = _all_around(points)
    if count > 1 and not everywhere:
        azimuth, flat = turns(points)
        width = float(np.ptp(np.percentile(azimuth, (1, 99))))
        near = float(np.percentile(flat, 5))
        if width < 3 * (MIN_DECREASE + 2 * MOTION / max(near, 0.1)):
            return (
                f"points over {np.degrees(width):.0f} degrees of azimuth, too few to separate "
                f"{count} rings"
            )
    beams = lasers.laser_elevations.astype(np.float64)
    gap = float(np.median(-np.diff(beams)))
    extent = float(beams[0] - beams[-1])
    elevation = np.empty(len(points), np.float32)
    elevations_from(points, np.float32(_height(points, bounds)), elevation)
    middle = np.empty(count)
    medians(elevation, bounds, middle)
    spread = np.empty(count)
    spreads(elevation, bounds, middle, spread)
    # The limits are loose: motion compensation bends rings near the sensor as much as merged rings
    # would spread.
    if np.median(spread) > gap or spread.max() > min(3 * gap, extent / 6):
        found = (
            f"{np.degrees(np.median(spread)):.2f} degrees (median) and "
            f"{np.degrees(spread.max()):.2f} (largest)"
        )
        return (
            f"{count} rings found, whose elevations spread by {found}; the lasers are "
            f"{np.degrees(gap):.2f} apart"
        )
    downward = -np.diff(middle)
    if everywhere:
        steps_at(elevation, bounds[1:-1], STRAYS, downward)
    if count > 2 and np.median(downward) < gap / 4:
        return (
            f"{count} rings found that do not descend from one to the next, each starting "
            "straight ahead"
        )
    return ""


def turns(
    points: Float32Array,
) -> tuple[Float32Array, Float32Array]:
    """(N,) radians counter-clockwise from straight ahead, in [0, 2 pi], and (N,) horizontal
    distance, metres."""
    azimuth = np.empty(len(points), np.float32)
    flat = np.empty(len(points), np.float32)
    turns_of(points, azimuth, flat)
    return azimuth, flat


def _all_around(points: Float32Array) -> bool:
    """Whether each of eight sectors of azimuth contains more than 1 % of the points."""
    counts = np.zeros(8, np.int64)
    count_octants(points, counts)
    return bool(counts.min() > 0.01 * len(points))


def _elevations(points: Float32Array) -> NDArray[np.float64]:
    """(N,) radians above the horizon of points (N, 3)."""
    elevation: NDArray[np.float64] = np.arctan2(
        points[:, 2].astype(np.float64), np.hypot(points[:, 0], points[:, 1])
    )
    return elevation


def _start_candidates(points: Float32Array) -> list[NDArray[np.intp]]:
    """Candidates for the starts of rings, grouped: candidates at most ``STRAYS`` points apart are
    one start."""
    azimuth, flat = turns(points)
    places = np.empty(len(points), np.int64)
    limits = np.empty(len(points), np.float32)
    count = decreases(
        azimuth, flat, np.float32(MIN_DECREASE), np.float32(MOTION), places, limits
    )
    places = places[:count]
    limits = limits[:count]
    if _all_around(points):
        limits = np.maximum(limits, np.float32(MIN_DECREASE_ALL_AROUND))
    steps = np.empty(count, np.float32)
    steps_at(azimuth, places, STRAYS, steps)
    back = azimuth[places - 1] - azimuth[places]
    candidates = places[(steps > limits) & (back > limits)]
    if not len(candidates):
        return []
    return np.split(candidates, np.flatnonzero(np.diff(candidates) > STRAYS) + 1)


def _best_candidate(group: NDArray[np.intp], points: Float32Array) -> int:
    """The candidate of a group that minimises the spread of the elevations on its two sides."""
    if len(group) == 1:
        return int(group[0])
    low = max(int(group[0]) - STRAYS, 0)
    high = int(group[-1]) + STRAYS
    elevation = _elevations(points[low:high])

    def spread(start: int) -> float:
        sides = elevation[: start - low], elevation[start - low :]
        return float(sum(np.abs(side - np.median(side)).sum() for side in sides))

    return int(min(group.tolist(), key=spread))


def _without_fragments(
    bounds: NDArray[np.int64], points: Float32Array
) -> NDArray[np.int64]:
    """The bounds of rings without those that only cut a fragment off a ring."""
    length = np.diff(bounds)
    short = np.flatnonzero(length < FRAGMENT * np.median(length))
    if not len(short):
        return bounds
    rings = np.split(_elevations(points), bounds[1:-1])
    middle = np.array([*map(np.median, rings)])
    gap = float(np.median(np.abs(np.diff(middle))))
    removed = set()
    for i in short.tolist():
        neighbours = [j for j in (i - 1, i + 1) if 0 <= j < len(length)]
        nearest = min(neighbours, key=lambda j: abs(middle[j] - middle[i]))
        if abs(middle[nearest] - middle[i]) < gap / 2:
            removed.add(max(i, nearest))
    return np.delete(bounds, [*removed])


def _height(points: Float32Array, bounds: NDArray[np.int64]) -> float:
    """The height of the lasers above the points' origin, metres, from pairs of near and distant
    neighbouring points.

    A laser at height h with elevation e measures z = h + r sin(e), so h is the change of z / r per
    change of 1 / r.
    """
    heights = np.empty(len(points), np.float32)
    count = heights_of(points, bounds, heights)
    return float(np.clip(np.median(heights[:count]), -1, 1)) if count else 0.0
