"""Returns need support: on a real surface, neighbouring rays return from almost the
same distance.

A decoder draws for each cell of a patch independently which surface it shows. At an edge,
single cells therefore end up between or behind surfaces, which a bird's-eye view shows as
fans along the rays. Sensors hardly give such returns: in the town, 0.3 % of those between
8 and 35 m have fewer than three neighbours within 0.15 m + 2 % of their range.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

NEIGHBOURS = 3
"""Number of neighbours that a return needs; at most the window's columns to either side,
because a coarse grid has few returns of one object."""
TOLERANCE = 0.1, 0.0175
"""Largest difference between the ranges of neighbours: metres, and metres per metre of
range. With the distance across the rays of the window it is within 0.15 m + 2 %."""
ROWS = 2
"""Rows of the window above and below a cell."""
TURN = 512
"""The window has 1 / TURN of a full turn's columns to either side of a cell."""
PASSES = 3
"""Number of passes, because a removed return may have supported another one."""


def find_unsupported(distance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The returns of range images that have too few neighbours.

    Args:
        distance: (B, H, W) metres, 0 = no return; columns are a full turn.

    Returns:
        (B, H, W).
    """
    columns = max(distance.shape[2] // TURN, 1)
    kept = distance.copy()
    for image in kept:
        for _ in range(PASSES):
            around = np.pad(image, ((ROWS, ROWS), (0, 0)))
            around = np.pad(around, ((0, 0), (columns, columns)), "wrap")
            image[_find_unsupported(around, columns)] = 0
    unsupported: NDArray[np.bool_] = (distance > 0) & (kept == 0)
    return unsupported


@njit(cache=True, nogil=True)
def _find_unsupported(around, columns):  # type: ignore[no-untyped-def]
    """(H, W) bool, the returns with too few neighbours in an image that is padded by
    the window's rows and columns."""
    height = around.shape[0] - 2 * ROWS
    width = around.shape[1] - 2 * columns
    wanted = min(NEIGHBOURS, columns)
    unsupported = np.zeros((height, width), np.bool_)
    for i in range(height):
        for j in range(width):
            own = around[i + ROWS, j + columns]
            if own > 0:
                limit = np.float32(TOLERANCE[0]) + np.float32(TOLERANCE[1]) * own
                count = -1  # the loop counts the cell itself, too
                for n in range(2 * ROWS + 1):  # the cell's row first, then outwards
                    row = around[i + ROWS + (n + 1) // 2 * (2 * (n % 2) - 1)]
                    for other in row[j : j + 2 * columns + 1]:
                        count += abs(other - own) < limit
                    if count >= wanted:
                        break
                unsupported[i, j] = count < wanted
    return unsupported
