"""Bird's-eye occupancy and the minimum matching distance as LiDM reports them:
https://github.com/hancyran/LiDAR-Diffusion, ``lidm/eval``. R3DPA computes the same on finer cells
(https://github.com/valeoai/R3DPA, ``evaluate.py``). The counts and limits are in
``protocols/lidm.yaml`` and ``protocols/r3dpa.yaml``.
"""

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float32Array

HALF = 50
"""Half the side of the bird's-eye square around the sensor, metres."""

SENSOR = Sensor(
    "lidm",
    1024,
    float(np.nextafter(np.float32(1), np.float32(2))),
    float(np.nextafter(np.float32(56), np.float32(0))),
    rows=64,
    fov_up=3.0,
    fov_down=-25.0,
)
"""The grid of LiDM's range images."""


def find_occupied(points: Float32Array, size: float) -> NDArray[np.int32]:
    """The cells of ``size`` metres that hold a point, as row * cells per side + column, sorted: row
    along x.

    Args:
        points: (N, 3) float32 metres.
        size: of a cell.

    Raises:
        DataError: if there is none.
    """
    xy = points[:, :2]
    inside = xy[((xy > -HALF) & (xy < HALF)).all(1)]
    if len(inside) == 0:
        raise DataError(
            f"a cloud of {len(points)} points with none within +-{HALF} m",
            "a scan with returns",
        )
    side = round(2 * HALF / size)
    cell = np.floor(inside / np.float32(size)).astype(np.int32) + side // 2
    # Rounded up by float32 division, a coordinate just inside could be one cell outside.
    cell = cell.clip(0, side - 1)
    return np.unique(cell[:, 0] * side + cell[:, 1])


def cells_along(size: float) -> int:
    """Number of cells of ``size`` metres along a side of the square."""
    return round(2 * HALF / size)


def matching_distances(
    real: Sequence[NDArray[np.int32]],
    generated: Sequence[NDArray[np.int32]],
    size: float,
) -> Float32Array:
    """(N, M) Chamfer distance of every real cloud and every generated one.

    The Chamfer distance of two clouds is the mean of both mean squared distances between nearest
    occupied cells, in units of the side of the square. All clouds share one grid, so that the
    squared distance from every cell to a cloud is one map.

    Args:
        real, generated: occupied cells of each cloud.
        size: of a cell, metres.
    """
    side = cells_along(size)
    total = np.zeros((len(real), len(generated)), np.float32)
    for maps, others, out in ((real, generated, total), (generated, real, total.T)):
        cells = np.concatenate(others)
        starts = np.concatenate([[0], np.cumsum([len(o) for o in others])])
        for cloud, row in zip(maps, out, strict=True):
            _add_means(_distance_map(cloud, side).ravel(), cells, starts, row)
    return np.asarray(total / np.float32(2 * side**2), np.float32)


@numba.njit(cache=True, nogil=True)
def _add_means(
    values: Float32Array,
    cells: NDArray[np.int32],
    starts: NDArray[np.int64],
    out: Float32Array,
) -> None:
    """Add to ``out`` the mean value over the cells of each cloud."""
    for k in range(len(starts) - 1):
        total = 0.0
        for i in range(starts[k], starts[k + 1]):
            total += values[cells[i]]
        out[k] += total / (starts[k + 1] - starts[k])


@numba.njit(cache=True, nogil=True)
def _distance_map(cells: NDArray[np.int32], side: int) -> Float32Array:
    """(side, side) exact squared distances: along one axis, then the lower envelope of parabolas
    along the other (Felzenszwalb and Huttenlocher, Theory of Computing 2012)."""
    gaps = np.full((side, side), 4 * side, np.int32)
    for cell in cells:
        gaps[cell // side, cell % side] = 0
    for i in range(1, side):
        for j in range(side):
            gaps[i, j] = min(gaps[i, j], gaps[i - 1, j] + 1)
    for i in range(side - 2, -1, -1):
        for j in range(side):
            gaps[i, j] = min(gaps[i, j], gaps[i + 1, j] + 1)
    result = np.empty((side, side), np.float32)
    vertex = np.empty(side, np.int64)
    edge = np.empty(side + 1, np.float64)
    for i in range(side):
        last = -1
        for j in range(side):
            height = np.int64(gaps[i, j]) ** 2 + j**2
            crossing = -np.inf
            while last >= 0:
                v = vertex[last]
                crossing = (height - np.int64(gaps[i, v]) ** 2 - v**2) / (2 * (j - v))
                if crossing > edge[last]:
                    break
                last -= 1
            last += 1
            vertex[last] = j
            edge[last] = crossing
        k = 0
        for j in range(side):
            while k < last and edge[k + 1] < j:
                k += 1
            result[i, j] = (j - vertex[k]) ** 2 + np.int64(gaps[i, vertex[k]]) ** 2
    return result
