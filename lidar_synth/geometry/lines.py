"""The lines that the beams of a rotating sensor draw.

A laser with elevation e at height h above the sensor's origin measures points with z = h + rho
tan(e), where rho is the horizontal distance from the axis: a line per beam.
"""

import numba
import numpy as np

from lidar_synth.geometry.arrays import Float64Array, Int64Array


def residuals(
    points: Float64Array,
    ring: Int64Array,
    tangents: Float64Array,
    heights: Float64Array,
) -> Float64Array:
    """(N,) angle between each point and its beam, radians; upward is positive."""
    rho = np.hypot(points[:, 0], points[:, 1])
    above = points[:, 2] - heights[ring]
    return np.asarray(np.arctan2(above, rho) - np.arctan(tangents[ring]))


def nearest_beams(
    points: Float64Array, tangents: Float64Array, heights: Float64Array
) -> Int64Array:
    """(N,) the beam that passes nearest to each point, by angle."""
    if not np.ptp(heights):
        order = np.argsort(tangents)
        angles = np.arctan(tangents[order])
        elevation = np.arctan2(
            points[:, 2] - heights[0], np.hypot(points[:, 0], points[:, 1])
        )
        return np.asarray(
            order[np.searchsorted((angles[1:] + angles[:-1]) / 2, elevation)]
        )
    ring = np.zeros(len(points), np.int64)
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    slopes, starts = np.asarray([tangents, heights], np.float32)
    _nearest(np.hypot(x, y), z, slopes, starts, 1 / np.hypot(1, tangents), ring)
    return ring


@numba.njit(cache=True, error_model="numpy")
def _nearest(rho, z, tangents, heights, cosines, ring):  # type: ignore[no-untyped-def]
    """Fill ``ring`` (N,), which holds zeros, with the first of the nearest beams of each point.

    The distance from the line orders the beams of a point as the angle does.
    """
    for i in range(len(rho)):
        nearest = np.inf
        for k in range(len(tangents)):
            gap = abs((z[i] - rho[i] * tangents[k] - heights[k]) * cosines[k])
            if gap < nearest:
                nearest = gap
                ring[i] = k
