"""The rays of one scan, ring by ring: those of its returns, and those that came back without a
return."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, Scan
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.transfer.kernels import WIDEST
from lidar_synth.geometry.transfer.surfaces import as_fired, rings_of


class ScanRays(NamedTuple):
    """E rays, ordered by ring and clockwise within a ring; the last of a ring is followed by its
    first.

    Args:
        point: (E,) index of the return; -1 = none.
        ring: (E,) int64, 0 = highest.
        azimuth: (E,) radians, clockwise from straight ahead.
        slope: (E,) tangent of the elevation, seen from the laser.
        height: (E,) metres above the sensor's origin at which the laser starts.
        rho: (E,) horizontal distance of the return, metres; inf = none.
        start: (R + 1,) first ray of each ring that has returns, and E.
        step: radians between two firings.
    """

    point: NDArray[np.int64]
    ring: NDArray[np.int64]
    azimuth: Float64Array
    slope: Float64Array
    height: Float64Array
    rho: Float64Array
    start: NDArray[np.int64]
    step: float

    def points(self, which: NDArray[np.intp], rho: Float64Array) -> NDArray[np.float32]:
        """(n, 3) points on some rays at horizontal distances (n,), metres."""
        azimuth = self.azimuth[which]
        z = self.height[which] + self.slope[which] * rho
        return np.stack([rho * np.cos(azimuth), -rho * np.sin(azimuth), z], 1).astype(
            np.float32
        )

    def hitting(self, some: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(E,) whether the return of each ray is one of some of the N."""
        return np.asarray((self.point >= 0) & some[self.point])

    def through(self, box: NDArray[np.float32], margin: float) -> NDArray[np.bool_]:
        """(E,) whether each ray passes through a box (7,) with a margin in metres on all six
        sides."""
        [wide] = Boxes(box, ("Misc",)).enlarged(margin).values
        return np.asarray(self.leaving(wide) > 0)

    def leaving(self, box: NDArray[np.float32]) -> Float64Array:
        """(E,) horizontal distance at which each ray leaves a box (7,), metres; 0 = it does not
        pass through."""
        left = np.zeros(len(self.azimuth))
        near = self._towards(box)
        c = np.cos(float(box[6]))
        s = np.sin(float(box[6]))
        dx = np.cos(self.azimuth[near])
        dy = -np.sin(self.azimuth[near])
        origin = (
            -box[0] * c - box[1] * s,
            box[0] * s - box[1] * c,
            self.height[near] - box[2],
        )
        along = (dx * c + dy * s, dy * c - dx * s, self.slope[near])
        enter = np.zeros(len(dx))
        leave = np.full(len(dx), np.inf)
        for o, d, size in zip(origin, along, box[3:6], strict=True):
            d = np.where(np.abs(d) < 1e-9, 1e-9, d)
            a = (-size / 2 - o) / d
            b = (size / 2 - o) / d
            enter = np.maximum(enter, np.minimum(a, b))
            leave = np.minimum(leave, np.maximum(a, b))
        left[near] = np.where(enter <= leave, leave, 0.0)
        return left

    def _towards(self, box: NDArray[np.float32]) -> NDArray[np.intp]:
        """The rays that may pass through a box (7,), by their azimuth."""
        away = float(np.hypot(box[0], box[1]))
        radius = float(np.hypot(box[3], box[4])) / 2
        half = np.arcsin(radius / away) if radius < away else np.pi
        apart = np.abs(self.azimuth + np.arctan2(box[1], box[0]))
        return np.flatnonzero((apart <= half) | (apart >= 2 * np.pi - half))


def rays_of_scan(scan: Scan) -> ScanRays:
    """The rays of a scan of N returns; gaps between the returns of a ring are rays without a
    return. A range image has one ray per column.

    The rings are ``scan.ring``, or follow from the order of the points, or are the rows of the
    sensor's grid. In the last case rays start at the origin, unless those of the grid start above
    it (``Sensor.starts``).
    """
    ring, on_grid = rings_of(scan)
    sensor = as_fired(scan, ring)
    step = 2 * np.pi / (sensor.firings or sensor.columns)
    starts = (
        scan.sensor.starts.astype(np.float64)
        if len(scan.sensor.starts)
        else np.zeros(1)
    )
    optics = starts if on_grid else scan.sensor.optics()[1]
    x, y, z = scan.points.astype(np.float64).T
    azimuth = -np.arctan2(y, x)
    rho = np.maximum(np.hypot(x, y), 1e-3)
    height = optics[np.minimum(ring, len(optics) - 1)]
    order = np.argsort(8 * ring + azimuth, kind="stable")
    ring = ring[order]
    azimuth = azimuth[order]
    rho = rho[order]
    height = height[order]
    slope = (z[order] - height) / rho
    last = np.append(ring[1:] != ring[:-1], True)
    first = np.flatnonzero(np.append(True, last[:-1]))
    following = np.arange(1, len(ring) + 1)
    following[last] = first
    gap = azimuth[following] - azimuth + 2 * np.pi * last
    added = np.where(gap > WIDEST * step, np.rint(gap / step).astype(np.int64) - 1, 0)
    source = np.repeat(np.arange(len(ring)), added + 1)
    ends = np.cumsum(added + 1)
    nth = np.arange(len(source)) - (ends - added - 1)[source]
    share = nth / (added[source] + 1)
    return ScanRays(
        point=np.where(nth == 0, order[source], -1),
        ring=ring[source],
        azimuth=azimuth[source] + share * gap[source],
        slope=(1 - share) * slope[source] + share * slope[following[source]],
        height=height[source],
        rho=np.where(nth == 0, rho[source], np.inf),
        start=np.append((ends - added - 1)[first], len(source)),
        step=step,
    )
