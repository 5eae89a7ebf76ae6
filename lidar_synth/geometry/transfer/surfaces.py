"""Surfaces of one scan: its returns by ring and azimuth, and the triangles between neighbours of
one surface."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.geometry.projection import locate
from lidar_synth.geometry.projection.kernels import medians, sines_of
from lidar_synth.geometry.projection.rings import fault_of, ring_bounds, turns
from lidar_synth.geometry.scan import Scan, require_finite
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer.kernels import (
    find_level,
    neighbours_below,
    triangulate,
)

ORDERED = np.radians(2.0)
"""Radians; a file may be in ring order if more than half of the steps of azimuth between successive
points are smaller."""

SAMPLES = 4096
"""Number of returns that decide whether a scan lies on rows or on beams."""

TOGETHER = 0.1
"""A scan is a range image if neighbours along a ring in one column are fewer than this share of
those in adjacent columns. It is at most 0.02 in range images, where a ring passes through two rows,
and 0.26 or more in scans of the HDL-64E, even without 98 % of their returns."""

SCATTERED = 0.1
"""Neighbours along a ring differ in elevation by less than this share of the gap between rings, in
the median: by 0.01 in scans of KITTI and nuScenes, by 0.35 or more if they are opened as scans of a
sensor with fewer beams."""


@dataclass(frozen=True)
class ScanSurfaces:
    """The surfaces of a scan, in the frame of the sensor that recorded it.

    Args:
        scan: the scan with its N returns ordered by ring and azimuth.
        azimuth: (N,) radians, clockwise.
        triangles: (T, 3) int32 indices of returns.
        rim: (N,) bool, returns that some side has no triangle.
        level: (N,) bool, returns of nearly level surfaces.
        step: radians between firings.
        up, down: (N,) tangent of half the angle to the neighbouring rings.
        bounds: lowest and highest elevation, radians, that the rings cover.
    """

    scan: Scan
    azimuth: NDArray[np.float64]
    triangles: NDArray[np.int32]
    rim: NDArray[np.bool_]
    level: NDArray[np.bool_]
    step: float
    up: NDArray[np.float64]
    down: NDArray[np.float64]
    bounds: tuple[float, float]


def estimate(scan: Scan) -> ScanSurfaces:
    """Estimate the surfaces of a scan.

    Args:
        scan: N returns with ``ring``, or in the order of a file of KITTI, or on the beams of
            ``scan.sensor``.

    Raises:
        DataError: on a scan without a return, with one ring only, with values that are not finite,
            or whose points lie on no rings.
    """
    _check(scan)
    ring, on_grid = rings_of(scan)
    azimuth = -np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(np.float64)
    # Fast where rings are in order, as in most files.
    order = np.argsort(ring * 8.0 + azimuth, kind="stable")
    sensor = as_fired(scan, ring)
    scan = scan[order]
    ring = ring[order]
    azimuth = azimuth[order]
    starts = np.flatnonzero(np.append(True, ring[1:] != ring[:-1]))
    present = ring[starts]
    if len(present) < 2:
        raise DataError(
            f"scan {scan.id!r} with returns of one beam only",
            "at least two beams, to find surfaces",
        )
    starts = np.append(starts, len(scan)).astype(np.int64)
    elevation = _elevations(scan)
    middle = np.empty(len(present))
    medians(elevation, starts, middle)
    _check_rings(scan, elevation, starts, middle)
    step = _step(azimuth, starts, sensor)
    below = np.empty(len(scan), np.int64)
    level = np.empty(len(scan), bool)
    neighbours_below(starts, azimuth, step, on_grid, below)
    find_level(scan.points, below, level)
    ground = (
        np.ones(len(scan), bool)
        if scan.label is None
        else GROUND[scan.label] | (scan.label == IGNORE)
    )
    triangles, rim = triangulate(
        present,
        starts,
        azimuth,
        scan.points,
        _objects(scan),
        ground,
        level,
        below,
        step,
        on_grid,
    )
    half = np.maximum(-np.diff(middle), 0) / np.diff(present) / 2
    up = np.concatenate([half[:1], half])
    down = np.concatenate([half, half[-1:]])
    counts = np.diff(starts)
    bounds = float(middle.min() - down[-1]), float(middle.max() + up[0])
    up = np.repeat(np.tan(up), counts)
    down = np.repeat(np.tan(down), counts)
    return ScanSurfaces(scan, azimuth, triangles, rim, level, step, up, down, bounds)


def rings_of(scan: Scan) -> tuple[Int64Array, bool]:
    """(N,) ring of each return, 0 = highest, and whether rings are rows of a grid, which may lack
    returns of a row.

    They come from ``scan.ring``, or from the order of the points, or from the elevations.
    """
    if scan.ring is not None:
        return scan.ring.astype(np.int64), False
    lasers = scan.sensor.by_beams()
    turn = np.diff(turns(scan.points)[0])
    if 2 * np.count_nonzero((turn >= 0) & (turn < ORDERED)) > len(turn):
        bounds = ring_bounds(scan.points)
        if len(bounds) > 2 and not fault_of(scan.points, bounds, lasers):
            return np.repeat(np.arange(len(bounds) - 1), np.diff(bounds)), False
    if len(scan.sensor.starts):
        return _rows_of(scan), True
    elevation = _elevations(scan)
    sample = elevation[:: 1 + len(elevation) // SAMPLES]
    to_grid, to_lasers = (
        np.median(np.abs(sample - sensor.row_elevations()[_row(sample, sensor)]))
        for sensor in (scan.sensor, lasers)
    )
    on_grid = bool(to_grid <= to_lasers)
    return _row(elevation, scan.sensor if on_grid else lasers), on_grid


def as_fired(scan: Scan, ring: NDArray[np.integer] | None = None) -> Sensor:
    """The sensor of a scan with as many firings as its N returns show: one per column if they are
    those of a range image, which has one return per cell.

    Args:
        scan: its returns, in any order.
        ring: (N,) ring of each; by default as ``rings_of``.
    """
    sensor = scan.sensor
    rows, columns = sensor.shape
    if (
        sensor.firings is None
        or sensor.firings <= columns
        or len(scan) > rows * columns
    ):
        return sensor
    if ring is None:
        ring = rings_of(scan)[0]
    azimuth = -np.arctan2(scan.points[:, 1], scan.points[:, 0])
    column = np.floor((azimuth / np.pi + 1) / 2 * columns)
    order = np.argsort(ring * 8.0 + azimuth, kind="stable")
    steps = np.diff(column[order])[np.diff(ring[order]) == 0]
    together = np.count_nonzero(steps == 0)
    beside = np.count_nonzero(steps == 1)
    return replace(sensor, firings=columns) if together < TOGETHER * beside else sensor


def _elevations(scan: Scan) -> NDArray[np.float32]:
    """(N,) elevation of each return, radians."""
    sine = np.empty(len(scan), np.float32)
    sines_of(scan.points, sine)
    return np.arcsin(np.clip(sine, -1, 1))


def _row(elevation: NDArray[np.float32], sensor: Sensor) -> Int64Array:
    """(N,) row of a sensor's grid at each elevation (N,), radians."""
    return np.searchsorted(-sensor.edges[1:-1], -elevation)


