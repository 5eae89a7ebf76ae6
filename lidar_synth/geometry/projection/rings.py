"""The rings of a scan from the order of its points, in whole scans and in crops, and whether they are rings at all.

A laser turns counter-clockwise, so within a ring the azimuth, counted from straight ahead, rises; where it falls the
next ring begins. It falls by the whole turn in a whole scan, and by less in one that was cropped to a sector. Two
things look like the beginning of a ring and are none: a stray point, and a step back where the motion of the car was
taken out, which moves near points farther about the sensor than distant ones.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor

FALL = np.radians(2.0)
"""Radians by which the azimuth falls at least where a ring begins."""

MOTION = 0.3
"""Metres by which motion compensation may move two neighbouring points apart; twice what SemanticKITTI's scans show."""

WHOLE_TURN = np.radians(90.0)
"""Radians by which the azimuth falls at least where a ring begins in a scan that looks in all directions."""

STRAYS = 5
"""Points on either side of a ring's beginning of which most have to show the fall; fewer points are no ring."""

FRAGMENT = 0.05
"""Share of the usual number of points in a ring below which a run of points may be a piece of its neighbour."""


def ring_numbers(points: NDArray[np.float32]) -> NDArray[np.int16]:
    """(N,) ring of each point, 0 = the first in the file, of a scan in raw ring order or a crop of one.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
    """
    begins = np.zeros(len(points), bool)
    groups = _falls(points)
    if groups:
        elevation = _elevations(points)
        begins[_without_fragments(np.array([_best_of(group, elevation) for group in groups]), elevation)] = True
    return np.cumsum(begins, dtype=np.int16)


def fault_of(points: NDArray[np.float32], ring: NDArray[np.int16], lasers: Sensor) -> str:
    """What is wrong with rings that ``ring_numbers`` found, in words; "" where they can be a sensor's.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
        ring: (N,) rising from 0.
        lasers: whose rings they may be.
    """
    if not len(points):
        return ""
    count = int(ring[-1]) + 1
    if count > lasers.shape[0]:
        return f"{count} rings found for the {lasers.shape[0]} lasers of {lasers.name!r}"
    azimuth = _azimuths(points)
    width = float(np.ptp(np.percentile(azimuth, (1, 99))))
    near = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 5))
    if count > 1 and width < 3 * (FALL + 2 * MOTION / max(near, 0.1)):
        return f"points over {np.degrees(width):.0f} degrees of azimuth, too few to tell {count} rings from one another"
    beams = lasers.laser_elevations.astype(np.float64)
    gap, extent = float(np.median(-np.diff(beams))), float(beams[0] - beams[-1])
    elevation = _elevations(points, _height(points, ring))
    bounds = np.flatnonzero(np.diff(ring)) + 1
    parts = np.split(elevation, bounds)
    middle = np.array([np.median(part) for part in parts])
    spread = np.array([np.median(np.abs(part - m)) for part, m in zip(parts, middle, strict=True)])
    # Motion compensation bends rings near the sensor by as much as two or three rings in one would show.
    if np.median(spread) > gap or spread.max() > min(3 * gap, extent / 6):
        found = f"{np.degrees(np.median(spread)):.2f} degrees of elevation, one of them {np.degrees(spread.max()):.2f}"
        return f"{count} rings found, whose points lie {found} apart; the lasers are {np.degrees(gap):.2f} apart"
    downward = -np.diff(middle)
    if _all_around(azimuth):
        sides = [(elevation[max(i - STRAYS, 0) : i], elevation[i : i + STRAYS]) for i in bounds]
        downward = np.array([np.median(before) - np.median(after) for before, after in sides])
    if count > 2 and np.median(downward) < gap / 4:
        return f"{count} rings found that do not go down from one to the next, each from straight ahead on"
    return ""


def _azimuths(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) radians counter-clockwise from straight ahead, in [0, 2 pi)."""
    return np.arctan2(points[:, 1], points[:, 0], dtype=np.float32) % np.float32(2 * np.pi)


def _all_around(azimuth: NDArray[np.float32]) -> bool:
    """Whether some of the points lie in each of eight directions."""
    return bool(np.histogram(azimuth, 8, (0, 2 * np.pi))[0].min() > 0.01 * len(azimuth))


def _elevations(points: NDArray[np.float32], height: float = 0.0) -> NDArray[np.float64]:
    """(N,) radians above the horizon of points (N, 3), seen from ``height`` metres above the origin."""
    seen: NDArray[np.float64] = np.arctan2(points[:, 2] - np.float64(height), np.hypot(points[:, 0], points[:, 1]))
    return seen


def _falls(points: NDArray[np.float32]) -> list[NDArray[np.intp]]:
    """Where the azimuth falls for good; falls that are nearer to each other than a ring is long stand together."""
    azimuth = _azimuths(points)
    near = 1 / np.maximum(np.hypot(points[:, 0], points[:, 1]), 0.1)
    enough = FALL + MOTION * (near[1:] + near[:-1])
    if _all_around(azimuth):
        enough = np.maximum(enough, WHOLE_TURN)
    lasting = [
        i
        for i in (np.flatnonzero(azimuth[:-1] - azimuth[1:] > enough) + 1).tolist()
        if np.median(azimuth[max(i - STRAYS, 0) : i]) - np.median(azimuth[i : i + STRAYS]) > enough[i - 1]
    ]
    return np.split(np.array(lasting, np.intp), np.flatnonzero(np.diff(lasting) > STRAYS) + 1) if lasting else []


def _best_of(group: NDArray[np.intp], elevation: NDArray[np.float64]) -> int:
    """The one of neighbouring beginnings that leaves the elevations on its two sides most even."""
    if len(group) == 1:
        return int(group[0])
    low, high = max(int(group[0]) - STRAYS, 0), int(group[-1]) + STRAYS

    def uneven(begin: int) -> float:
        sides = elevation[low:begin], elevation[begin:high]
        return float(sum(np.abs(side - np.median(side)).sum() for side in sides))

    return int(min(group.tolist(), key=uneven))


def _without_fragments(begins: NDArray[np.intp], elevation: NDArray[np.float64]) -> NDArray[np.intp]:
    """The beginnings without those that cut a few points off their own ring."""
    length = np.diff(np.concatenate([[0], begins, [len(elevation)]]))
    short = np.flatnonzero(length < FRAGMENT * np.median(length))
    if not len(short):
        return begins
    middle = np.array([np.median(part) for part in np.split(elevation, begins)])
    gap = float(np.median(np.abs(np.diff(middle))))
    gone = set()
    for i in short.tolist():
        beside = [j for j in (i - 1, i + 1) if 0 <= j < len(length)]
        nearest = min(beside, key=lambda j: abs(middle[j] - middle[i]))
        if abs(middle[nearest] - middle[i]) < gap / 2:
            gone.add(max(i, nearest))
    return np.array([begin for i, begin in enumerate(begins, 1) if i not in gone], np.intp)


def _height(points: NDArray[np.float32], ring: NDArray[np.int16]) -> float:
    """How high the lasers stand above the points' origin, metres, from steps between near and distant points.

    A laser at height h and of elevation e gives z = h + r sin(e), so that z / r steps by h where 1 / r steps by 1.
    """
    distance = np.maximum(np.linalg.norm(points, axis=1), 0.1)
    inverse, sine = 1 / distance, points[:, 2] / distance
    steps = np.flatnonzero((np.abs(np.diff(inverse)) > 0.02) & (np.diff(ring) == 0))
    if not len(steps):
        return 0.0
    return float(np.clip(np.median(np.diff(sine)[steps] / np.diff(inverse)[steps]), -1, 1))
