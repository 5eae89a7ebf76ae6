"""The ego vehicle: where the LiDAR is mounted on it, and which rays its own body blocks.

The vehicle is an estate car with a roof rack. The LiDAR is mounted on the rack, 1.73 m above the
road, between two upright camera mounts. Rays that hit the vehicle or its mounts return nothing in
any scan. The lasers of an HDL-64E alternate between the left and the right side of its axis, so a
nearby mount casts two blind spots.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.town.meshes import Mesh, boxes, fan, merge, tube
from lidar_synth.lab.town.solid import Solid

HEIGHT = 1.73
"""Height of the sensor's origin above the road, metres."""
_LASER_OFFSET = 0.026
"""Lateral offset of the lasers from the sensor's axis, metres."""


def body() -> Mesh:
    """The parts of the vehicle around the LiDAR, in the sensor frame, metres."""
    angle = np.linspace(-0.64, 0.64, 11)
    reach = 0.80 - 0.18 * (angle / 0.64) ** 2
    front = np.stack(
        [reach * np.cos(angle), reach * np.sin(angle), np.full(11, -0.21)], -1
    )
    rear = [
        (-1.60, -0.15),
        (-1.15, -0.32),
        (-0.60, -0.36),
        (-0.60, 0.36),
        (-1.15, 0.32),
        (-1.60, 0.15),
    ]
    rack = [
        (x, y) for x, y in ((-0.58, -0.57), (-0.58, 0.57), (0.78, -0.37), (0.78, 0.37))
    ]
    return merge(
        [
            fan([(0.3, 0.0, -0.21), *front]),
            fan([(x, y, -0.21) for x, y in rear]),
            boxes(
                [(x - 0.04, y - 0.06, -0.30) for x, y in rack],
                [(x + 0.04, y + 0.06, -0.22) for x, y in rack],
            ),
            *(
                tube(
                    [(-0.015, y, z) for z in (-0.4, 0.0, 0.6)],
                    (0.019, 0.0145, 0.007),
                    8,
                )
                for y in (-0.285, 0.285)
            ),
        ]
    )


@lru_cache(maxsize=8)
def free_rays(sensor: Sensor) -> NDArray[np.bool_]:
    """(H, F) which rays of a sensor's firings the ego vehicle does not block; read-only."""
    elevation, height = sensor.optics()
    a = sensor.firing_azimuths()
    e = np.broadcast_to(elevation[:, None], a.shape)
    rays = np.stack([np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)], -1)
    side = np.where(np.arange(len(elevation)) % 2, _LASER_OFFSET, -_LASER_OFFSET)[
        :, None
    ]
    start = np.stack(
        [side * np.sin(a), side * np.cos(a), np.broadcast_to(height[:, None], a.shape)],
        -1,
    )
    distance, _, _ = Solid(body().triangles).first(
        start.reshape(-1, 3).astype(np.float32), rays.reshape(-1, 3).astype(np.float32)
    )
    free = np.isinf(distance).reshape(a.shape)
    free.setflags(write=False)
    return free
