"""Labels of points from their nearest neighbours in a labelled cloud.

Points of the same class that share a cube of ``VOXEL`` are reduced to one.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidar_synth.geometry.arrays import Float32Array

VOXEL = 0.05
"""Side of the cubes in which points of one class are reduced to one point, metres."""

_VOTERS = 3
_NEAR = 0.02  # distance, metres, below which a neighbour weighs no more
_CLASSES = 1 << 8


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
    share: Float32Array
    trust: Float32Array
    distance: Float32Array


@dataclass(frozen=True)
class NearestLabels:
    """A labelled cloud in which neighbours are found fast; ``index_cloud`` makes it.

    Args:
        low: (3,) lower corner of the indexed volume, metres.
        points: (M, 3) float32 relative to ``low``, sorted by x, y, z and class of their cubes.
        values: (M,) uint32 label values; the lower 8 bits are the class.
        confidence: (M,) float32 in [0, 1].
        tree: of the points.
    """

    low: NDArray[np.float64]
    points: Float32Array
    values: NDArray[np.uint32]
    confidence: Float32Array
    tree: cKDTree

    def __len__(self) -> int:
        return len(self.values)

    def vote(self, points: NDArray[np.float64], radius: float) -> Vote:
        """The value on which the three nearest points agree.

        A neighbour's weight is its confidence divided by its distance.

        Args:
            points: (N, 3) finite metres, in the frame of the cloud.
            radius: maximum distance of a neighbour, metres.
        """
        found, distance = self.nearest(points, radius, _VOTERS)
        # A neighbour that does not exist (-1) takes the last element, and has no weight.
        values = np.append(self.values, np.uint32(0))[found]
        near = 1 / (distance + _NEAR)
        weights = near * np.append(self.confidence, np.float32(0))[found]
        agree = values[:, :, None] == values[:, None, :]
        best = np.einsum("nab,nb->na", agree, weights).argmax(axis=1)[:, None]
        own = np.take_along_axis(agree, best[:, :, None], axis=1)[:, 0]
        weight = (own * weights).sum(axis=1)
        # Each is 0 where there is no neighbour: then 0 / 1.
        total = weights.sum(axis=1)
        plain = (own * near).sum(axis=1)
        return Vote(
            np.take_along_axis(values, best, axis=1)[:, 0],
            (weight / np.where(total > 0, total, 1)).astype(np.float32),
            (weight / np.where(plain > 0, plain, 1)).astype(np.float32),
            np.where(own, distance, np.inf).min(axis=1).astype(np.float32),
        )

    def nearest(
        self, points: NDArray[np.float64], radius: float, count: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """(N, count) positions in the index of the nearest points, -1 = none, and (N, count)
        distances, infinite = none.

        Args:
            points, radius: as for ``vote``.
        """
        distance, found = self.tree.query(
            points - self.low, np.arange(1, count + 1), distance_upper_bound=radius
        )
        return np.where(np.isfinite(distance), found, -1), distance


Chunk = tuple[NDArray[np.floating], NDArray[np.uint32], Float32Array]
"""Points (N, 3), label values (N,) and confidence (N,)."""


def index_cloud(
    chunks: Iterable[Chunk], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NearestLabels:
    """Index the part of a cloud that lies in a volume.

    Args:
        chunks: the cloud in parts, so that it need not fit into memory.
        low, high: (3,) corners of the volume, metres. Points outside are left out.
    """
    kept = [
        _thin(
            np.zeros((0, 3), np.float32),
            np.zeros(0, np.uint32),
            np.zeros(0, np.float32),
        )
    ]
    for points, values, confidence in chunks:
        local = (points - low).astype(np.float32)
        inside = ((local >= 0) & (local < (high - low).astype(np.float32))).all(axis=1)
        kept.append(_thin(local[inside], values[inside], confidence[inside]))
    points, values, confidence = _thin(*map(np.concatenate, zip(*kept, strict=True)))
    return NearestLabels(low, points, values, confidence, cKDTree(points))


def _thin(
    points: Float32Array,
    values: NDArray[np.uint32],
    confidence: Float32Array,
) -> tuple[Float32Array, NDArray[np.uint32], Float32Array]:
    """Points sorted by their cubes and classes, the first of each."""
    places = np.column_stack([points / VOXEL, values % _CLASSES]).astype(np.int64)
    keys = np.ravel_multi_index(places.T, places.max(axis=0, initial=0) + 1)
    first = np.unique(keys, return_index=True)[1]
    return points[first], values[first], confidence[first]
