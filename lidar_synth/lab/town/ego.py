"""The ego vehicle: where the LiDAR is mounted on it, and which rays its own body blocks.

The vehicle is an estate car with a roof rack. The LiDAR is mounted on the rack, 1.73 m above the
road, an HDL-64E between two upright camera mounts. Rays that hit the vehicle or the mounts return
nothing in any scan. The lasers of an HDL-64E alternate between the left and the right side of its
axis, so a nearby mount casts two blind spots.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.objects import assemble
from lidar_synth.lab.town.solid import Solid

HEIGHT = 1.73
"""Height of the sensor's origin above the road, metres."""
_LASER_OFFSET = 0.026
"""Lateral offset of the lasers from the sensor's axis, metres."""


def point_rays(azimuth: Float64Array, elevation: Float64Array) -> Float64Array:
    """(..., 3) unit vectors; azimuths clockwise, radians."""
    level = np.cos(elevation)
    x = np.cos(azimuth) * level
    return np.stack([x, -np.sin(azimuth) * level, np.sin(elevation)], -1)


@lru_cache(maxsize=8)
def free_rays(sensor: Sensor) -> NDArray[np.bool_]:
    """(H, F) which rays of a sensor's firings the ego vehicle does not block; read-only."""
    azimuth = sensor.firing_azimuths()
    elevation, height = (
        np.broadcast_to(v[:, None], azimuth.shape) for v in sensor.optics()
    )
    # An HDL-64E is known by its highest laser, which starts 10 cm above its lowest.
    hdl = height[0, 0] > height[-1, 0] + 0.05
    rays = point_rays(azimuth, elevation)
    side = np.resize([-_LASER_OFFSET, _LASER_OFFSET], len(azimuth))[:, None] * hdl
    start = np.stack([side * np.sin(azimuth), side * np.cos(azimuth), height], -1)
    body = assemble("ego_vehicle").triangles
    if hdl:
        body = np.r_[body, assemble("camera_mounts").triangles]
    distance = Solid(body).first(
        *(v.reshape(-1, 3).astype(np.float32) for v in (start, rays))
    )[0]
    free = np.isinf(distance).reshape(azimuth.shape)
    free.setflags(write=False)
    return free
