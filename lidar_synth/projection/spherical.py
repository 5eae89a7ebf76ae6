"""Points to range image and back, on one CPU core.

Every point goes to the cell of its direction; the nearest one within the sensor's range limits wins, the
first in the file among equals. A return goes back to the centre of its cell, so that an image survives
the way to points and back in every cell.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.projection.angles import asin, atan2, column_of, grid_of, row_in_table, row_of
from lidar_synth.scan import POINT_FIELDS, RangeImage, Scan
from lidar_synth.sensor import Rays, Sensor

_BLOCK = 1024  # points located at a time: the buffers stay in the first-level cache
_INF = np.float32(np.inf)


class Cells(NamedTuple):
    """Which cell each point falls in, and which point each cell shows.

    Args:
        cell: (N,) int32, row * W + column; -1 for a point outside the range limits.
        range: (N,) float32 metres.
        point: (H, W) int32, the point that a cell shows; -1 = none.
    """

    cell: NDArray[np.int32]
    range: NDArray[np.float32]
    point: NDArray[np.int32]


@numba.njit(error_model="numpy", cache=True)
def _locate_block(x, y, z, grid, cell, distance):  # type: ignore[no-untyped-def]
    """Cells and ranges of one block of points; outside the range limits: cell 0, range inf."""
    up, down, rows, columns = grid.up, grid.down, np.int32(grid.rows), np.int32(grid.columns)
    low, high = grid.range_min, grid.range_max
    for i in range(len(x)):
        r = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        seen = (r >= low) & (r <= high) & (r > 0)
        elevation = asin(z[i] / (r if r > 0 else np.float32(1)))
        place = row_of(elevation, up, down, rows) * columns + column_of(-atan2(y[i], x[i]), columns)
        cell[i] = place if seen else np.int32(0)
        distance[i] = r if seen else _INF
    if len(grid.edges) > 0:
        for i in range(len(x)):
            if distance[i] < _INF:
                cell[i] = cell[i] % columns + row_in_table(asin(z[i] / distance[i]), grid.edges) * columns


@numba.njit(error_model="numpy", cache=True, inline="always")
def _scatter(cell, distance, start, image, index):  # type: ignore[no-untyped-def]
    """Lets points start, start + 1, ... into their cells where they are nearer than what is there."""
    for i in range(len(cell)):
        c, r = cell[i], distance[i]
        if r < image[c]:
            image[c] = r
            index[c] = start + i


@numba.njit(error_model="numpy", cache=True, inline="always")
def _close(image, index):  # type: ignore[no-untyped-def]
    """Marks the cells that no point reached."""
    for c in range(len(image)):
        if image[c] == _INF:
            image[c] = 0
            index[c] = -1


@numba.njit(error_model="numpy", cache=True)
def _nearest(points, grid, image, index):  # type: ignore[no-untyped-def]
    """Fills image (H*W,) with the smallest range per cell (0 = none) and index with its point (-1)."""
    x, y, z = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    cell, distance = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.float32)
    image[:] = _INF
    for start in range(0, len(points), _BLOCK):
        n = min(_BLOCK, len(points) - start)
        for i in range(n):
            x[i], y[i], z[i] = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        _locate_block(x[:n], y[:n], z[:n], grid, cell, distance)
        _scatter(cell[:n], distance[:n], start, image, index)
    _close(image, index)


@numba.njit(error_model="numpy", cache=True)
def _nearest_in(cell, distance, image, index):  # type: ignore[no-untyped-def]
    """``_nearest`` for points whose cells (-1 = none) are known."""
    image[:] = _INF
    for i in range(len(cell)):
        if cell[i] >= 0:
            _scatter(cell[i : i + 1], distance[i : i + 1], i, image, index)
    _close(image, index)


@numba.njit(error_model="numpy", cache=True)
def _locate(points, grid, cell, distance):  # type: ignore[no-untyped-def]
    """Cell (-1 outside the range limits) and range of every point."""
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    _locate_block(x, y, z, grid, cell, distance)
    for i in range(len(points)):
        if distance[i] == _INF:
            cell[i] = -1
            distance[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])


@numba.njit(error_model="numpy", cache=True)
def _gather(values, index, empty, out):  # type: ignore[no-untyped-def]
    for c in range(len(index)):
        out[c] = values[index[c]] if index[c] >= 0 else empty


@numba.njit(error_model="numpy", cache=True)
def _rays(image, directions, points, index):  # type: ignore[no-untyped-def]
    """Points (N, 3) of the returns in image (H*W,) along directions (H*W, 3), and their cells (N,)."""
    n = 0
    for c in range(len(image)):
        if image[c] > 0:
            for k in range(3):
                points[n, k] = image[c] * directions[c, k]
            index[n] = c
            n += 1


def locate(points: NDArray[np.float32], sensor: Sensor) -> Cells:
    """Where points fall on a sensor's grid: the index map from points to cells and back.

    Args:
        points: (N, 3) or (N, 4) float32, x, y, z first, metres, sensor frame.
        sensor: whose grid.
    """
    points = _checked(points)
    cell, distance = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
    _locate(points, grid_of(sensor), cell, distance)
    return Cells(cell, distance, nearest_in(cell, distance, sensor)[1])


def nearest_in(
    cell: NDArray[np.int32], distance: NDArray[np.float32], sensor: Sensor
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """(H, W) range and (H, W) point of the nearest of the points in each cell, the first among equals.

    Args:
        cell: (N,) row * W + column, -1 = none.
        distance: (N,) metres.
        sensor: whose grid.
    """
    image, index = np.empty(sensor.shape, np.float32), np.empty(sensor.shape, np.int32)
    _nearest_in(cell, distance, image.reshape(-1), index.reshape(-1))
    return image, index


def project(scan: Scan, sensor: Sensor | None = None, channels: Iterable[str] | None = None) -> RangeImage:
    """The scan as a range image: spherical projection, nearest return (paper, "Representing LiDAR data").

    Returns outside the sensor's range limits are dropped before the projection; directions outside its
    field of view go to the first or the last row, as lasers that stick out above and below do.

    Args:
        scan: N points.
        sensor: whose grid; the scan's own by default.
        channels: names of the fields to carry; by default all that the scan has.

    Returns:
        (H, W) range in metres, 0 = no return, with the channels of the nearest points.

    Raises:
        ConfigError: on a channel that the scan does not have.
        DataError: on points that are not float32.
    """
    sensor = sensor or scan.sensor
    image, index = np.empty(sensor.shape, np.float32), np.empty(sensor.shape, np.int32)
    _nearest(_checked(scan.points), grid_of(sensor), image.reshape(-1), index.reshape(-1))
    return RangeImage(image, sensor, carry(scan, index, channels))


def carry(scan: Scan, index: NDArray[np.int32], channels: Iterable[str] | None = None) -> dict[str, NDArray[Any]]:
    """The fields of a scan on the cells that show its points.

    Args:
        scan: N points.
        index: (H, W) point of each cell, -1 = none.
        channels: names of the fields; by default all that the scan has.

    Returns:
        {name: (H, W)} with 0 (``label``: 255 = ignore) where there is no return.
    """
    fields = scan.fields()
    names = list(fields) if channels is None else list(channels)
    if missing := [n for n in names if n not in fields]:
        raise ConfigError(f"scan {scan.id!r} has no {missing}", f"some of {sorted(fields)}")
    carried = {}
    for name in names:
        carried[name] = np.empty(index.shape, fields[name].dtype)
        empty = fields[name].dtype.type(IGNORE if name == "label" else 0)
        _gather(fields[name], index.reshape(-1), empty, carried[name].reshape(-1))
    return carried


def unproject(image: RangeImage, rays: Rays = "centre") -> Scan:
    """The returns of a range image as points, row by row.

    Args:
        image: (H, W) range in metres, 0 = no return.
        rays: through the cells' centres, or through their corners as the peers do.

    Returns:
        A scan with one point per return; the image's channels that a scan knows become its fields.

    Raises:
        DataError: on a range that is negative or not finite.
    """
    if not (np.isfinite(image.range).all() and (image.range >= 0).all()):
        raise DataError(f"range image of sensor {image.sensor.name!r} with negative or non-finite range", "metres")
    flat = np.ascontiguousarray(image.range, np.float32).reshape(-1)
    count = int(np.count_nonzero(flat))
    points, index = np.empty((count, 3), np.float32), np.empty(count, np.int32)
    _rays(flat, image.sensor.ray_directions(rays).reshape(-1, 3), points, index)
    fields: dict[str, Any] = {name: v.reshape(-1)[index] for name, v in image.channels.items() if name in POINT_FIELDS}
    fields.setdefault("reflectance", np.zeros(count, np.float32))
    return Scan(points, sensor=image.sensor, **fields)


def _checked(points: NDArray[Any]) -> NDArray[np.float32]:
    if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] < 3:
        raise DataError(f"points of shape {points.shape}, {points.dtype}", "(N, 3) or (N, 4) float32: x, y, z, metres")
    return points
