"""The first hits of a sensor's rays on the surfaces of one scan."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.geometry.scan import POINT_FIELDS, Scan
from lidar_synth.geometry.transfer.kernels import (
    hit_footprints,
    hit_triangles,
    put_in_front,
    rows_above,
    shape_footprints,
)
from lidar_synth.geometry.transfer.rays import Rays
from lidar_synth.geometry.transfer.surfaces import Surfaces

FRONT = 0.5, 0.03
"""Metres, and share of its distance, by which the footprint of a return has to lie in front of a surface to hide it."""

REACH = 0.3
"""Metres by which the level patch of a return that is not of the ground reaches along a ray: roofs end, the road goes
on."""


@dataclass
class Hits:
    """The first hits of (H, F) rays.

    Args:
        rho: horizontal distance in metres; inf = none.
        reflectance: in [0, 1].
        facing: cosine of the angle between ray and normal, in [0, 1].
        carried: fields of ``POINT_FIELDS`` of the nearest return.
    """

    rho: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    facing: NDArray[np.float64]
    carried: dict[str, NDArray[Any]]

    def fill(self, other: "Hits") -> None:
        """Take the hits of others, in place, for rays without one; fields that others lack stay 0."""
        empty = np.isinf(self.rho) & np.isfinite(other.rho)
        for name in (f.name for f in fields(self) if f.name != "carried"):
            getattr(self, name)[empty] = getattr(other, name)[empty]
        for name, values in self.carried.items():
            values[empty] = other.carried[name][empty] if name in other.carried else _UNKNOWN.get(name, 0)


_UNKNOWN = {"label": IGNORE}


def first_hits(surfaces: Surfaces, points: NDArray[np.float64], rays: Rays, upright: NDArray[np.float64]) -> Hits:
    """Cast rays at the surfaces of a scan.

    Returns at the rim of a surface stand for a patch of their own: level where the surface is level, else vertical.

    Args:
        surfaces: of N returns.
        points: (N, 3) the returns in the frame of the rays, metres; NaN for returns that are left out.
        rays: H lasers with F firings.
        upright: (3,) the upward direction in the frame of the rays.
    """
    scan, shape = surfaces.scan, (len(rays.slope), rays.firings)
    there = np.isfinite(points[:, 0])
    azimuth, rho = -np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    rows = np.empty(len(points), np.int32)
    rows_above(rho, points[:, 2], rays.slope, rays.height, rows)
    triangles = surfaces.triangles if there.all() else surfaces.triangles[there[surfaces.triangles].all(1)]
    value = scan.reflectance.astype(np.float64)
    lasers = rays.slope, rays.height, rays.first, rays.step
    solid, vertex = np.full(shape, np.inf), np.zeros(shape, np.int32)
    mean, facing = np.zeros(shape), np.ones(shape)
    hit_triangles(points, azimuth, rho, rows, value, triangles, *lasers, rays.directions, solid, vertex, mean, facing)
    patch, of = np.full(shape, np.inf), np.zeros(shape, np.int32)
    rim = np.flatnonzero(surfaces.rim & there & (rho > 0.05))
    half, up, down = np.empty((3, len(rim)))
    normal = np.empty((len(rim), 3))
    opening = surfaces.step, surfaces.up, surfaces.down
    shape_footprints(scan.points, points, rho, rim, surfaces.level, *opening, upright, half, up, down, normal)
    hit_footprints(points[rim], azimuth[rim], rho[rim], normal, half, up, down, _reach(scan, rim), *lasers, patch, of)
    put_in_front(patch, of, rim, value, *FRONT, solid, vertex, mean, facing)
    names = [n for n in POINT_FIELDS if n not in ("reflectance", "ring") and getattr(scan, n) is not None]
    return Hits(solid, mean, facing, {n: getattr(scan, n).take(vertex) for n in names})


def _reach(scan: Scan, which: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n,) metres by which the patches of some returns reach along a ray; without limit on ground and unlabelled."""
    if scan.label is None:
        return np.full(len(which), np.inf)
    label = scan.label[which]
    return np.where(GROUND[label] | (label == IGNORE), np.inf, REACH)
