"""Spherical projection of points to a range image and back, on one CPU core.

Each cell shows the nearest point in its direction within the sensor's range limits, and the first
in the file among points at equal range. ``unproject`` puts a return at the centre of its cell, so
that unprojecting and projecting an image again gives the same image.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.projection.kernels import (
    Grid,
    along_rays,
    gather,
    grid_of,
    locate_points,
    nearest_in_cells,
    nearest_points,
    pick_returns,
    returns_in,
)
from lidar_synth.geometry.scan import (
    LABELLED_ONLY,
    POINT_FIELDS,
    RangeImage,
    Scan,
)
from lidar_synth.geometry.sensor import Rays, Sensor


class Cells(NamedTuple):
    """The cell of each point, and the point that each cell shows.

    Args:
        cell: (N,) int32, row * W + column; -1 for a point outside the range limits.
        range: (N,) float32 metres.
        point: (H, W) int32, the index of the point that a cell shows; -1 = none.
    """

    cell: NDArray[np.int32]
    range: Float32Array
    point: NDArray[np.int32]


def locate(points: Float32Array, sensor: Sensor) -> Cells:
    """Find the cell of each point on a sensor's grid, and the point that each cell shows.

    Args:
        points: (N, 3) or (N, 4) float32, x, y, z first, metres, sensor frame.
        sensor: the sensor that defines the grid.

    Raises:
        DataError: on points of another shape or dtype.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import load_sensor
        >>> from lidar_synth.geometry.projection import locate
        >>> points = np.array([(10, 0.1, -1), (5, 0.05, -0.5), (0.5, 0, 0)], np.float32)
        >>> cells = locate(points, load_sensor("hdl64e_kitti"))
        >>> cells.cell  # the second point hides the first; the third is nearer than range_min
        array([19966, 19966,    -1], dtype=int32)
        >>> int(cells.point.flat[19966])
        1
    """
    cell, distance = cells_of(points, grid_of(sensor))
    return Cells(cell, distance, nearest_in(cell, distance, sensor)[1])


def cells_of(
    points: Float32Array, grid: Grid
) -> tuple[NDArray[np.int32], Float32Array]:
    """Cell (N,) and range (N,) of each point; see ``locate``."""
    points = _checked(points)
    cell = np.empty(len(points), np.int32)
    distance = np.empty(len(points), np.float32)
    locate_points(points, grid, cell, distance)
    return cell, distance


def nearest_in(
    cell: NDArray[np.int32], distance: Float32Array, sensor: Sensor
) -> tuple[Float32Array, NDArray[np.int32]]:
    """Range (H, W) and index (H, W) of the nearest point in each cell; of points at equal range,
    the first.

    Args:
        cell: (N,) row * W + column, -1 = none.
        distance: (N,) metres.
        sensor: the sensor that defines the grid.
    """
    image = np.empty(sensor.shape, np.float32)
    index = np.empty(sensor.shape, np.int32)
    nearest_in_cells(cell, distance, image.reshape(-1), index.reshape(-1))
    return image, index


def project(
    scan: Scan, sensor: Sensor | None = None, channels: Iterable[str] | None = None
) -> RangeImage:
    """Project a scan to a range image: spherical projection, nearest return (paper, "Representing
    LiDAR data").

    Returns outside the sensor's range limits are dropped before the projection. Points above or
    below the field of view go to the first or the last row, since some lasers point slightly
    outside it.

    Args:
        scan: N points.
        sensor: the sensor that defines the grid; the scan's own by default.
        channels: names of the fields that become channels; by default all that the scan has, except
            the ``ring`` of other lasers than those of ``sensor``.

    Returns:
        (H, W) range in metres, 0 = no return, with the fields of the nearest points as channels and
        the scan's boxes.

    Raises:
        ConfigError: on a channel that the scan does not have.
        DataError: on points that are not float32.

    Example:
        >>> from lidar_synth import Town, load_sensor, project
        >>> scan = Town(seed=0, scans=1)[0]
        >>> image = project(scan)
        >>> image.range.shape, image.label.shape
        ((64, 1024), (64, 1024))
        >>> project(scan, load_sensor("os1_128"), channels=["label"]).range.shape
        (128, 1024)
    """
    if sensor and channels is None and not sensor.same_lasers(scan.sensor):
        scan = replace(scan, ring=None)
    sensor = sensor or scan.sensor
    image = np.empty(sensor.shape, np.float32)
    index = np.empty(sensor.shape, np.int32)
    nearest_points(
        _checked(scan.points), grid_of(sensor), image.reshape(-1), index.reshape(-1)
    )
    return RangeImage(image, sensor, carry(scan, index, channels), scan.boxes)


def carry(
    scan: Scan, index: NDArray[np.int32], channels: Iterable[str] | None = None
) -> dict[str, NDArray[Any]]:
    """Transfer the fields of a scan from its points to the cells that show them.

    Args:
        scan: N points.
        index: (H, W) point of each cell, -1 = none.
        channels: names of the fields; by default all that the scan has.

    Returns:
        {name: (H, W)} with 0 (``label``: 255 = ignore) in cells without a return.

    Raises:
        ConfigError: on a field that the scan does not have.
    """
    fields = scan.fields()
    names = list(fields) if channels is None else list(channels)
    if missing := [n for n in names if n not in fields]:
        raise ConfigError(
            f"scan {scan.id!r} has no {missing}",
            f"some of {sorted(fields)}",
            LABELLED_ONLY if "label" in missing else "",
        )
    carried = {}
    for name in names:
        carried[name] = np.empty(index.shape, fields[name].dtype)
        empty = fields[name].dtype.type(IGNORE if name == "label" else 0)
        gather(fields[name], index.reshape(-1), empty, carried[name].reshape(-1))
    return carried


def unproject(image: RangeImage, rays: Rays = "centre") -> Scan:
    """Convert the returns of a range image to points, row by row.

    Args:
        image: (H, W) range in metres, 0 = no return.
        rays: through the cells' centres, or through their corners as in the public code of R2Flow
            and LiDM.

    Returns:
        A scan with one point per return; channels named in ``POINT_FIELDS`` become its fields.

    Raises:
        DataError: on a range that is negative or not finite.

    Example:
        >>> from lidar_synth import Town, project, unproject
        >>> image = project(Town(seed=0, scans=1)[0])
        >>> scan = unproject(image)  # one point per cell, at the cell's centre
        >>> bool(len(scan) == image.mask.sum()), bool((project(scan).mask == image.mask).all())
        (True, True)
    """
    directions = image.sensor.ray_directions(rays).reshape(-1, 3)
    flat = np.ascontiguousarray(image.range, np.float32).reshape(len(directions))
    count = returns_in(flat)
    if count < 0:
        raise DataError(
            f"range image of sensor {image.sensor.name!r} with negative or non-finite range",
            "metres",
        )
    points = np.empty((count + 1, 3), np.float32)
    along_rays(flat, directions, points)
    if len(starts := image.sensor.starts):
        points[:count, 2] += starts[np.flatnonzero(flat > 0) // image.sensor.columns]
    fields: dict[str, Any] = {}
    for name in [n for n in image.channels if n in POINT_FIELDS]:
        values = np.ascontiguousarray(image.channels[name]).reshape(len(directions))
        picked = np.empty(count + 1, values.dtype)
        pick_returns(flat, values, picked)
        fields[name] = picked[:count]
    fields.setdefault("reflectance", np.zeros(count, np.float32))
    return Scan(points[:count], sensor=image.sensor, boxes=image.boxes, **fields)


def _checked(points: NDArray[Any]) -> Float32Array:
    if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] < 3:
        raise DataError(
            f"points of shape {points.shape}, {points.dtype}",
            "(N, 3) or (N, 4) float32: x, y, z, metres",
        )
    return points
