"""How the protocols turn a scan into the input of a network: a range image, or a cloud of
points."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import choose
from lidar_synth.geometry import Scan, Sensor, presets
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.projection import locate, project
from lidar_synth.lab.evaluate.lidm import SENSOR

CHANNELS = ("range", "x", "y", "z", "remission")
"""Channels of every image; metres, and reflectance in [0, 1]."""

NEAREST = 1.0
FURTHEST = 56.0
"""Ranges that LiDM and R3DPA keep, both exclusive, metres."""

_UP = 3.0 / 180.0 * np.pi
_DOWN = 25.0 / 180.0 * np.pi


class NetworkInputs(NamedTuple):
    """The inputs of a protocol.

    Args:
        image: ``(scan, generated) -> (5, H, W)`` float32: range, x, y, z, remission.
        cloud: ``(scan, generated) -> (N, 3)`` float32, metres.
    """

    image: Callable[[Scan, bool], Float32Array]
    cloud: Callable[[Scan, bool], Float32Array]


def nearest_points(
    scan: Scan, sensor: Sensor
) -> tuple[Float32Array, NDArray[np.int32]]:
    """(5, H, W) range, position and reflectance of the nearest point in each cell, 0 where there is
    none; and the index (H, W) of that point, -1 = none."""
    cells = locate(scan.points, sensor)
    filled = cells.point >= 0
    shown = cells.point[filled]
    image = np.zeros((len(CHANNELS), *sensor.shape), np.float32)
    image[:, filled] = np.column_stack(
        [cells.range[shown], scan.points[shown], scan.reflectance[shown]]
    ).T
    return image, cells.point


def _r2flow_image(scan: Scan, generated: bool) -> Float32Array:
    """Returns from 0.5 m to 63 m, 0 elsewhere. Generated returns are put on rays through the cells'
    corners."""
    sensor = presets()["hdl64e_kitti360"]
    image, _ = nearest_points(scan, sensor)
    if generated:
        image[1:4] = image[0] * np.moveaxis(sensor.ray_directions("corner"), -1, 0)
    image[:, ~((image[0] > 0.5) & (image[0] < 63))] = 0
    return image


def _r2flow_cloud(scan: Scan, generated: bool) -> Float32Array:
    image = _r2flow_image(scan, generated)
    return np.ascontiguousarray(image[1:4, image[0] > 0].T)


def _lidm_cloud(scan: Scan, generated: bool) -> Float32Array:
    """The returns of the range image on rays through the cells' corners, real or generated."""
    image = project(scan, SENSOR, ())
    xyz = (_corner_rays()[image.mask] * image.range[image.mask, None]).astype(
        np.float32
    )
    distance = np.linalg.norm(xyz, axis=1)
    kept: Float32Array = xyz[(distance > NEAREST) & (distance < FURTHEST)]
    return kept


def _lidm_image(scan: Scan, generated: bool) -> Float32Array:
    """The cloud projected again, as in LiDM's evaluation; -1 where there is no return, remission
    unknown.

    A corner is the edge of four cells, so that rounding decides which of them a point meets: about
    7 % of the returns are lost. The operations are therefore those of LiDM's ``pcd2range`` in
    float32, and not ``locate``.
    """
    points = _lidm_cloud(scan, generated)
    distance = np.linalg.norm(points, axis=1)
    column = 0.5 * (-np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1.0) * 1024
    row = (1.0 - (np.arcsin(points[:, 2] / distance) + _DOWN) / (_DOWN + _UP)) * 64
    cell = [
        np.floor(v).clip(0, size - 1).astype(np.int32)
        for v, size in ((row, 64), (column, 1024))
    ]
    furthest_first = np.argsort(distance)[::-1]
    depth = np.full((64, 1024), -1, np.float32)
    depth[cell[0][furthest_first], cell[1][furthest_first]] = distance[furthest_first]
    return _on_corner_rays(depth, np.full_like(depth, -1))


def _r3dpa_image(scan: Scan, generated: bool) -> Float32Array:
    """Range and position -1 and remission 0 where there is no return; returns on rays through the
    cells' corners."""
    image = project(scan, SENSOR, ("reflectance",))
    return _on_corner_rays(
        np.where(image.mask, image.range, np.float32(-1)), image.channels["reflectance"]
    )


def _on_corner_rays(depth: Float32Array, remission: Float32Array) -> Float32Array:
    xyz = np.moveaxis(_corner_rays() * depth[..., None], -1, 0)
    xyz[:, ~((depth > NEAREST) & (depth < FURTHEST))] = -1
    return np.concatenate([depth[None], xyz, remission[None]]).astype(np.float32)


@lru_cache(maxsize=1)
def _corner_rays() -> NDArray[np.float64]:
    """(64, 1024, 3) unit vectors through the upper left corners of the cells, in float64 as in
    LiDM's code."""
    yaw = np.pi * (np.arange(1024) / 1024 * 2 - 1)
    pitch = ((1.0 - np.arange(64) / 64) * (_DOWN + _UP) - _DOWN)[:, None]
    rays = [
        np.cos(yaw) * np.cos(pitch),
        -np.sin(yaw) * np.cos(pitch),
        np.sin(pitch) * np.ones_like(yaw),
    ]
    return np.stack(rays, -1)


PREPARATIONS = {
    "r2flow": NetworkInputs(_r2flow_image, _r2flow_cloud),
    "lidm": NetworkInputs(_lidm_image, _lidm_cloud),
    "r3dpa": NetworkInputs(_r3dpa_image, _lidm_cloud),
}
"""Inputs by the name of their protocol."""


def preparation(name: str) -> NetworkInputs:
    """The inputs of a protocol.

    Raises:
        ConfigError: on an unknown name.
    """
    return choose("preparation", name, PREPARATIONS)
