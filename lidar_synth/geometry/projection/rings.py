"""Ring numbers from the order of the points, for complete and cropped scans, and a check that they are plausible.

Lasers rotate counter-clockwise, so the azimuth (from straight ahead) increases within a ring, and a decrease marks the
start of the next ring. The decrease is a full turn in a complete scan, and less in a scan cropped to a sector. Two
other cases look like the start of a ring: a stray point, and a step back caused by motion compensation, which changes
the azimuth of near points more than that of distant ones.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor

MIN_DECREASE = np.radians(2.0)
"""Smallest decrease of the azimuth at the start of a ring, radians."""

MOTION = 0.3
"""Largest relative shift of neighbouring points by motion compensation, metres; twice that of SemanticKITTI's scans."""

MIN_DECREASE_ALL_AROUND = np.radians(90.0)
"""Smallest decrease of the azimuth at the start of a ring in a scan that covers all directions, radians."""

STRAYS = 5
"""Number of points before and after the start of a ring whose median azimuth must decrease, so that stray points do
not start a ring."""

FRAGMENT = 0.05
"""A ring with less than this share of the median number of points may be a fragment of a neighbouring ring."""


def ring_numbers(points: NDArray[np.float32]) -> NDArray[np.int16]:
    """(N,) ring of each point, 0 = the first in the file, for a scan in raw ring order or a crop of one.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
    """
    starts = np.zeros(len(points), bool)
    groups = _start_candidates(points)
    if groups:
        elevation = _elevations(points)
        starts[_without_fragments(np.array([_best_candidate(group, elevation) for group in groups]), elevation)] = True
    return np.cumsum(starts, dtype=np.int16)


def fault_of(points: NDArray[np.float32], ring: NDArray[np.int16], lasers: Sensor) -> str:
    """Why the rings from ``ring_numbers`` cannot be those of a sensor, as a text; "" if they can.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
        ring: (N,) increasing from 0.
        lasers: the sensor, with one row per laser.
    """
    if not len(points):
        return ""
    count = int(ring[-1]) + 1
    if count > lasers.shape[0]:
        return f"{count} rings found for the {lasers.shape[0]} lasers of {lasers.name!r}"
    azimuth = _azimuths(points)
    width = float(np.ptp(np.percentile(azimuth, (1, 99))))
    near = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 5))
    if count > 1 and width < 3 * (MIN_DECREASE + 2 * MOTION / max(near, 0.1)):
        return f"points over {np.degrees(width):.0f} degrees of azimuth, too few to separate {count} rings"
    beams = lasers.laser_elevations.astype(np.float64)
    gap, extent = float(np.median(-np.diff(beams))), float(beams[0] - beams[-1])
    elevation = _elevations(points, _height(points, ring))
    bounds = np.flatnonzero(np.diff(ring)) + 1
    parts = np.split(elevation, bounds)
    middle = np.array([np.median(part) for part in parts])
    spread = np.array([np.median(np.abs(part - m)) for part, m in zip(parts, middle, strict=True)])
    # The limits are loose: motion compensation bends rings near the sensor as much as merged rings would spread.
    if np.median(spread) > gap or spread.max() > min(3 * gap, extent / 6):
        spreads = f"{np.degrees(np.median(spread)):.2f} degrees (median) and {np.degrees(spread.max()):.2f} (largest)"
        return f"{count} rings found, whose elevations spread by {spreads}; the lasers are {np.degrees(gap):.2f} apart"
    downward = -np.diff(middle)
    if _all_around(azimuth):
        sides = [(elevation[max(i - STRAYS, 0) : i], elevation[i : i + STRAYS]) for i in bounds]
        downward = np.array([np.median(before) - np.median(after) for before, after in sides])
    if count > 2 and np.median(downward) < gap / 4:
        return f"{count} rings found that do not descend from one to the next, each starting straight ahead"
    return ""


