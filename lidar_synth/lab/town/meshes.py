"""Triangle meshes and functions that build them.

A mesh is a list of triangles without shared vertices, as Embree takes it; meshes are merged by
concatenating arrays, and each triangle has a slot number for its finish. Coordinates are metres,
right-handed, z up; an object's own frame has x forward, y left and its origin on the ground below
its centre.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float32]
Slots = int | NDArray[np.int32]


@dataclass(frozen=True)
class Mesh:
    """Triangles, each with a slot: the number of its finish among the finishes of its object.

    Args:
        triangles: (F, 3, 3) float32 corners in metres.
        slot: (F,) int32.
    """

    triangles: Points
    slot: NDArray[np.int32]

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
        shape = np.asarray(scale, np.float32)
        points = (self.triangles * shape).reshape(-1, 3) @ turn + np.asarray(
            offset, np.float32
        )
        return Mesh(points.reshape(-1, 3, 3).astype(np.float32), self.slot)

    def posed(self, pose: NDArray[np.float64]) -> "Mesh":
        """The mesh transformed by a rigid motion (4, 4)."""
        points = self.triangles.reshape(-1, 3) @ pose[:3, :3].T.astype(
            np.float32
        ) + pose[:3, 3].astype(np.float32)
        return Mesh(points.reshape(-1, 3, 3), self.slot)

    @cached_property
    def bounds(self) -> tuple[Points, Points]:
        """Lowest and highest corner, each (3,) metres."""
        points = self.triangles.reshape(-1, 3)
        return points.min(0), points.max(0)

    @cached_property
    def outline(self) -> Points:
        """(P, 3) extreme corners in 160 directions, which approximate the convex hull for image
        boxes."""
        angle = np.pi * (1 + 5**0.5) * np.arange(160)
        up = 1 - 2 * (np.arange(160) + 0.5) / 160
        flat = np.sqrt(1 - up * up)
        points = self.triangles.reshape(-1, 3)
        ways = np.stack([flat * np.cos(angle), flat * np.sin(angle), up])
        outermost: Points = points[np.unique((points @ ways).argmax(0))]
        return outermost


def merge(parts: Iterable[Mesh]) -> Mesh:
    """Merge meshes into one; no parts give an empty mesh."""
    parts = list(parts)
    if not parts:
        return Mesh(np.zeros((0, 3, 3), np.float32), np.zeros(0, np.int32))
    return Mesh(
        np.concatenate([p.triangles for p in parts]),
        np.concatenate([p.slot for p in parts]),
    )


def _slots(slot: Slots, shape: tuple[int, ...]) -> NDArray[np.int32]:
    if isinstance(slot, int):
        return np.full(int(np.prod(shape)), slot, np.int32)
    return np.broadcast_to(np.asarray(slot, np.int32), shape).reshape(-1)


def quads(corners: ArrayLike, slot: Slots = 0) -> Mesh:
    """Flat quadrilaterals.

    Args:
        corners: (Q, 4, 3) metres, in order around each quadrilateral.
        slot: one for all, or (Q,).
    """
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    triangles = points[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return Mesh(triangles, np.repeat(_slots(slot, (len(points),)), 2))


_BOX_FACES = np.array(
    [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
)


def boxes(low: ArrayLike, high: ArrayLike, slot: Slots = 0) -> Mesh:
    """Axis-aligned boxes, given by their lowest and highest corners, each (B, 3) metres."""
    ends = np.stack(
        [
            np.asarray(low, np.float32).reshape(-1, 3),
            np.asarray(high, np.float32).reshape(-1, 3),
        ]
    )
    pick = np.array([(i >> 2, i >> 1 & 1, i & 1) for i in range(8)])
    corners = np.stack([ends[pick[:, axis], :, axis] for axis in range(3)], -1)
    faces = corners[_BOX_FACES].transpose(2, 0, 1, 3)
    return quads(faces, np.repeat(_slots(slot, (faces.shape[0],)), 6))


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
    corners = np.stack(
        [points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], 2
    )
    return quads(corners, _slots(slot, corners.shape[:2]))


def fan(outline: ArrayLike, slot: int = 0) -> Mesh:
    """A flat convex polygon with corners (P, 3), metres."""
    points = np.asarray(outline, np.float32)
    triangles = np.stack(
        [np.broadcast_to(points[0], points[2:].shape), points[1:-1], points[2:]], 1
    )
    return Mesh(triangles, np.full(len(triangles), slot, np.int32))


def prism(
    outline: ArrayLike, bottom: float, top: float, slot: int = 0, cap: int | None = None
) -> Mesh:
    """Vertical walls over a convex outline (P, 2) with a flat top (of slot ``cap``), open at the
    bottom."""
    plan = np.asarray(outline, np.float32)
    low = np.c_[plan, np.full(len(plan), bottom)]
    high = np.c_[plan, np.full(len(plan), top)]
    return merge(
        [loft([low, high], slot, closed=True), fan(high, slot if cap is None else cap)]
    )


def disc(
    centre: ArrayLike, normal: ArrayLike, radius: float, sides: int = 8, slot: int = 0
) -> Mesh:
    """A flat regular polygon around ``centre``."""
    return fan(
        np.asarray(centre) + radius * _rings(np.asarray(normal, float)[None], sides)[0],
        slot,
    )


def _rings(axes: NDArray[np.float64], sides: int) -> NDArray[np.float64]:
    """(K, sides, 3) unit circles perpendicular to K axes (K, 3)."""
    ahead = axes / np.sqrt((axes * axes).sum(1, keepdims=True))
    steep = np.abs(ahead[:, 2]) >= 0.9
    x, y, z = ahead.T
    nought = np.zeros(len(x))
    across = np.where(
        steep[:, None], np.stack([nought, z, -y], 1), np.stack([y, -x, nought], 1)
    )
    across /= np.sqrt((across * across).sum(1, keepdims=True))
    u, v, w = across.T
    other = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], 1)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring: NDArray[np.float64] = (
        np.cos(angle)[:, None] * across[:, None]
        + np.sin(angle)[:, None] * other[:, None]
    )
    return ring


def tube(
    path: ArrayLike, radius: ArrayLike, sides: int = 6, slot: int = 0, caps: bool = True
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
    radii = np.broadcast_to(np.asarray(radius, float), (len(points),))
    along = np.empty_like(points)
    along[1:-1] = points[2:] - points[:-2]
    along[0], along[-1] = points[1] - points[0], points[-1] - points[-2]
    rings = points[:, None] + radii[:, None, None] * _rings(along, sides)
    ends = [fan(rings[0], slot), fan(rings[-1], slot)] if caps else []
    return merge([loft(rings, slot, closed=True), *ends])


def tubes(
    pieces: Sequence[tuple[ArrayLike, ArrayLike]], sides: int = 5, slot: int = 0
) -> Mesh:
    """Several tubes, each given as (path, radius)."""
    return merge(tube(path, radius, sides, slot) for path, radius in pieces)


def leaves(
    centres: ArrayLike, size: ArrayLike, rng: np.random.Generator, slot: Slots = 0
) -> Mesh:
    """Small triangles of random orientation, each representing a cluster of leaves.

    Args:
        centres: (L, 3) metres.
        size: metres from the centre to a corner, one or (L,).
        rng: samples the orientations.
        slot: one for all, or (L,).
    """
    middle = np.asarray(centres, np.float32).reshape(-1, 3)
    axes = rng.standard_normal((2, len(middle), 3)).astype(np.float32)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    (x, y, z), (u, v, w) = axes[0].T, axes[1].T
    first = axes[0]
    second = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], 1)
    second /= np.linalg.norm(second, axis=-1, keepdims=True) + 1e-6
    reach = np.broadcast_to(np.asarray(size, np.float32), (len(middle),))[:, None]
    corners = [first, -0.5 * first + 0.87 * second, -0.5 * first - 0.87 * second]
    return Mesh(
        np.stack([middle + reach * c for c in corners], 1), _slots(slot, (len(middle),))
    )


def ball(
    centre: ArrayLike, radii: ArrayLike, slot: int = 0, rings: int = 4, sides: int = 8
) -> Mesh:
    """An ellipsoid with semi-axes ``radii`` (one or three, metres)."""
    polar = np.linspace(0, np.pi, rings + 1)[:, None]
    angle = 2 * np.pi * np.arange(sides) / sides
    unit = np.stack(
        [
            np.sin(polar) * np.cos(angle),
            np.sin(polar) * np.sin(angle),
            np.cos(polar) * np.ones_like(angle),
        ],
        -1,
    )
    return loft(np.asarray(centre) + unit * np.asarray(radii, float), slot, closed=True)
