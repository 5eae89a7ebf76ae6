"""From cells back to points: transfers the prediction of a range-view network from cells to all
points of a scan."""

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.projection.spherical import Cells

_NEIGHBOURS = 32  # largest k


@numba.njit(cache=True)
def _vote(cell, distance, point, image, labels, half, k, cutoff, out):  # type: ignore[no-untyped-def]
    rows, columns = image.shape
    gaps = np.empty(_NEIGHBOURS, np.float32)
    neighbours = np.empty(_NEIGHBOURS, np.int64)
    votes = np.empty(256, np.int64)
    for i in range(len(cell)):
        if cell[i] < 0:
            out[i] = IGNORE
            continue
        row = cell[i] // columns
        column = cell[i] % columns
        if point[row, column] == i:
            out[i] = labels[row, column]
            continue
        count = 0
        for r in range(max(row - half, 0), min(row + half + 1, rows)):
            for offset in range(-half, half + 1):
                c = (column + offset) % columns
                if image[r, c] == 0:
                    continue
                gap = abs(image[r, c] - distance[i])
                if count == k and gap >= gaps[k - 1]:
                    continue
                j = min(count, k - 1)
                while j > 0 and gaps[j - 1] > gap:
                    gaps[j], neighbours[j] = gaps[j - 1], neighbours[j - 1]
                    j -= 1
                gaps[j], neighbours[j] = gap, labels[r, c]
                count = min(count + 1, k)
        votes[:] = 0
        winner = neighbours[0]
        for j in range(count):
            if gaps[j] <= cutoff:
                votes[neighbours[j]] += 1
                if votes[neighbours[j]] > votes[winner]:
                    winner = neighbours[j]
        out[i] = winner


def fill_points(
    labels: NDArray[np.uint8],
    image: NDArray[np.float32],
    cells: Cells,
    k: int = 5,
    window: int = 5,
    cutoff: float = 1.0,
) -> NDArray[np.uint8]:
    """Transfer labels from cells to points, as a range-view network needs (after RangeNet++,
    Milioto et al. 2019).

    A point that its cell shows takes the cell's label. A hidden point takes the majority label of
    the k returns in the window around its cell whose range is nearest to its own. Returns whose
    range differs by more than ``cutoff`` do not vote; if none is left, the point takes the label of
    the nearest.

    Args:
        labels: (H, W) uint8 per cell.
        image: (H, W) float32 range in metres, 0 = no return.
        cells: the cells of the scan's N points, from ``locate``.
        k: number of returns that vote, at most 32.
        window: side of the window in cells, odd; columns wrap.
        cutoff: metres.

    Returns:
        (N,) uint8; 255 = ignore for a point outside the sensor's range limits.

    Raises:
        DataError: on shapes that do not match, or an invalid k or window.

    Example:
        >>> from lidar_synth import Town, project
        >>> from lidar_synth.geometry.projection import fill_points, locate
        >>> scan = Town(seed=0, scans=1)[0]
        >>> image, cells = project(scan), locate(scan.points, scan.sensor)
        >>> label = fill_points(image.label, image.range, cells)
        >>> label.shape == scan.label.shape, round(float((label == scan.label).mean()), 1)
        (True, 1.0)
    """
    if not labels.shape == image.shape == cells.point.shape:
        raise DataError(
            f"labels {labels.shape}, range {image.shape}, cells {cells.point.shape}",
            "one shape (H, W)",
        )
    if not (1 <= k <= _NEIGHBOURS and window >= 1 and window % 2):
        raise DataError(f"k = {k}, window = {window}", f"1 <= k <= {_NEIGHBOURS} and an odd window")
    out = np.empty(len(cells.cell), np.uint8)
    _vote(
        cells.cell, cells.range, cells.point, image, labels, window // 2, k, np.float32(cutoff), out
    )
    return out
