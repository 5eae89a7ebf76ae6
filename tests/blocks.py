"""A scene of a road, a wall and a car whose returns are known exactly, for any sensor at any
place."""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer import Mount
from lidar_synth.geometry.transfer.rays import rays_of

ROAD, BUILDING, CAR = (TRAIN_ID[name] for name in ("road", "building", "car"))
GROUND = -1.7
CAR_BOX = (10.0, 3.0, -0.9, 4.0, 2.0, 1.6, 0.3)
WALL = (25.0, -20.0, -2.0, 1.0, 60.0, 12.0, 0.0)
REFLECTANCE = {ROAD: 0.25, BUILDING: 0.5, CAR: 0.75}


def record(
    sensor: Sensor,
    mount: Mount | None = None,
    car: tuple[float, ...] = CAR_BOX,
    at: float = 0.0,
) -> Scan:
    """What a sensor records of the scene, without noise; in its own frame.

    Args:
        sensor: the sensor.
        mount: its place relative to the origin.
        car: the box of the car.
        at: metres that the sensor has driven forward.
    """
    rays = rays_of(sensor)
    matrix = (mount or Mount()).matrix.copy()
    matrix[0, 3] += at
    azimuth = rays.first[:, None] + np.arange(rays.firings) * rays.step
    slope, height = (
        np.broadcast_to(v[:, None], azimuth.shape) for v in (rays.slope, rays.height)
    )
    ways = (
        np.stack([np.cos(azimuth), -np.sin(azimuth), slope], -1).reshape(-1, 3)
        @ matrix[:3, :3].T
    )
    starts = (
        np.stack([0 * slope, 0 * slope, height], -1).reshape(-1, 3) @ matrix[:3, :3].T
        + matrix[:3, 3]
    )
    hits = [_road(starts, ways), _box(starts, ways, WALL), _box(starts, ways, car)]
    which = np.argmin(hits, 0)
    along = np.min(hits, 0)
    along[np.isinf(along)] = 1e6
    points = ((starts + along[:, None] * ways) - matrix[:3, 3]) @ matrix[:3, :3]
    distance = np.linalg.norm(points, axis=1)
    kept = (distance >= sensor.range_min) & (distance <= min(sensor.range_max, 70))
    label = np.array([ROAD, BUILDING, CAR], np.uint8)[which[kept]]
    ahead = np.array([(car[0] - at, *car[1:])], np.float32)
    return Scan(
        points[kept].astype(np.float32),
        np.array([REFLECTANCE[int(n)] for n in label], np.float32),
        sensor,
        label=label,
        instance=(label == CAR).astype(np.int32),
        ring=np.repeat(np.arange(len(rays.slope)), rays.firings)[kept].astype(np.int16),
        time=(np.tile(np.arange(rays.firings), len(rays.slope))[kept] * 1e-4).astype(
            np.float32
        ),
        boxes=(mount or Mount()).boxes(
            Boxes(ahead, ("Car",), instance=np.array([1], np.int32))
        ),
        pose=matrix,
        id="blocks",
    )


def image(scan: Scan) -> NDArray[np.int64]:
    """(H, F) index of the return of each ray of the scan's sensor, -1 = none."""
    rays = rays_of(scan.sensor)
    assert scan.ring is not None
    azimuth = -np.arctan2(scan.points[:, 1], scan.points[:, 0]) - rays.first[scan.ring]
    firing = np.rint(azimuth / rays.step).astype(int) % rays.firings
    index = np.full((len(rays.slope), rays.firings), -1)
    index[scan.ring, firing] = np.arange(len(scan))
    return index


def _road(
    starts: NDArray[np.float64], ways: NDArray[np.float64]
) -> NDArray[np.float64]:
    with np.errstate(divide="ignore"):
        along = (GROUND - starts[:, 2]) / ways[:, 2]
    return np.where(ways[:, 2] < -1e-9, along, np.inf)


def _box(
    starts: NDArray[np.float64], ways: NDArray[np.float64], box: tuple[float, ...]
) -> NDArray[np.float64]:
    """Distances along rays to a box (7,), by slabs; inf = none."""
    c = np.cos(box[6])
    s = np.sin(box[6])
    turn = np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])
    start = (starts - box[:3]) @ turn.T
    way = ways @ turn.T
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack(
            [(sign * np.array(box[3:6]) / 2 - start) / way for sign in (-1, 1)]
        )
    near = sides.min(0).max(1)
    far = sides.max(0).min(1)
    return np.where((near <= far) & (near > 0), near, np.inf)
