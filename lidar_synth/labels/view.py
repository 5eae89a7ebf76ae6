"""Occlusion: the visible returns in each cell of a range image, as objects are added."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.projection import locate
from lidar_synth.labels.ground import FLOOR
from lidar_synth.labels.objects import Object


@dataclass
class VisibleReturns:
    """The returns of the scan or of one object.

    Args:
        cell: (N,) row * W + column; -1 outside the sensor's range limits.
        range: (N,) metres.
        seen: (N,) True for returns that are still visible.
        total: number of returns that would be visible without occlusion.
    """

    cell: NDArray[np.int32]
    range: Float32Array
    seen: NDArray[np.bool_]
    total: int

    @property
    def share(self) -> float:
        """The share of returns that are still visible."""
        return float(self.seen.sum() / max(self.total, 1))


class Composition:
    """The range image of a scan to which objects are added, preferably from near to far.

    Args:
        scan: N points.

    Attributes:
        parts: the visible returns of the scan, and of each object that was added.
    """

    def __init__(self, scan: Scan) -> None:
        self.sensor = scan.sensor
        cell, distance, point = locate(scan.points, scan.sensor)
        self.parts = [
            VisibleReturns(cell, distance, np.ones(len(scan), bool), len(scan))
        ]
        seen = point >= 0
        self._front = np.full(point.shape, np.inf, np.float32)
        self._height = np.zeros(point.shape, np.float32)
        height = scan.points[:, 2]
        label = scan.label
        if label is not None:
            # Returns labelled as other classes than ground occlude at any height.
            low = GROUND[label] | (label == IGNORE)
            height = np.where(low, height, np.float32(np.inf))
        self._front[seen] = distance[point[seen]]
        self._height[seen] = height[point[seen]]
        _close_gaps(self._front, self._height)

    def add(self, placed: Object, least: int) -> bool:
        """Add an object to the view, or return False if fewer than ``least`` of its returns are
        visible."""
        cell, distance, shown = locate(placed.scan.points, self.sensor)
        nearest = shown[shown >= 0]
        row, column = np.divmod(cell[nearest], self.sensor.columns)
        # A return at the height of the object's floor belongs to the ground in front of it, and
        # does not occlude it.
        stands = self._height[row, column] > placed.ground + FLOOR
        seen = ~(stands & (self._front[row, column] < distance[nearest]))
        if seen.sum() < least:
            return False
        outline = _outline(row, column, distance[nearest], self.sensor.columns)
        limit = np.full(self.sensor.shape, np.inf, np.float32)
        limit[outline[0], outline[1]] = outline[2]
        # No other return shares a cell with it, not even ground just in front.
        limit[row[seen], column[seen]] = 0
        for part in self.parts:
            part.seen &= (part.range <= limit.reshape(-1)[part.cell]) | (part.cell < 0)
        self._stand(*outline, top=placed.box[2] + placed.box[5] / 2)
        visible = np.zeros(len(cell), bool)
        visible[nearest[seen]] = True
        self.parts.append(VisibleReturns(cell, distance, visible, len(nearest)))
        return True

    def _stand(
        self,
        row: NDArray[np.intp],
        column: NDArray[np.intp],
        depth: Float32Array,
        top: np.float32,
    ) -> None:
        """Put cells (m,) at a depth in front of what is behind them, up to the height ``top``."""
        nearer = depth < self._front[row, column]
        self._front[row[nearer], column[nearer]] = depth[nearer]
        self._height[row[nearer], column[nearer]] = top


def refuse_coarser(given: Sensor, wanted: Sensor) -> None:
    """Refuse returns of a sensor that is coarser than another: they can be thinned to its grid, but
    not densified.

    Raises:
        DataError: if the given sensor has fewer rows per degree, or fewer columns, than the wanted
            one.
    """
    rows = [s.shape[0] / (s.up - s.down) for s in (given, wanted)]
    if rows[0] < 0.9 * rows[1] or given.columns < 0.9 * wanted.columns:
        raise DataError(
            f"returns of sensor {given.name!r} for a scan of {wanted.name!r}",
            "those of a sensor with at least as many beams and columns",
            f"Open them with sensor={wanted.name!r} if they are of the same device, otherwise with "
            "as_sensor.",
        )


def _close_gaps(front: Float32Array, height: Float32Array) -> None:
    """Fill each empty cell (inf) between two returns, vertically or horizontally, with the farther
    one."""
    for axis in (0, 1):
        before = np.roll(front, 1, axis)
        after = np.roll(front, -1, axis)
        if axis == 0:
            before[0] = np.inf
            after[-1] = np.inf
        farther = np.maximum(before, after)
        gap = np.isinf(front) & np.isfinite(farther)
        heights = np.where(
            before >= after, np.roll(height, 1, axis), np.roll(height, -1, axis)
        )
        front[gap] = farther[gap]
        height[gap] = heights[gap]


def _outline(
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    depth: Float32Array,
    columns: int,
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float32Array]:
    """The cells of an object's outline: between its upper and lower returns, in all columns from
    its first to its last.

    Args:
        row, column, depth: (n,) cells and ranges of its returns.
        columns: number of columns of the range image.

    Returns:
        (m,) rows, columns, and ranges: that of the object's nearest return in the column,
        interpolated in columns without returns.
    """
    middle = column[0]
    offset = (column - middle + columns // 2) % columns - columns // 2
    order = np.lexsort((row, offset))
    known, first = np.unique(offset[order], return_index=True)
    top = row[order][first]
    bottom = np.maximum.reduceat(row[order], first)
    near = np.minimum.reduceat(depth[order], first)
    across = np.arange(known[0], known[-1] + 1)
    upper = np.rint(np.interp(across, known, top)).astype(np.intp)
    heights = np.rint(np.interp(across, known, bottom)).astype(np.intp) - upper + 1
    within = np.arange(heights.sum()) - np.repeat(np.cumsum(heights) - heights, heights)
    nearest = np.repeat(np.interp(across, known, near).astype(np.float32), heights)
    return (
        np.repeat(upper, heights) + within,
        np.repeat((across + middle) % columns, heights),
        nearest,
    )
