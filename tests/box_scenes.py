"""Worlds of boxes on a plane, ray-cast analytically, so that the exact scan is known."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import SYNTHETIC, Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, presets

SENSOR = presets()["town"]
HEIGHT = 1.73
CAR = TRAIN_ID["car"]
WALL = TRAIN_ID["building"]
ROAD = TRAIN_ID["road"]


def car(
    x: float, y: float, yaw: float = 0.0, ground: float = -HEIGHT
) -> NDArray[np.float32]:
    """(7,) the box of a car on the ground."""
    return np.array([x, y, ground + 0.8, 4.2, 1.8, 1.6, yaw], np.float32)


def wall(
    x: float, y: float, yaw: float = 0.0, length: float = 10.0, height: float = 4.0
) -> NDArray[np.float32]:
    """(7,) the box of a thin wall that reaches 0.1 m into the ground."""
    return np.array(
        [x, y, height / 2 - HEIGHT - 0.1, length, 0.3, height, yaw], np.float32
    )


def distances(
    box: NDArray[np.float32], rays: NDArray[np.float32]
) -> NDArray[np.float64]:
    """(...) distances in metres along unit rays (..., 3) from the origin to a box; inf where they
    miss it."""
    c = np.cos(float(box[6]))
    s = np.sin(float(box[6]))
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    local = rays.astype(np.float64) @ turn.T
    eye = -turn @ box[:3].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = np.sort(
            np.stack([(-box[3:6] / 2 - eye) / local, (box[3:6] / 2 - eye) / local]),
            axis=0,
        )
    enter = low.max(-1)
    leave = high.min(-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def cast(
    cars: Sequence[NDArray[np.float32]] = (),
    walls: Sequence[NDArray[np.float32]] = (),
    *,
    ground: float = -HEIGHT,
    sensor: Sensor = SENSOR,
    id: str = "world",
) -> Scan:
    """The scan of a world of road, walls and cars; cars have boxes and instances 1, 2, ..."""
    rays = sensor.ray_directions()
    with np.errstate(divide="ignore"):
        road = np.where(
            rays[..., 2] < 0, ground / rays[..., 2].astype(np.float64), np.inf
        )
    hits = np.stack([road, *(distances(b, rays) for b in (*walls, *cars))])
    surface = hits.argmin(0)
    distance = hits.min(0)
    seen = (distance >= sensor.range_min) & (distance <= sensor.range_max)
    label = np.array([ROAD, *[WALL] * len(walls), *[CAR] * len(cars)], np.uint8)[
        surface
    ]
    instance = np.maximum(surface - len(walls), 0)
    image = RangeImage(
        np.where(seen, distance, 0).astype(np.float32),
        sensor,
        {
            "reflectance": np.where(seen, 0.1 + 0.2 * surface % 0.9, 0).astype(
                np.float32
            ),
            "label": np.where(seen, label, IGNORE).astype(np.uint8),
            "instance": np.where(seen, instance, 0).astype(np.int32),
        },
    )
    scan = unproject(image)
    scan.boxes = Boxes(
        np.array(cars, np.float32),
        ("Car",) * len(cars),
        instance=np.arange(1, len(cars) + 1),
    )
    scan.id = id
    scan.domain = SYNTHETIC
    return scan
