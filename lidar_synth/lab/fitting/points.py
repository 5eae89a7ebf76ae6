"""The points of scans, with their times and rings as far as the files or the order of the points
tell them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan, Sensor, require_finite
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.projection.rings import fault_of, ring_bounds
from lidar_synth.lab.fitting.model import Cloud

ONE_TURN = (0.7, 1.3)
"""Turns by which the azimuth changes from the first to the last point of a file in the order of
time."""


def gather(scans: Sequence[Scan]) -> Cloud:
    """The points of all scans, without rings; scans without ``time`` get the fraction of the turn
    instead.

    Raises:
        DataError: without points, or with points that are not finite.
    """
    if not scans:
        raise DataError("no scans", "at least one scan to fit a sensor to")
    for scan in scans:
        require_finite(scan)
    points = np.concatenate([scan.points for scan in scans]).astype(np.float64)
    number = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    timed = all(scan.time is not None for scan in scans)
    times = [
        np.asarray(scan.time, np.float64) if timed else turn_fraction(scan.points)
        for scan in scans
    ]
    return Cloud(points, number, np.concatenate(times), np.full(len(points), -1))


def turn_fraction(points: NDArray[np.float32]) -> Float64Array:
    """(N,) fraction of the turn at which each point was measured, about -0.5 to 0.5.

    The turn starts where the file does, if its points are in the order of time; otherwise behind
    the sensor.
    """
    if follows_time(points):
        unwrapped = _unwrapped(points)
        return np.asarray(unwrapped - unwrapped.mean())
    return np.arctan2(points[:, 1], points[:, 0]).astype(np.float64) / (2 * np.pi)


def follows_time(points: NDArray[np.float32]) -> bool:
    """Whether the azimuth follows the order of the points around one turn."""
    if not len(points):
        return False
    unwrapped = _unwrapped(points)
    return bool(ONE_TURN[0] < abs(unwrapped[-1]) and np.ptp(unwrapped) < ONE_TURN[1])


def _unwrapped(points: NDArray[np.float32]) -> Float64Array:
    """(N,) turns from the first point, following the order of the points."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64) / (2 * np.pi)
    step = np.diff(azimuth, prepend=azimuth[0])
    return np.asarray(np.cumsum(step - np.round(step)))


def _find_complete_rings(scans: Sequence[Scan]) -> list[NDArray[np.int16] | None]:
    """The rings that follow from the order of each scan's points, of scans with all of them."""
    found = [rings_in_order(scan.points) if len(scan) else None for scan in scans]
    counts = [0 if ring is None else int(ring.max()) + 1 for ring in found]
    # A scan with fewer rings is a crop; its rings have other numbers.
    return [
        ring if count == max(counts) else None
        for ring, count in zip(found, counts, strict=True)
    ]


def rings_of_file(scans: Sequence[Scan]) -> tuple[str, NDArray[np.int64] | None]:
    """(N,) rings that the scans have, or that follow from their order; None if there are none."""
    if all(scan.ring is not None for scan in scans):
        return "ring field", np.concatenate(
            [np.asarray(scan.ring, np.int64) for scan in scans]
        )
    complete = _find_complete_rings(scans)
    if sum(ring is not None for ring in complete) <= len(scans) / 2:
        return "elevations", None
    given = [
        np.full(len(scan), -1) if ring is None else ring
        for scan, ring in zip(scans, complete, strict=True)
    ]
    return "order of the points", np.concatenate(given).astype(np.int64)


def rings_in_order(points: NDArray[np.float32]) -> NDArray[np.int16] | None:
    """(N,) rings of a scan in KITTI's order of points; None if it is in another order."""
    bounds = ring_bounds(points)
    count = len(bounds) - 1
    if not 4 <= count <= 512:
        return None
    elevation = np.degrees(
        np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])).astype(
            np.float64
        )
    )
    parts = np.split(elevation, bounds[1:-1])
    middle = np.sort([np.median(part) for part in parts])[::-1]
    try:
        lasers = Sensor("rings", 2, 0.0, 1.0, elevations=tuple(middle))
    except ConfigError:  # two rings with the same elevation
        return None
    if fault_of(points, bounds, lasers):
        return None
    return np.repeat(np.arange(count, dtype=np.int16), np.diff(bounds))
