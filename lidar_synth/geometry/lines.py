"""The lines that the beams of a rotating sensor draw.

A laser with elevation e at height h above the sensor's origin measures points with z = h + rho
tan(e), where rho is the horizontal distance from the axis: a line per beam.
"""

import numpy as np

from lidar_synth.geometry.arrays import Float64Array, Int64Array

CHUNK = 1 << 15
"""Number of points that are compared with all beams at a time."""


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
    ring = np.empty(len(points), np.int64)
    cosines = 1 / np.hypot(1, tangents)
    for start in range(0, len(points), CHUNK):
        part = points[start : start + CHUNK].astype(np.float32)
        rho = np.hypot(part[:, 0], part[:, 1])
        # The distance from the line; with the same point in each row, it orders beams as the angle
        # does.
        gap = (
            part[:, 2:]
            - rho[:, None] * tangents.astype(np.float32)
            - heights.astype(np.float32)
        ) * cosines
        ring[start : start + CHUNK] = np.abs(gap).argmin(1)
    return ring
