"""Triangle meshes and functions that build them.

A mesh is a list of triangles without shared vertices, as Embree takes it; meshes are merged by
concatenating arrays, and each triangle has a slot number for its finish. Coordinates are metres,
right-handed, z up; an object's own frame has x forward, y left and its origin on the ground below
its centre.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.geometry.arrays import Float32Array, Float64Array, Int32Array
from lidar_synth.lab.town.catalogue import Rng

Slots = int | Int32Array


@dataclass(frozen=True)
class Mesh:
    """Triangles, each with a slot: the number of its finish among the finishes of its object.

    Args:
        triangles: (F, 3, 3) float32 corners in metres.
        slot: (F,) int32.
    """

    triangles: Float32Array
    slot: Int32Array

    def __len__(self) -> int:
        return len(self.slot)

    def moved(
        self, offset: ArrayLike = (0, 0, 0), yaw: float = 0.0, scale: ArrayLike = 1.0
    ) -> "Mesh":
        """The mesh scaled (one factor or one per axis), then rotated about z (radians), then
        translated (metres)."""
        c = np.cos(yaw)
        s = np.sin(yaw)
        turn = np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)], np.float32)
        scaled = self.triangles * np.asarray(scale, np.float32)
        return self._turned(scaled, turn, offset)

    def posed(self, pose: Float64Array) -> "Mesh":
        """The mesh transformed by a rigid motion (4, 4)."""
        turn = pose[:3, :3].T.astype(np.float32)
        return self._turned(self.triangles, turn, pose[:3, 3])

    def _turned(
        self, triangles: Float32Array, turn: Float32Array, offset: ArrayLike
    ) -> "Mesh":
        points = triangles.reshape(-1, 3) @ turn + np.asarray(offset, np.float32)
        return Mesh(points.reshape(-1, 3, 3), self.slot)

    @cached_property
    def bounds(self) -> tuple[Float32Array, Float32Array]:
        """Lowest and highest corner, each (3,) metres."""
        points = self.triangles.reshape(-1, 3)
        return points.min(0), points.max(0)

    @cached_property
    def sphere(self) -> tuple[Float32Array, float]:
        """Centre (3,) and radius of a sphere around it, metres."""
        low, high = self.bounds
        middle = np.asarray((low + high) / 2, np.float32)
        return middle, float(np.linalg.norm(high - low)) / 2

    @cached_property
    def outline(self) -> Float32Array:
        """(P, 3) extreme corners in 160 directions, which approximate the convex hull for image
        boxes."""
        angle = np.pi * (1 + 5**0.5) * np.arange(160)
        up = 1 - 2 * (np.arange(160) + 0.5) / 160
        flat = np.sqrt(1 - up * up)
        points = self.triangles.reshape(-1, 3)
        ways = np.stack([flat * np.cos(angle), flat * np.sin(angle), up])
        outermost: Float32Array = points[np.unique((points @ ways).argmax(0))]
        return outermost


_NOTHING = Mesh(np.zeros((0, 3, 3), np.float32), np.zeros(0, np.int32))


def merge(parts: Iterable[Mesh]) -> Mesh:
    """Merge meshes into one; no parts give an empty mesh."""
    parts = [p for p in parts if len(p.slot)] or [_NOTHING]
    if len(parts) == 1:
        return parts[0]
    return Mesh(
        np.concatenate([p.triangles for p in parts]),
        np.concatenate([p.slot for p in parts]),
    )


def _slots(slot: Slots, *shape: int) -> Int32Array:
    if isinstance(slot, int):
        return np.full(math.prod(shape), slot, np.int32)
    return np.broadcast_to(np.asarray(slot, np.int32), shape).ravel()


def quads(corners: ArrayLike, slot: Slots = 0) -> Mesh:
    """Flat quadrilaterals.

    Args:
        corners: (Q, 4, 3) metres, in order around each quadrilateral.
        slot: one for all, or (Q,).
    """
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    triangles = points[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return Mesh(triangles, np.repeat(_slots(slot, len(points)), 2))


_BOX_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
_BOX_FACES = np.array(
    [
        (0, 2, 3, 1),
        (4, 5, 7, 6),
        (0, 1, 5, 4),
        (2, 6, 7, 3),
        (0, 4, 6, 2),
        (1, 3, 7, 5),
    ]
)


def boxes(low: ArrayLike, high: ArrayLike, slot: Slots = 0) -> Mesh:
    """Axis-aligned boxes, given by their lowest and highest corners, each (B, 3) metres."""
    ends = np.array([low, high], np.float32).reshape(2, -1, 3)
    corners = ends[_BOX_CORNERS, :, np.arange(3)]
    faces = corners[_BOX_FACES].transpose(3, 0, 1, 2)
    return quads(faces, np.repeat(_slots(slot, len(faces)), 6))


def loft(sections: ArrayLike, slot: Slots = 0, closed: bool = False) -> Mesh:
    """The surface through a sequence of cross-sections.

    Args:
        sections: (S, P, 3) metres, P points around each of S cross-sections.
        slot: one for all, or (S-1, P-1) by panel ((S-1, P) if closed).
        closed: whether the last point of a section joins the first.
    """
    points = np.asarray(sections, np.float32)
    if closed:
        points = np.concatenate([points, points[:, :1]], 1)
    here = points[:-1]
    there = points[1:]
    corners = np.stack([here[:, :-1], here[:, 1:], there[:, 1:], there[:, :-1]], 2)
    return quads(corners, _slots(slot, *corners.shape[:2]))


def fan(outline: ArrayLike, slot: int = 0) -> Mesh:
    """A flat convex polygon with corners (P, 3), metres."""
    points = np.asarray(outline, np.float32)
    corners = np.broadcast_arrays(points[0], points[1:-1], points[2:])
    triangles = np.stack(corners, 1)
    return Mesh(triangles, _slots(slot, len(triangles)))


def circle(sides: int) -> Float64Array:
    """(sides, 2) the corners of a regular polygon on the unit circle."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def sphere(rings: int, sides: int) -> Float64Array:
    """(rings + 1, sides, 3) points on the unit sphere, from its top to its bottom."""
    polar = np.linspace(0, np.pi, rings + 1)[:, None]
    x, y = circle(sides).T
    flat = np.sin(polar)
    return np.stack([flat * x, flat * y, np.cos(polar) + 0 * x], -1)