def _rows_of(scan: Scan) -> Int64Array:
    """(N,) row of each return; of those outside the sensor's range limits too."""
    endless = replace(scan.sensor, range_min=0.0, range_max=1e6)
    cell = locate(scan.points.astype(np.float32), endless).cell
    return np.asarray(np.maximum(cell, 0) // scan.sensor.columns, np.int64)


def _check(scan: Scan) -> None:
    if not len(scan):
        raise DataError(
            f"scan {scan.id!r} without a return",
            "a scan with returns, to find surfaces",
        )
    require_finite(scan)


def _check_rings(
    scan: Scan,
    elevation: NDArray[np.float32],
    starts: Int64Array,
    middle: NDArray[np.float64],
) -> None:
    """Refuse points that do not lie on rings, such as those of a map."""
    gap = np.median(np.abs(np.diff(middle)))
    jump = np.abs(np.diff(elevation))
    jump[starts[1:-1] - 1] = 0
    if 2 * np.count_nonzero(jump > SCATTERED * gap) > len(jump):
        raise DataError(
            f"scan {scan.id!r}: its points lie on no rings of {scan.sensor.name!r} (neighbours "
            f"differ by {np.degrees(np.median(jump)):.2f} degrees of elevation, rings by "
            f"{np.degrees(gap):.2f})",
            "the points of one revolution",
            "Set scan.ring, or open the scan with its own sensor.",
        )


def _step(azimuth: NDArray[np.float64], starts: Int64Array, sensor: Sensor) -> float:
    """Radians between two firings: the sensor's own, or the lower quartile between neighbours along
    a ring."""
    if sensor.firings is not None:
        return 2 * np.pi / sensor.firings
    turn = np.diff(azimuth)
    turn[starts[1:-1] - 1] = 0
    turn = turn[turn > 1e-5]
    nominal = 2 * np.pi / sensor.columns
    return float(min(np.percentile(turn, 25) if len(turn) else nominal, 1.5 * nominal))


def _objects(scan: Scan) -> Int64Array:
    """(N,) a number for each pair of label and instance."""
    key: Any = np.zeros(len(scan), np.int64)
    if scan.label is not None:
        key = key + scan.label
    if scan.instance is not None:
        key = key + 256 * scan.instance.astype(np.int64)
    return np.asarray(key, np.int64)
