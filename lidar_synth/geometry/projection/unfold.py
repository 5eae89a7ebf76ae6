"""Scan unfolding: one row per laser, from the order of the points instead of their elevation.

KITTI and KITTI-360 store a scan ring by ring from the top, each ring counter-clockwise from
straight ahead; rings.py finds where each ring starts. Projection by elevation would merge rings
where the lasers are closer together than the rows (the upper half of an HDL-64E), and leave rows
empty where they are further apart.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry.projection.kernels import (
    grid_of,
    medians,
    put_in_rows,
    sines_of,
)
from lidar_synth.geometry.projection.rings import fault_of, ring_bounds
from lidar_synth.geometry.projection.spherical import carry, cells_of, nearest_in
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor


def rows_by_elevation(
    elevations: NDArray[np.float64], beams: NDArray[np.floating[Any]]
) -> NDArray[np.int64]:
    """(R,) increasing rows of R rings that minimise the sum of distances between elevations and
    beams, radians; at most as many rings as beams."""
    distance = np.abs(elevations[:, None] - beams[None].astype(np.float64))
    total = np.full((len(elevations) + 1, len(beams) + 1), np.inf)
    total[0] = 0
    for ring, to_beam in enumerate(distance):
        total[ring + 1, 1:] = np.minimum.accumulate(total[ring, :-1] + to_beam)
    rows = np.empty(len(elevations), np.int64)
    end = len(beams)
    for ring in reversed(range(len(elevations))):
        # The first minimum is the row that was assigned.
        end = int(np.argmin(total[ring + 1, : end + 1])) - 1
        rows[ring] = end
    return rows


def unfold(scan: Scan, sensor: Sensor | None = None) -> RangeImage:
    """Unfold a scan to a range image with one row per laser; a cell shows its nearest return.

    Args:
        scan: N points in raw ring order, or a crop of such a scan; with ``scan.ring``, the points
            may be in any order.
        sensor: defines lasers and columns; by default the scan's own sensor.

    Returns:
        An image on ``sensor.by_beams()``, whose rays have the elevations of the lasers, with the
        scan's boxes.

    Raises:
        DataError: on a scan that is not in ring order: more rings than the sensor has lasers, rings
            that spread over more than one laser's elevation, or a crop that is too narrow to
            decide.

    Example:
        >>> from lidar_synth import open_scans, unfold
        >>> scan = open_scans("demo_out/town")[0]
        >>> image = unfold(scan)
        >>> image.range.shape, image.sensor.name
        ((64, 2048), 'hdl64e_lasers')
    """
    lasers = (sensor or scan.sensor).by_beams()
    # the rows follow from the rings
    grid = grid_of(lasers)._replace(edges=np.empty(0, np.float32))
    cell, distance = cells_of(scan.points, grid)
    put_in_rows(cell, laser_rows(scan, lasers), lasers.shape[1])
    image, index = nearest_in(cell, distance, lasers)
    return RangeImage(image, lasers, carry(scan, index), scan.boxes)


def laser_rows(scan: Scan, lasers: Sensor) -> NDArray[np.int64]:
    """(N,) row of the laser that measured each point, 0 = highest.

    Args:
        scan: N points in raw ring order, or in any order with ``scan.ring``.
        lasers: a sensor with one row per laser.

    Raises:
        DataError: as ``unfold``.
    """
    height = lasers.shape[0]
    if scan.ring is not None:
        if len(scan) and not 0 <= scan.ring.min() <= scan.ring.max() < height:
            rings = f"rings {scan.ring.min()} to {scan.ring.max()}"
            raise _not_in_rings(
                scan, f"{rings} for the {height} lasers of {lasers.name!r}"
            )
        return scan.ring.astype(np.int64)
    bounds = ring_bounds(scan.points)
    if fault := fault_of(scan.points, bounds, lasers):
        raise _not_in_rings(scan, fault)
    sine = np.empty(len(scan), np.float32)
    middle = np.empty(len(bounds) - 1)
    sines_of(scan.points, sine)
    medians(sine, bounds, middle)
    rows = rows_by_elevation(np.arcsin(middle), lasers.laser_elevations)
    return np.repeat(rows, np.diff(bounds))


def _not_in_rings(scan: Scan, reason: str) -> DataError:
    return DataError(
        f"scan {scan.id!r}: {reason}",
        "points ring by ring, as KITTI stores them",
        "Use project() for a scan in another order, or set scan.ring.",
    )