def _azimuths(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) radians counter-clockwise from straight ahead, in [0, 2 pi)."""
    return np.arctan2(points[:, 1], points[:, 0], dtype=np.float32) % np.float32(2 * np.pi)


def _all_around(azimuth: NDArray[np.float32]) -> bool:
    """Whether each of eight sectors of azimuth contains more than 1 % of the points."""
    return bool(np.histogram(azimuth, 8, (0, 2 * np.pi))[0].min() > 0.01 * len(azimuth))


def _elevations(points: NDArray[np.float32], height: float = 0.0) -> NDArray[np.float64]:
    """(N,) radians above the horizon of points (N, 3), seen from ``height`` metres above the origin."""
    elevation: NDArray[np.float64] = np.arctan2(points[:, 2] - np.float64(height), np.hypot(points[:, 0], points[:, 1]))
    return elevation


def _start_candidates(points: NDArray[np.float32]) -> list[NDArray[np.intp]]:
    """Candidates for the starts of rings, grouped: candidates at most ``STRAYS`` points apart are one start."""
    azimuth = _azimuths(points)
    near = 1 / np.maximum(np.hypot(points[:, 0], points[:, 1]), 0.1)
    threshold = MIN_DECREASE + MOTION * (near[1:] + near[:-1])
    if _all_around(azimuth):
        threshold = np.maximum(threshold, MIN_DECREASE_ALL_AROUND)
    candidates = [
        i
        for i in (np.flatnonzero(azimuth[:-1] - azimuth[1:] > threshold) + 1).tolist()
        if np.median(azimuth[max(i - STRAYS, 0) : i]) - np.median(azimuth[i : i + STRAYS]) > threshold[i - 1]
    ]
    if not candidates:
        return []
    return np.split(np.array(candidates, np.intp), np.flatnonzero(np.diff(candidates) > STRAYS) + 1)


def _best_candidate(group: NDArray[np.intp], elevation: NDArray[np.float64]) -> int:
    """The candidate of a group that minimises the spread of the elevations on its two sides."""
    if len(group) == 1:
        return int(group[0])
    low, high = max(int(group[0]) - STRAYS, 0), int(group[-1]) + STRAYS

    def spread(start: int) -> float:
        sides = elevation[low:start], elevation[start:high]
        return float(sum(np.abs(side - np.median(side)).sum() for side in sides))

    return int(min(group.tolist(), key=spread))


def _without_fragments(starts: NDArray[np.intp], elevation: NDArray[np.float64]) -> NDArray[np.intp]:
    """The starts of rings without those that only cut a fragment off a ring."""
    length = np.diff(np.concatenate([[0], starts, [len(elevation)]]))
    short = np.flatnonzero(length < FRAGMENT * np.median(length))
    if not len(short):
        return starts
    middle = np.array([np.median(part) for part in np.split(elevation, starts)])
    gap = float(np.median(np.abs(np.diff(middle))))
    removed = set()
    for i in short.tolist():
        neighbours = [j for j in (i - 1, i + 1) if 0 <= j < len(length)]
        nearest = min(neighbours, key=lambda j: abs(middle[j] - middle[i]))
        if abs(middle[nearest] - middle[i]) < gap / 2:
            removed.add(max(i, nearest))
    return np.array([start for i, start in enumerate(starts, 1) if i not in removed], np.intp)


def _height(points: NDArray[np.float32], ring: NDArray[np.int16]) -> float:
    """The height of the lasers above the points' origin, metres, from pairs of near and distant neighbouring points.

    A laser at height h with elevation e measures z = h + r sin(e), so h is the change of z / r per change of 1 / r.
    """
    distance = np.maximum(np.linalg.norm(points, axis=1), 0.1)
    inverse, sine = 1 / distance, points[:, 2] / distance
    steps = np.flatnonzero((np.abs(np.diff(inverse)) > 0.02) & (np.diff(ring) == 0))
    if not len(steps):
        return 0.0
    return float(np.clip(np.median(np.diff(sine)[steps] / np.diff(inverse)[steps]), -1, 1))
