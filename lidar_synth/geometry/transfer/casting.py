"""The first hits of a sensor's rays on the surfaces of one scan."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.transfer.hits import (
    FootprintShape,
    Nearest,
    Vertices,
    hit_footprints,
    hit_triangles,
    rows_above,
)
from lidar_synth.geometry.transfer.rays import Rays
from lidar_synth.geometry.transfer.surfaces import ScanSurfaces

FRONT = 0.5, 0.03
"""Metres, and share of its distance, by which the footprint of a return has to lie in front of a
surface to hide it."""

REACH = 0.3
"""Metres by which the level patch of a return reaches along a ray unless it is of the ground: roofs
end, but the road goes on."""


@dataclass
class Hits:
    """The first hits of (H, F) rays on surfaces of N returns.

    Args:
        nearest: the hits.
        fields: {name: (N,)}, the fields of the returns.
    """

    nearest: Nearest
    fields: dict[str, NDArray[Any]]

    def add(self, other: "Hits", where: NDArray[np.bool_]) -> None:
        """Replace the hits of the rays ``where`` (H, F) by those of ``other``, in place; fields
        that ``other`` lacks become 0, labels 255 = ignore."""
        count = len(next(iter(self.fields.values())))
        more = len(next(iter(other.fields.values())))
        for name in Nearest._fields:
            getattr(self.nearest, name)[where] = getattr(other.nearest, name)[where]
        self.nearest.vertex[where] += count
        for name, values in self.fields.items():
            unknown = np.full(more, IGNORE if name == "label" else 0)
            added = other.fields.get(name, unknown)
            self.fields[name] = np.concatenate([values, added]).astype(values.dtype)

    def carried(self, at: NDArray[np.integer]) -> dict[str, Any]:
        """{name: (n,)}, the fields of the nearest returns of some rays (n,), numbered row by row,
        except for reflectance and ring."""
        vertex = self.nearest.vertex.take(at)
        names = self.fields.keys() - {"reflectance", "ring"}
        return {name: self.fields[name].take(vertex) for name in names}


def first_hits(
    surfaces: ScanSurfaces,
    points: NDArray[np.float64],
    rays: Rays,
    upright: NDArray[np.float64],
) -> Hits:
    """Cast rays at the surfaces of a scan.

    Returns at the rim of a surface stand for a patch of their own: level where the surface is
    level, else vertical.

    Args:
        surfaces: of N returns.
        points: (N, 3) the returns in the frame of the rays, metres; NaN for returns that are left
            out.
        rays: H lasers with F firings.
        upright: (3,) the upward direction in the frame of the rays.
    """
    scan = surfaces.scan
    finite = np.isfinite(points[:, 0])
    azimuth = -np.arctan2(points[:, 1], points[:, 0])
    rho = np.empty(len(points))
    rows = np.empty(len(points), np.int32)
    rows_above(points, rays, rho, rows)
    vertices = Vertices(points, azimuth, rho, rows, scan.reflectance)
    triangles = (
        surfaces.triangles
        if finite.all()
        else surfaces.triangles[finite[surfaces.triangles].all(1)]
    )
    size = len(rays.slope), rays.firings
    zeros = np.zeros(size, np.float32)
    nearest = Nearest(
        np.full(size, np.inf), np.zeros(size, np.int32), zeros, np.ones_like(zeros)
    )
    hit_triangles(vertices, triangles, rays, nearest)
    rim = np.flatnonzero(surfaces.rim & finite & (rho > 0.05))
    shape = FootprintShape(
        scan.points, surfaces.level, surfaces.step / 2, surfaces.up, surfaces.down
    )
    hit_footprints(
        vertices, rim, _reach(scan, rim), shape, upright, rays, FRONT, nearest
    )
    return Hits(nearest, scan.fields())


def _reach(scan: Scan, which: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n,) metres by which the patches of some returns reach along a ray; without limit on ground
    and unlabelled."""
    if scan.label is None:
        return np.full(len(which), np.inf)
    label = scan.label[which]
    return np.where(GROUND[label] | (label == IGNORE), np.inf, REACH)
