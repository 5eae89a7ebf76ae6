"""The recording vehicle: the camera and LiDAR on its roof, and what its own body hides from the LiDAR.

An estate car with a roof rack; the LiDAR stands on the rack, 1.73 m above the road, between two upright camera
mounts a hand's breadth from it. A laser that meets any of this is blind there, in every scan. The lasers of an
HDL-64E leave its drum by turns on the left and right of its axis, so that a near mount hides two places.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor
from lidar_synth.town.meshes import Mesh, boxes, fan, merge, tube
from lidar_synth.town.solid import Solid

HEIGHT = 1.73
"""Metres of the sensor's origin above the road."""
_ASIDE = 0.026
"""Metres from the drum's axis to the lasers on either side of it."""


def body() -> Mesh:
    """What stands around the LiDAR, in the sensor's frame, metres."""
    angle = np.linspace(-0.64, 0.64, 11)
    reach = 0.80 - 0.18 * (angle / 0.64) ** 2
    front = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.full(11, -0.21)], -1)
    rear = [(-1.60, -0.15), (-1.15, -0.32), (-0.60, -0.36), (-0.60, 0.36), (-1.15, 0.32), (-1.60, 0.15)]
    rack = [(x, y) for x, y in ((-0.58, -0.57), (-0.58, 0.57), (0.78, -0.37), (0.78, 0.37))]
    return merge([
        fan([(0.3, 0.0, -0.21), *front]),
        fan([(x, y, -0.21) for x, y in rear]),
        boxes([(x - 0.04, y - 0.06, -0.30) for x, y in rack], [(x + 0.04, y + 0.06, -0.22) for x, y in rack]),
        *(tube([(-0.015, y, z) for z in (-0.4, 0.0, 0.6)], (0.019, 0.0145, 0.007), 8) for y in (-0.285, 0.285)),
    ])  # fmt: skip


def optics(sensor: Sensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where a sensor's lasers point and how far above its origin they start.

    Returns:
        (H,) elevations in radians and (H,) heights in metres. A sensor's beams are the elevations at which
        returns from a street appear, seen from the origin: a laser that starts above it points further down.
    """
    seen = sensor.laser_elevations.astype(float)
    if sensor.heights is None:
        return seen, np.zeros(len(seen))
    heights = np.asarray(sensor.heights)
    # Most returns of a beam come from the level road; things that stand on it make the usual distance shorter.
    usual = np.minimum(1 / (np.maximum(np.sin(-seen), 1e-3) / HEIGHT + 1 / 110), 20.0)
    return seen - heights / usual, heights


@lru_cache(maxsize=8)
def free_rays(sensor: Sensor) -> NDArray[np.bool_]:
    """(H, W) which rays of a sensor its own vehicle leaves free; read-only."""
    elevation, height = optics(sensor)
    azimuth = sensor.column_azimuths().astype(float)
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)], -1)
    side = np.where(np.arange(len(elevation)) % 2, _ASIDE, -_ASIDE)[:, None]
    start = np.stack([side * np.sin(a), side * np.cos(a), np.broadcast_to(height[:, None], a.shape)], -1)
    distance, _, _ = Solid(body().triangles).first(
        start.reshape(-1, 3).astype(np.float32), rays.reshape(-1, 3).astype(np.float32)
    )
    free = np.isinf(distance).reshape(a.shape)
    free.setflags(write=False)
    return free
