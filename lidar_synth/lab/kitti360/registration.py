"""How far a scan lies from the accumulated clouds: a registration that starts at its given pose.

The clouds are divided into cubes. The points of a cube have a mean m and a covariance; along its
axes a in which their standard deviation s is small (across a wall or the road, across a pole), the
cube says where a point p near it should lie: (p - m) a / s is small. Along the others it says
nothing. This is the normal distributions transform (Magnusson 2009) without those axes. The sum of
robust squares of these residuals is minimised by Gauss-Newton steps over a rotation and a
translation, with smaller and smaller distances between points and cubes. Along a street little
tells one place from another, so the least certain direction is searched.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.kitti360.nearest import NearestLabels, index_cloud

_SIDE = 0.5  # metres, of a cube
_FEWEST = 6  # points of a cube that show its shape
_THIN = 0.08  # metres, standard deviation up to which a cube says where points lie
_NOISE = 0.03  # metres, of points across a surface
_MOST = 4_000_000  # points of a cloud that are used
# Metres between a point and its cube, for three steps each.
_WIDE = (2.0, 1.5, 1.0, 0.7)
_CLOSE = (0.7, 0.5)
# Steps, and metres (or radians times 10 m) below which there is no further one.
_STEPS = 3
_STILL = 2e-3
# of errors of a pose: metres and radians
_PRIOR = np.array([1.0] * 3 + [0.05] * 3) ** -2
_SEARCHED = np.arange(-1.5, 1.51, 0.25)  # metres along the least certain direction
_GAIN = 1.03  # factor of the score by which a transform has to be better than none
_THINNED = 3  # of how many points one is used before the last steps
_FEW = 100  # points near a cube, below which there is nothing to register


@dataclass(frozen=True)
class SurfaceMap:
    """The cubes of a cloud that say where points lie.

    Args:
        index: finds the cube of a point; its values are the cubes' numbers.
        means: (M, 3) metres, relative to ``origin``.
        axes: (M, 3, 3) rows are axes, divided by the standard deviation of the points along them,
            or 0.
        origin: (3,) metres.
    """

    index: NearestLabels
    means: Float64Array
    axes: Float64Array
    origin: Float64Array

    def residuals(
        self, points: Float64Array, radius: float
    ) -> tuple[NDArray[np.intp], Float64Array]:
        """The points (of N, 3) with a cube, as (K,) indices, and (K, 3, 4): the scaled axes, and
        the residual."""
        found = self.index.nearest(points, radius, 1)[0][:, 0]
        hit = np.flatnonzero(found >= 0)
        number = self.index.values[found[hit]]
        axes = self.axes[number]
        off = np.einsum(
            "nij,nj->ni", axes, points[hit] - self.origin - self.means[number]
        )
        return hit, np.concatenate([axes, off[:, :, None]], axis=2)


def find_surfaces(cloud: NearestLabels) -> SurfaceMap:
    """The cubes of an indexed cloud that say where points lie."""
    points = cloud.points[:: max(1, -(-len(cloud) // _MOST))]
    cells = (points / np.float32(_SIDE)).astype(np.int32)
    x, y, z = cells.astype(np.int64).T
    keys = (x << 42) | (y << 21) | z
    order = np.argsort(keys)
    _, starts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    corner = cells[order[starts]] * _SIDE
    local = (points - cells * np.float32(_SIDE)).astype(np.float32)[order]
    mean = _sums(local, starts) / counts[:, None]
    products = [
        _sums(local * local[:, [i]], starts) / counts[:, None] for i in range(3)
    ]
    spread = np.stack(products, axis=1) - mean[:, :, None] * mean[:, None, :]
    variance, axes = np.linalg.eigh(spread)
    deviation = np.sqrt(np.maximum(variance, 0))
    weights = np.where(
        (deviation <= _THIN) & (counts >= _FEWEST)[:, None],
        1 / np.hypot(deviation, _NOISE),
        0,
    )
    kept = weights.any(axis=1)
    means = (corner + mean)[kept]
    scaled = (weights[:, :, None] * axes.transpose(0, 2, 1))[kept]
    numbers = np.arange(len(means), dtype=np.uint32)
    trust = np.ones(len(means), np.float32)
    high = means.max(axis=0, initial=0) + _SIDE
    index = index_cloud(
        [(means + cloud.low, numbers, trust)], cloud.low, cloud.low + high
    )
    return SurfaceMap(index, means, scaled, cloud.low)


def register(points: Float64Array, surfaces: SurfaceMap) -> Float64Array:
    """(4, 4) the transform in the world that lays points (N, 3) onto surfaces; the identity if it
    gains too little."""
    given = np.eye(4)
    few = points[::_THINNED]
    moved, certain = _descend(given, few, surfaces, _WIDE)
    if certain is None:
        return given
    directions = np.linalg.eigh(certain[:2, :2])[1]
    starts = [moved.copy() for _ in _SEARCHED]
    for start, distance in zip(starts, _SEARCHED, strict=True):
        start[:2, 3] += distance * directions[:, 0]
    best = max(starts, key=lambda start: _score(start, few, surfaces))
    found = _descend(best, points, surfaces, _CLOSE)[0]
    gains = _score(found, points, surfaces) > _GAIN * _score(given, points, surfaces)
    return found if gains else given


def _descend(
    transform: Float64Array,
    points: Float64Array,
    surfaces: SurfaceMap,
    radii: tuple[float, ...],
) -> tuple[Float64Array, Float64Array | None]:
    """The transform after some steps, and its (6, 6) certainty, translation first; None without
    enough points."""
    centre = points.mean(axis=0)
    certain = None
    for radius in radii:
        for _ in range(_STEPS):
            moved = apply(transform, points)
            hit, found = surfaces.residuals(moved, radius)
            if len(hit) < _FEW:
                return transform, certain
            axes = found[:, :, :3]
            off = found[:, :, 3]
            slopes = np.concatenate(
                [axes, np.cross((moved[hit] - centre)[:, None, :], axes)], axis=2
            )
            weights = _robust(off, 5 * radius)
            certain = np.einsum("n,nij,nik->jk", weights, slopes, slopes)
            pull = np.einsum("n,nij,ni->j", weights, slopes, off)
            step = -np.linalg.solve(certain + np.diag(_PRIOR), pull)
            transform = _small(step, centre) @ transform
            if np.abs(step * [1, 1, 1, 10, 10, 10]).max() < _STILL:
                break
    return transform, certain


def _score(
    transform: Float64Array, points: Float64Array, surfaces: SurfaceMap
) -> float:
    return float(
        _robust(
            surfaces.residuals(apply(transform, points), _CLOSE[0])[1][:, :, 3],
            5 * _CLOSE[0],
        ).sum()
    )


def _robust(off: Float64Array, scale: float) -> Float64Array:
    """The weights of Geman and McClure for residuals (K, 3)."""
    squared = (off**2).sum(axis=1)
    weights: Float64Array = (1 + squared / scale**2) ** -2
    return weights


def apply(transform: Float64Array, points: Float64Array) -> Float64Array:
    """Points (N, 3) moved by a (4, 4) transform."""
    moved: Float64Array = points @ transform[:3, :3].T + transform[:3, 3]
    return moved


def _small(step: Float64Array, centre: Float64Array) -> Float64Array:
    """(4, 4) a translation and a small rotation vector about a point, made orthogonal."""
    x, y, z = step[3:]
    turned, _, back = np.linalg.svd(
        np.eye(3) + np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    )
    transform = np.eye(4)
    transform[:3, :3] = turned @ back
    transform[:3, 3] = step[:3] + centre - transform[:3, :3] @ centre
    return transform


def _sums(values: NDArray[np.float32], starts: NDArray[np.intp]) -> Float64Array:
    return np.asarray(np.add.reduceat(values, starts, axis=0, dtype=np.float64))
