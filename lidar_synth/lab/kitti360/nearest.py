"""Labels of points from their nearest neighbours in a labelled cloud.

The cloud is divided into vertical columns, in which the points are sorted by height. The neighbours
of a point lie in the columns around it, between two heights. Points of the same class that share a
cube of ``VOXEL`` are reduced to one.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

VOXEL = 0.05
"""Side of the cubes in which points of one class are reduced to one point, metres."""

_SIDE = 4  # cubes along the side of a column
_COLUMN = VOXEL * _SIDE
_CLASSES = 1 << 8
_FLOORS = 1 << 14  # maximum number of cubes in a column
_SIDE_OF_CUBE = np.float32(VOXEL)
_SIDE_OF_COLUMN = np.float32(_COLUMN)
_LINEAR = 4  # number of points that are not searched by halves
_FAR = np.float32(1e6)  # metres, beyond every radius
_NEAR = np.float32(0.02)  # distance, metres, below which a neighbour weighs no more


class Vote(NamedTuple):
    """The result for N points.

    Args:
        value: (N,) uint32 value with most weight among the neighbours; 0 where there is no
            neighbour.
        share: (N,) float32 in [0, 1], its share in the weight of all neighbours.
        trust: (N,) float32 in [0, 1], the mean confidence of the neighbours with this value.
        distance: (N,) float32 metres, distance of its nearest neighbour; infinite where there is
            none.
    """

    value: NDArray[np.uint32]
    share: NDArray[np.float32]
    trust: NDArray[np.float32]
    distance: NDArray[np.float32]


@dataclass(frozen=True)
class NearestLabels:
    """A labelled cloud in which neighbours are found fast; ``index_cloud`` makes it.

    Args:
        low: (3,) lower corner of the indexed volume, metres.
        columns: numbers of columns in x and y.
        starts: (columns + 1,) position of the first point of each column.
        points: (M, 3) float32 relative to ``low``, sorted by column, then by cube from below.
        values: (M,) uint32 label values; the lower 8 bits are the class.
        confidence: (M,) float32 in [0, 1].
    """

    low: NDArray[np.float64]
    columns: tuple[int, int]
    starts: NDArray[np.int64]
    points: NDArray[np.float32]
    values: NDArray[np.uint32]
    confidence: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.values)

    def vote(self, points: NDArray[np.float64], radius: float) -> Vote:
        """The value on which the three nearest points agree.

        A neighbour's weight is its confidence divided by its distance.

        Args:
            points: (N, 3) metres, in the frame of the cloud.
            radius: maximum distance of a neighbour, metres.
        """
        found, squared = self.nearest(points, radius)
        count = len(points)
        share, trust = np.zeros((2, count), np.float32)
        vote = Vote(
            np.zeros(count, np.uint32), share, trust, np.full(count, np.inf, np.float32)
        )
        _count_votes(found, squared, self.values, self.confidence, *vote)
        return vote

    def nearest(
        self, points: NDArray[np.float64], radius: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """(N, 3) positions in the index of the three nearest points, -1 = none, and (N, 3) squared
        distances.

        Args:
            points, radius: as for ``vote``.
        """
        reach = int(np.ceil(radius / _COLUMN))
        steps = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
        bounds = (
            ((np.maximum(np.abs(steps) - 1, 0) * _COLUMN) ** 2)
            .sum(axis=1)
            .astype(np.float32)
        )
        order = np.lexsort([np.abs(steps).sum(axis=1), bounds])  # nearest columns first
        local = (points - self.low).astype(np.float32)
        found = np.empty((len(local), 3), np.int64)
        squared = np.empty((len(local), 3), np.float32)
        cloud = (self.points, self.starts, self.columns)
        _three_nearest(
            local,
            *cloud,
            steps[order],
            bounds[order],
            np.float32(radius),
            found,
            squared,
        )
        return found, squared


Chunk = tuple[NDArray[np.floating], NDArray[np.uint32], NDArray[np.float32]]
"""Points (N, 3), label values (N,) and confidence (N,)."""


def index_cloud(
    chunks: Iterable[Chunk], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NearestLabels:
    """Index the part of a cloud that lies in a volume.

    Args:
        chunks: the cloud in parts, so that it need not fit into memory.
        low, high: (3,) corners of the volume, metres; it is at most 800 m high. Points outside are
            left out.
    """
    wide, deep = np.maximum(np.ceil((high - low)[:2] / _COLUMN), 1).astype(int).tolist()
    empty = (
        np.zeros(0, np.int64),
        np.zeros((0, 3), np.float32),
        np.zeros(0, np.uint32),
        np.zeros(0, np.float32),
    )
    kept = [empty]
    for points, values, confidence in chunks:
        local = (points - low).astype(np.float32)
        inside = ((local >= 0) & (local < (high - low).astype(np.float32))).all(axis=1)
        local = local[inside]
        values = values[inside]
        confidence = confidence[inside]
        keys = np.empty(len(local), np.int64)
        _keys(local, values, deep, keys)
        keys, first = np.unique(keys, return_index=True)
        kept.append((keys, local[first], values[first], confidence[first]))
    keys, points, values, confidence = (
        np.concatenate(parts) for parts in zip(*kept, strict=True)
    )
    keys, first = np.unique(keys, return_index=True)
    column = keys // (_FLOORS * _SIDE * _SIDE * _CLASSES)
    starts = np.concatenate(
        [[0], np.cumsum(np.bincount(column, minlength=wide * deep))]
    )
    return NearestLabels(
        low, (wide, deep), starts, points[first], values[first], confidence[first]
    )


@numba.njit(cache=True, nogil=True)
def _keys(points, values, across, keys):  # type: ignore[no-untyped-def]
    """The key by which points are sorted: column, height, cube in the column, class."""
    for i in range(len(points)):
        x = int(points[i, 0] / VOXEL)
        y = int(points[i, 1] / VOXEL)
        z = int(points[i, 2] / VOXEL)
        column = (x // _SIDE) * across + y // _SIDE
        cube = (z * _SIDE + x % _SIDE) * _SIDE + y % _SIDE
        keys[i] = (column * (_FLOORS * _SIDE * _SIDE) + cube) * _CLASSES + (
            values[i] & (_CLASSES - 1)
        )


@numba.njit(cache=True, nogil=True, fastmath=True)
def _three_nearest(  # type: ignore[no-untyped-def]
    queries, points, starts, columns, steps, bounds, radius, found, squared
):
    """Fill ``found`` and ``squared`` (N, 3) with the nearest points and their squared distances; -1
    = none.

    The three are kept in scalars, because arrays of three are twice as slow.
    """
    for i in range(len(queries)):
        qx = queries[i, 0]
        qy = queries[i, 1]
        qz = queries[i, 2]
        cx = int(np.floor(qx / _SIDE_OF_COLUMN))
        cy = int(np.floor(qy / _SIDE_OF_COLUMN))
        rx = qx - np.float32(cx) * _SIDE_OF_COLUMN
        ry = qy - np.float32(cy) * _SIDE_OF_COLUMN
        d0 = d1 = d2 = radius * radius
        i0 = i1 = i2 = -1
        for s in range(len(steps)):
            if bounds[s] >= d2:
                break
            dx = _gap(rx, steps[s, 0])
            dy = _gap(ry, steps[s, 1])
            x = cx + steps[s, 0]
            y = cy + steps[s, 1]
            if (
                dx * dx + dy * dy >= d2
                or x < 0
                or y < 0
                or x >= columns[0]
                or y >= columns[1]
            ):
                continue
            begin = starts[x * columns[1] + y]
            end = starts[x * columns[1] + y + 1]
            left = begin
            right = end
            while right - left > _LINEAR:
                middle = (left + right) // 2
                if points[middle, 2] < qz:
                    left = middle + 1
                else:
                    right = middle
            # Outwards from the point's own height, up and then down, until no nearer neighbour can
            # come. Heights are sorted up to the side of a cube.
            p = left
            way = 1
            while True:
                ez = points[p, 2] - qz if begin <= p < end else _FAR * np.float32(way)
                beyond = ez * np.float32(way) - _SIDE_OF_CUBE
                if beyond > 0 and beyond * beyond > d2:
                    if way < 0:
                        break
                    p = left - 1
                    way = -1
                    continue
                ex = points[p, 0] - qx
                ey = points[p, 1] - qy
                d = ex * ex + ey * ey + ez * ez
                if d < d0:
                    d2 = d1
                    i2 = i1
                    d1 = d0
                    i1 = i0
                    d0 = d
                    i0 = p
                elif d < d1:
                    d2 = d1
                    i2 = i1
                    d1 = d
                    i1 = p
                elif d < d2:
                    d2 = d
                    i2 = p
                p += way
        found[i, 0] = i0
        found[i, 1] = i1
        found[i, 2] = i2
        squared[i, 0] = d0
        squared[i, 1] = d1
        squared[i, 2] = d2


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _gap(inside, step):  # type: ignore[no-untyped-def]
    """Distance along one axis from a place ``inside`` a column to the column that is ``step``
    columns away."""
    if step > 0:
        return np.float32(step) * _SIDE_OF_COLUMN - inside
    if step < 0:
        return inside - np.float32(step + 1) * _SIDE_OF_COLUMN
    return np.float32(0)


@numba.njit(cache=True, nogil=True)
def _count_votes(  # type: ignore[no-untyped-def]
    found, squared, values, confidence, value, share, trust, distance
):
    for i in range(len(found)):
        total = best = np.float32(0)
        for a in range(found.shape[1]):
            if found[i, a] < 0:
                break
            own = values[found[i, a]]
            weight = np.float32(0)
            plain = np.float32(0)
            total += confidence[found[i, a]] / (np.sqrt(squared[i, a]) + _NEAR)
            for b in range(found.shape[1]):
                if found[i, b] >= 0 and values[found[i, b]] == own:
                    near = 1 / (np.sqrt(squared[i, b]) + _NEAR)
                    plain += near
                    weight += confidence[found[i, b]] * near
            if a == 0 or weight > best:
                best = weight
                value[i] = own
                trust[i] = weight / plain
                distance[i] = np.sqrt(squared[i, a])
        if total > 0:
            share[i] = best / total
