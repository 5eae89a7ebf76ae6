"""What a skin looks at: features of each return that come from the scan alone, without labels.

Points are in the order ring by ring, each ring by azimuth. A neighbour lies on the same surface if
it is in the same ring, at most a few firings away, and at nearly the same distance.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float32Array, Int32Array

RANGES = np.array([4, 7, 10, 14, 20, 28, 40, 55], np.float32)
"""Metres, limits between the bins of range."""
HEIGHTS = np.array([-0.4, 0.25, 0.8, 1.6, 3.0], np.float32)
"""Metres above the road, limits between the bins of height."""
KINDS = ("level", "upright", "isolated")
"""Orientation of the surface, by the slope to the neighbouring ring."""
ROUGH = 4
"""Bins of the rank of roughness among the returns of the same range, kind and height in one
domain."""
BANDS = len(RANGES) + 1
CELLS = BANDS * len(KINDS) * (len(HEIGHTS) + 1)
"""Combinations of range, kind and height."""
STRATA = CELLS * ROUGH
BAND = (np.arange(STRATA) // ROUGH % BANDS).astype(np.int32)
"""(STRATA,) the bin of range of each stratum."""
STRATUM_KIND = (np.arange(STRATA) // (ROUGH * BANDS * (len(HEIGHTS) + 1))).astype(
    np.int32
)
"""(STRATA,) the kind of each stratum."""

_WINDOW = 3
"""Neighbours on each side over which reflectance and roughness are averaged."""
_FARTHEST = 8
"""Firings between a return and the neighbours that belong to its surface."""
LARGEST = 0.6
"""Metres: a larger residual of the range is an edge, not noise."""
_LEVEL = 0.3
"""Slope below which a surface is level."""


class RayFeatures(NamedTuple):
    """Features of N returns.

    Args:
        mean: (N,) mean reflectance over the neighbours on the same surface.
        residual: (N,) metres, range minus the mean of the two neighbours in the ring; NaN at edges.
        roughness: (N,) metres, mean absolute residual around the return; an edge counts as
            ``LARGEST``.
        cell: (N,) number of the combination of range, kind and height.
        below: (N,) the return of the next ring below in the same direction, -1 if there is none on
            the same surface.
        gap: (N,) firings to the next return of the ring, if that lies on the same surface;
            otherwise 0.
    """

    mean: Float32Array
    residual: Float32Array
    roughness: Float32Array
    cell: Int32Array
    below: Int32Array
    gap: Int32Array


def find_features(
    points: Float32Array,
    reflectance: Float32Array,
    ring: Int32Array,
    sensor: Sensor,
) -> RayFeatures:
    """Compute the features of a scan.

    Args:
        points: (N, 3) metres, ring by ring, each ring by azimuth in either sense.
        reflectance: (N,) in [0, 1].
        ring: (N,) row of each point's laser, 0 = highest, not decreasing.
        sensor: whose firings give the distance between neighbours.
    """
    firings = sensor.firings or sensor.columns
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    turn = azimuth * np.float32(firings / (2 * np.pi))
    level = np.hypot(points[:, 0], points[:, 1])
    distance = np.sqrt(np.einsum("ij,ij->i", points, points))
    rows = np.ascontiguousarray(ring, np.int32)
    z = np.ascontiguousarray(points[:, 2])
    mean, residual, gap = _along(
        rows, turn, distance, np.ascontiguousarray(reflectance, np.float32), firings
    )
    height = sensor.shape[0]
    kind, below = _across(rows, turn, distance, level, z, height, firings)
    cell = _cells(distance, kind, z - ground_height(z, level, kind))
    rough = _roughness(rows, residual)
    return RayFeatures(mean, residual, rough, cell, below, gap)


def ground_height(z: Float32Array, level: Float32Array, kind: Int32Array) -> np.float32:
    """Metres, height of the road below the sensor: the most frequent height of level surfaces
    within 15 m."""
    near = z[(kind == 0) & (level > 3) & (level < 15) & (np.abs(z) < 5)]
    if not len(near):
        return np.float32(-1.73)
    bins = np.bincount(((near + 5) * 20).astype(np.int64), minlength=201)
    smooth = bins[:-2] + 2 * bins[1:-1] + bins[2:]
    return np.float32((np.argmax(smooth) + 1.5) / 20 - 5)


def find_strata(found: RayFeatures, cuts: Float32Array) -> Int32Array:
    """(N,) stratum of each return, by its cell and the rank of its roughness.

    Args:
        found: the features.
        cuts: (CELLS, ROUGH - 1) limits of roughness between the ranks in this domain.
    """
    return _strata(found.cell, found.roughness, cuts)


@njit(cache=True)
def _apart(turn: Float32Array, i: int, j: int, firings: int) -> float:
    """Firings between two returns of a ring."""
    step = abs(turn[j] - turn[i])
    return float(min(step, firings - step))


@njit(cache=True)
def _along(
    ring: Int32Array,
    turn: Float32Array,
    distance: Float32Array,
    reflectance: Float32Array,
    firings: int,
) -> tuple[Float32Array, Float32Array, Int32Array]:
    """Mean reflectance, residual of the range, and gap of each return."""
    count = len(ring)
    mean = np.empty(count, np.float32)
    residual = np.full(count, np.nan, np.float32)
    gap = np.zeros(count, np.int32)
    for i in range(count):
        total = reflectance[i]
        weight = np.float32(1)
        limit = np.float32(0.15) + np.float32(0.02) * distance[i]
        for j in range(max(i - _WINDOW, 0), min(i + _WINDOW + 1, count)):
            if j == i or ring[j] != ring[i] or abs(distance[j] - distance[i]) > limit:
                continue
            if _apart(turn, i, j, firings) <= _FARTHEST:
                total += reflectance[j]
                weight += np.float32(1)
        mean[i] = total / weight
        if i + 1 == count or ring[i + 1] != ring[i]:
            continue
        step = _apart(turn, i, i + 1, firings)
        ahead = abs(distance[i + 1] - distance[i])
        if ahead <= limit and step <= _FARTHEST:
            gap[i] = max(1, int(step + 0.5))
        if i == 0 or ring[i - 1] != ring[i]:
            continue
        if step < 3.5 and _apart(turn, i - 1, i, firings) < 3.5:
            value = distance[i] - (distance[i - 1] + distance[i + 1]) / 2
            ends = max(abs(distance[i - 1] - distance[i]), ahead)
            if abs(value) < LARGEST and ends < LARGEST + limit:
                residual[i] = value
    return mean, residual, gap


@njit(cache=True)
def _roughness(ring: Int32Array, residual: Float32Array) -> Float32Array:
    count = len(ring)
    out = np.empty(count, np.float32)
    for i in range(count):
        total = np.float32(0)
        weight = np.float32(0)
        for j in range(max(i - _WINDOW, 0), min(i + _WINDOW + 1, count)):
            if ring[j] == ring[i]:
                total += (
                    np.float32(LARGEST) if np.isnan(residual[j]) else abs(residual[j])
                )
                weight += np.float32(1)
        out[i] = total / weight
    return out


@njit(cache=True)
def _across(
    ring: Int32Array,
    turn: Float32Array,
    distance: Float32Array,
    level: Float32Array,
    z: Float32Array,
    rows: int,
    firings: int,
) -> tuple[Int32Array, Int32Array]:
    """Kind of each return, and the return below it on the same surface."""
    count = len(ring)
    table = np.full((rows, firings), -1, np.int32)
    column = np.empty(count, np.int32)
    for i in range(count):
        column[i] = int(np.floor(turn[i])) % firings
        table[ring[i], column[i]] = i
    kind = np.full(count, 2, np.int32)
    below = np.full(count, -1, np.int32)
    for i in range(count):
        for side in (1, -1):
            other = _nearest(table, ring[i] + side, column[i])
            if other < 0:
                continue
            along = abs(level[i] - level[other])
            rise = abs(z[i] - z[other])
            if kind[i] == 2:
                kind[i] = 0 if rise < _LEVEL * along else 1
            step = abs(distance[i] - distance[other])
            same = step < 0.1 + 0.02 * distance[i] or rise < 0.05 * along
            if side == 1 and same:
                below[i] = other
    return kind, below


@njit(cache=True)
def _nearest(table: Int32Array, row: int, column: int) -> int:
    """The return of a ring at most two firings away, -1 if there is none."""
    if 0 <= row < len(table):
        for offset in (0, 1, -1, 2, -2):
            other = table[row, (column + offset) % table.shape[1]]
            if other >= 0:
                return int(other)
    return -1


@njit(cache=True)
def _cells(
    distance: Float32Array, kind: Int32Array, height: Float32Array
) -> Int32Array:
    out = np.empty(len(distance), np.int32)
    for i in range(len(distance)):
        a = np.searchsorted(RANGES, distance[i], side="right")
        b = np.searchsorted(HEIGHTS, height[i], side="right")
        out[i] = (kind[i] * (len(HEIGHTS) + 1) + b) * BANDS + a
    return out


@njit(cache=True)
def _strata(
    cell: Int32Array, roughness: Float32Array, cuts: Float32Array
) -> Int32Array:
    out = np.empty(len(cell), np.int32)
    for i in range(len(cell)):
        rank = 0
        for k in range(ROUGH - 1):
            if roughness[i] >= cuts[cell[i], k]:
                rank += 1
        out[i] = cell[i] * ROUGH + rank
    return out
