"""LiDM's protocol: bird's-eye occupancy, its Jensen-Shannon distance, and the minimum matching distance.

https://github.com/hancyran/LiDAR-Diffusion, lidm/eval. Both sets are 64 x 1024 range images whose returns from
1 m to 56 m (both exclusive) lie on rays through the cells' corners; x and y within +-50 m count. 2,000
generated scans against all of the validation sequence.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.evaluate.distances import jensen_shannon_distance
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor

HALF = 50
"""Half the side of the bird's-eye square around the sensor, metres."""

FINE, COARSE = 0.05, 0.5
"""Size of cells in metres, for the Jensen-Shannon distance and for the minimum matching distance."""

SENSOR = Sensor("lidm", 1024, float(np.nextafter(np.float32(1), np.float32(2))),
                 float(np.nextafter(np.float32(56), np.float32(0))), rows=64, fov_up=3.0, fov_down=-25.0)  # fmt: skip
"""The grid of LiDM's range images."""

_SIDE = round(2 * HALF / COARSE)
_BLOCK = 128  # clouds compared with one another at a time: 20 MB of 200 x 200 maps


class Occupancy(NamedTuple):
    """The cells of one cloud that hold a point, as row * cells per side + column, sorted: row along x."""

    fine: NDArray[np.int32]
    coarse: NDArray[np.int32]


def cloud(scan: Scan, generated: bool) -> NDArray[np.float32]:
    """(N, 3) the points of a scan that the protocol compares, metres; the same for real and generated scans."""
    return unproject(project(scan, SENSOR, ()), "corner").points


def occupied(points: NDArray[np.float32], size: float) -> NDArray[np.int32]:
    """The cells of ``size`` metres that hold a point, sorted; see ``Occupancy``.

    Args:
        points: (N, 3) float32 metres.
        size: of a cell.

    Raises:
        DataError: if there is none.
    """
    xy = points[:, :2]
    inside = xy[((xy > -HALF) & (xy < HALF)).all(1)]
    if len(inside) == 0:
        raise DataError(f"a cloud of {len(points)} points with none within +-{HALF} m", "a scan with returns")
    side = round(2 * HALF / size)
    cell = np.floor(inside / np.float32(size)).astype(np.int32) + side // 2
    # Rounded up by float32 division, a coordinate just inside could be one cell outside.
    cell = cell.clip(0, side - 1)
    return np.unique(cell[:, 0] * side + cell[:, 1])


def occupancy(points: NDArray[np.float32]) -> Occupancy:
    """The occupied cells of a cloud (N, 3), which the protocol compares."""
    return Occupancy(occupied(points, FINE), occupied(points, COARSE))


def jsd(real: Sequence[Occupancy], generated: Sequence[Occupancy]) -> float:
    """Jensen-Shannon distance of how often each 5 cm cell is occupied."""
    side = round(2 * HALF / FINE)
    sums = [np.bincount(np.concatenate([o.fine for o in clouds]), minlength=side**2) for clouds in (real, generated)]
    return jensen_shannon_distance(sums[0], sums[1])


def minimum_matching_distance(real: Sequence[Occupancy], generated: Sequence[Occupancy]) -> float:
    """Mean over real clouds of the smallest Chamfer distance to a generated one (Achlioptas et al., ICML 2018).

    The Chamfer distance of two clouds is the mean of both mean squared distances between nearest occupied
    cells of 0.5 m, in units of the side of the square. All clouds share one grid, so that the squared distance
    from every cell to a cloud is one map, and all pairs are one matrix product. The paper's tables show it
    times 10^4.
    """
    maps = np.concatenate([_distance_maps(block) for block in _blocks(real)])
    best = np.full(len(real), np.inf, np.float32)
    for block in _blocks(generated):
        to_generated, of_generated = _distance_maps(block), _weights(block)
        for first in range(0, len(real), _BLOCK):
            part = slice(first, first + _BLOCK)
            chamfer = (_weights(real[part]) @ to_generated.T + maps[part] @ of_generated.T) / 2
            best[part] = np.minimum(best[part], chamfer.min(1))
    return float(best.mean(dtype=np.float64)) / _SIDE**2


def compare(real: Sequence[Occupancy], generated: Sequence[Occupancy]) -> dict[str, float]:
    """The figures of the protocol from the occupancies of both sets."""
    return {
        "BEV Jensen-Shannon distance": jsd(real, generated),
        "BEV minimum matching distance": minimum_matching_distance(real, generated),
    }


def _blocks(clouds: Sequence[Occupancy]) -> list[Sequence[Occupancy]]:
    return [clouds[i : i + _BLOCK] for i in range(0, len(clouds), _BLOCK)]


def _weights(clouds: Sequence[Occupancy]) -> NDArray[np.float32]:
    """(n, 200 * 200) the share of each cell in the mean over a cloud."""
    weights = np.zeros((len(clouds), _SIDE**2), np.float32)
    for row, one in zip(weights, clouds, strict=True):
        row[one.coarse] = 1 / len(one.coarse)
    return weights


def _distance_maps(clouds: Sequence[Occupancy]) -> NDArray[np.float32]:
    """(n, 200 * 200) squared distance, in cells, from every cell to the nearest that a cloud occupies."""
    return np.stack([_distance_map(one.coarse) for one in clouds]).reshape(len(clouds), -1)


def _distance_map(cells: NDArray[np.int32]) -> NDArray[np.float32]:
    """(200, 200) exact squared distances: along one axis, then over both."""
    mask = np.zeros((_SIDE, _SIDE), bool)
    mask.T.flat[cells] = True
    rows = np.arange(_SIDE, dtype=np.float32)[:, None]
    above = np.maximum.accumulate(np.where(mask, rows, -np.inf), 0)
    below = np.minimum.accumulate(np.where(mask, rows, np.inf)[::-1], 0)[::-1]
    one_axis = np.ascontiguousarray(np.minimum(rows - above, below - rows).T, np.float32) ** 2
    nearest = one_axis.copy()
    for shift in range(1, _SIDE):
        if shift**2 >= nearest.max():
            break
        shifted = one_axis + np.float32(shift**2)
        np.minimum(nearest[shift:], shifted[:-shift], out=nearest[shift:])
        np.minimum(nearest[:-shift], shifted[shift:], out=nearest[:-shift])
    return nearest