def cylinder(
    radius: float,
    bottom: float,
    top: float,
    sides: int,
    slot: int = 0,
) -> Mesh:
    """An upright cylinder around the z axis, open at the bottom."""
    plan = radius * circle(sides)
    rings = [np.c_[plan, np.full(sides, z)] for z in (bottom, top)]
    return merge([loft(rings, slot, closed=True), fan(rings[1], slot)])


def disc(
    centre: ArrayLike,
    normal: ArrayLike,
    radius: float,
    sides: int = 8,
    slot: int = 0,
) -> Mesh:
    """A flat regular polygon around ``centre``."""
    [ring] = _rings(np.array([normal], float), sides)
    return fan(np.asarray(centre) + radius * ring, slot)


def _cross(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """(N, 3) cross products; ``np.cross`` is slow for few vectors."""
    x, y, z = a.T
    u, v, w = b.T
    across = [y * w - z * v, z * u - x * w, x * v - y * u]
    return np.stack(across, 1)


def _rings(axes: Float64Array, sides: int) -> Float64Array:
    """(K, sides, 3) unit circles perpendicular to K axes (K, 3)."""
    ahead = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    steep = np.abs(ahead[:, 2:]) >= 0.9
    across = _cross(ahead, np.where(steep, (1, 0, 0), (0, 0, 1)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    x, y = circle(sides).T[..., None]
    ring: Float64Array = x * across[:, None] + y * _cross(ahead, across)[:, None]
    return ring


def tube(
    path: ArrayLike,
    radius: ArrayLike,
    sides: int = 6,
    slot: int = 0,
    caps: bool = True,
) -> Mesh:
    """A tube along a path.

    Args:
        path: (K, 3) metres.
        radius: metres, one or (K,).
        sides: number of corners of its cross-section.
        slot: slot of all faces.
        caps: whether its ends are closed.
    """
    points = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radius, float), len(points))
    circles = _rings(np.gradient(points, axis=0), sides)
    rings = points[:, None] + radii[:, None, None] * circles
    ends = [fan(rings[0], slot), fan(rings[-1], slot)] if caps else []
    return merge([loft(rings, slot, closed=True), *ends])


def tubes(
    paths: Sequence[ArrayLike],
    radius: ArrayLike,
    sides: int = 5,
    slot: int = 0,
) -> Mesh:
    """Several tubes of the same radius."""
    return merge(tube(path, radius, sides, slot) for path in paths)


def hoop(
    x: float,
    radius: float,
    thick: float,
    slot: int,
) -> Mesh:
    """The tyre of an upright wheel of 14 sides that touches the ground at x."""
    out = np.insert(circle(14), 1, 0, axis=1)
    centre = np.array((x, 0, radius))
    outer = centre + radius * out
    inner = outer - thick * out
    across = np.array((0, thick, 0))
    sections = np.stack([inner, inner + across, outer, inner - across], 1)
    return loft(np.concatenate([sections, sections[:1]]), slot, closed=True)


def leaves(
    centres: ArrayLike,
    size: ArrayLike,
    rng: Rng,
    slot: int = 0,
) -> Mesh:
    """Small triangles of random orientation, each representing a cluster of leaves.

    Args:
        centres: (L, 3) metres.
        size: metres from the centre to a corner, one or (L,).
        rng: samples the orientations.
        slot: of all.
    """
    middle = np.asarray(centres, np.float32)
    axes = rng.standard_normal((2, len(middle), 3)).astype(np.float32)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    first = axes[0]
    second = _cross(first, axes[1])
    second /= np.linalg.norm(second, axis=-1, keepdims=True) + 1e-6
    reach = np.broadcast_to(np.asarray(size, np.float32), len(middle))[:, None]
    corners = [first, -0.5 * first + 0.87 * second, -0.5 * first - 0.87 * second]
    triangles = np.stack([middle + reach * c for c in corners], 1)
    return Mesh(triangles, _slots(slot, len(middle)))


def ball(
    centre: ArrayLike,
    radii: ArrayLike,
    slot: int = 0,
    rings: int = 4,
    sides: int = 8,
) -> Mesh:
    """An ellipsoid with semi-axes ``radii`` (one or three, metres)."""
    points = np.asarray(centre) + sphere(rings, sides) * np.asarray(radii, float)
    return loft(points, slot, closed=True)
