"""Scan unfolding: rows from the order in which the laser rings were recorded, not from elevation.

KITTI and KITTI-360 store a scan ring by ring from the top, each ring counter-clockwise from straight
ahead. A ring ends where the quadrant falls from the fourth back to the first. Elevation would merge rings
where the lasers are closer than the rows (HDL-64E's upper half) and leave rows empty where they are not.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.projection.angles import grid_of
from lidar_synth.projection.spherical import carry, locate
from lidar_synth.scan import RangeImage, Scan
from lidar_synth.sensor import Sensor

Anchor = Literal["elevation", "last"]
"""How rings find their rows: each on the beam of its elevation, or, as the public code of R2Flow does,
counted from the last ring up (which displaces a scan whose lower rings are cut off)."""


def ring_numbers(points: NDArray[np.float32]) -> NDArray[np.int16]:
    """(N,) ring of each point, 0 = the first in the file, of a scan in raw ring order.

    Args:
        points: (N, 3) float32 metres, in the order of the file.
    """
    first = (points[:, 0] >= 0) & (points[:, 1] >= 0)
    fourth = (points[:, 0] >= 0) & (points[:, 1] < 0)
    starts = np.zeros(len(points), np.int16)
    starts[1:] = fourth[:-1] & first[1:]
    return np.cumsum(starts, dtype=np.int16)


def _rows_by_elevation(elevations: NDArray[np.float64], beams: NDArray[np.float32]) -> NDArray[np.int64]:
    """The rows, one per ring and rising, whose beams are nearest to the rings' elevations in sum."""
    distance = np.abs(elevations[:, None] - beams[None].astype(np.float64))
    total = np.full((len(elevations) + 1, len(beams) + 1), np.inf)
    total[0] = 0
    for ring, row_distance in enumerate(distance):
        total[ring + 1, 1:] = np.minimum.accumulate(total[ring, :-1] + row_distance)
    rows = np.empty(len(elevations), np.int64)
    end = len(beams)
    for ring in reversed(range(len(elevations))):
        end = int(np.argmin(total[ring + 1, : end + 1])) - 1  # the first of equals: the row that was taken
        rows[ring] = end
    return rows


def unfold(scan: Scan, sensor: Sensor | None = None, anchor: Anchor = "elevation") -> RangeImage:
    """The scan as a range image with one row per laser: ring by ring, nearest return in a cell.

    Args:
        scan: N points in raw ring order, or in any order with ``scan.ring`` known.
        sensor: whose lasers and columns; the scan's own by default.
        anchor: how a ring finds its row.

    Returns:
        An image on ``sensor.by_beams()``, whose rays point where the lasers do.

    Raises:
        DataError: on more rings than the sensor has lasers: the scan is not in ring order.
    """
    lasers = (sensor or scan.sensor).by_beams()
    rings = scan.ring if scan.ring is not None else ring_numbers(scan.points)
    present, ring = np.unique(rings, return_inverse=True)
    if len(present) > lasers.shape[0]:
        raise DataError(
            f"scan {scan.id!r}: {len(present)} rings found for the {lasers.shape[0]} lasers of {lasers.name!r}",
            "points ring by ring, as KITTI stores them",
            "Use project() for a scan in another order, or set scan.ring.",
        )
    cells = locate(scan.points, lasers)
    if scan.ring is not None:
        rows = present.astype(np.int64)
    elif anchor == "last":
        rows = np.arange(len(present)) + lasers.shape[0] - len(present)
    else:
        elevation = np.arcsin(scan.points[:, 2] / np.maximum(cells.range, grid_of(lasers).range_min + 1e-6))
        rows = _rows_by_elevation(
            np.array([np.median(elevation[ring == i]) for i in range(len(present))]), lasers.laser_elevations
        )
    cell = np.where(cells.cell < 0, -1, rows[ring] * lasers.columns + cells.cell % lasers.columns)
    return _nearest_of(scan, cell, cells.range, lasers)


def _nearest_of(scan: Scan, cell: NDArray[np.int64], distance: NDArray[np.float32], sensor: Sensor) -> RangeImage:
    """The image whose cells show the nearest of their points, the first in the file among equals."""
    seen = np.flatnonzero(cell >= 0)
    far_first = seen[np.lexsort((-seen, -distance[seen]))]
    index = np.full(sensor.shape[0] * sensor.columns, -1, np.int32)
    index[cell[far_first]] = far_first
    image = np.where(index >= 0, distance[index], np.float32(0)) if len(seen) else np.zeros(len(index), np.float32)
    shape = sensor.shape
    return RangeImage(image.reshape(shape), sensor, carry(scan, index.reshape(shape)))
