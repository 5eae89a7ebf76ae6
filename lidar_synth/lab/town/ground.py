"""The ground: rectangles in street coordinates, then bent along the centre line and laid over the
hills.

In street coordinates every kerb, bay and driveway is a rectangle, so the ground is a grid of cells
whose lines are the rectangles' edges. The course bends this grid, and the relief lifts it. A
vertical face (a kerb) closes the gap where neighbouring cells differ in height.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.lab.town.course import Course, Relief
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.meshes import Mesh, merge, quads

Rect = tuple[float, float, float, float, int]
Array = NDArray[np.float64]


class GroundKind(NamedTuple):
    """One kind of ground: its finish, SemanticKITTI's class id, and its height above the
    carriageway, metres."""

    finish: Finish
    raw: int
    lift: float


KINDS: dict[str, GroundKind] = {
    "grass": GroundKind(Finish("grass"), 72, 0.10),
    "soil": GroundKind(Finish("soil"), 72, 0.09),
    "field": GroundKind(Finish("soil", (0.52, 0.46, 0.27)), 72, 0.05),
    "yard": GroundKind(Finish("gravel"), 49, 0.08),
    "road": GroundKind(Finish("asphalt"), 40, 0.0),
    "old_road": GroundKind(Finish("asphalt", (0.33, 0.32, 0.31)), 40, 0.0),
    "marking": GroundKind(Finish("marking"), 60, 0.0),
    "parking": GroundKind(Finish("paving", (0.40, 0.38, 0.37)), 44, 0.015),
    "driveway": GroundKind(Finish("paving", (0.55, 0.50, 0.46)), 44, 0.11),
    "sidewalk": GroundKind(Finish("paving"), 48, 0.12),
    "cycleway": GroundKind(Finish("asphalt", (0.45, 0.27, 0.24)), 48, 0.12),
    "kerb": GroundKind(Finish("kerbstone"), 48, 0.12),
    "plaza": GroundKind(Finish("cobble"), 49, 0.12),
    "rails": GroundKind(Finish("gravel", (0.38, 0.35, 0.33)), 49, 0.03),
}
"""The kinds of ground by name."""

NAMES = tuple(KINDS)
_ROUGH = [NAMES.index(k) for k in ("grass", "soil", "field")]
_LIFT = np.array([k.lift for k in KINDS.values()])


class Corner(NamedTuple):
    """A rounded corner of a kerb.

    Args:
        s, t: the corner point, metres.
        along, across: on which side of it the pavement lies, +1 or -1 along s and along t.
        radius: metres.
    """

    s: float
    t: float
    along: int
    across: int
    radius: float


class TownGround:
    """The ground of a stretch.

    Args:
        course: the centre line that it follows.
        relief: the heights of the terrain.
        edge: metres from the centre line to the kerb, (right, left); the carriageway slopes down
            towards the kerb.
        reach: (lowest s, highest s, lowest t, highest t) of all ground, metres.
        fine: the interval of s in which cells are at most 3 m long; they are longer outside.
        rects: (lowest s, highest s, lowest t, highest t, index in ``NAMES``); later rectangles
            cover earlier ones.
        corners: rounded corners of kerbs.
    """

    def __init__(
        self,
        course: Course,
        relief: Relief,
        edge: tuple[float, float],
        reach: tuple[float, float, float, float],
        fine: tuple[float, float],
        rects: list[Rect],
        corners: list[Corner],
    ) -> None:
        self.course = course
        self.relief = relief
        self.edge = edge
        self.corners = corners
        ends = np.array(rects, float).reshape(-1, 5)
        squares = np.array(
            [
                (c.s, c.s + c.along * c.radius, c.t, c.t + c.across * c.radius)
                for c in corners
            ]
        ).reshape(-1, 4)
        edges = np.concatenate([ends[:, :4], squares])
        self._s = _lines(edges[:, :2].ravel(), (reach[0], reach[1]), fine)
        self._t = _lines(edges[:, 2:].ravel(), (reach[2], reach[3]), (-15.0, 15.0))
        self._kinds = np.zeros((len(self._s) - 1, len(self._t) - 1), np.int32)
        first = [
            np.searchsorted(line, ends[:, i] - 0.011)
            for line, i in ((self._s, 0), (self._t, 2))
        ]
        last = [
            np.searchsorted(line, ends[:, i] - 0.011)
            for line, i in ((self._s, 1), (self._t, 3))
        ]
        for s0, s1, t0, t1, kind in zip(
            first[0], last[0], first[1], last[1], ends[:, 4], strict=True
        ):
            self._kinds[s0:s1, t0:t1] = int(kind)

    def kind(self, s: ArrayLike, t: ArrayLike) -> NDArray[np.int32]:
        """Index in ``NAMES`` of the ground at street coordinates (rounded corners count as
        square)."""
        i = np.clip(np.searchsorted(self._s, s, "right") - 1, 0, len(self._s) - 2)
        j = np.clip(np.searchsorted(self._t, t, "right") - 1, 0, len(self._t) - 2)
        return np.asarray(self._kinds[i, j])

    def height(
        self, s: ArrayLike, t: ArrayLike, kind: ArrayLike | None = None
    ) -> Array:
        """Height at street coordinates, metres: of the ground there, or of the given kind of ground
        instead."""
        lift = _LIFT[self.kind(s, t) if kind is None else np.asarray(kind)]
        s = np.asarray(s, float)
        t = np.asarray(t, float)
        half = np.where(t > 0, self.edge[1], self.edge[0])
        return np.asarray(
            self.relief(s, t) - 0.018 * np.minimum(np.abs(t), half) + lift
        )

    def points(
        self, s: ArrayLike, t: ArrayLike, kind: ArrayLike | None = None
    ) -> Array:
        """(..., 3) world coordinates of the ground's surface at street coordinates, metres."""
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        return np.concatenate(
            [self.course.points(s, t), self.height(s, t, kind)[..., None]], -1
        )

    def mesh(self, rng: np.random.Generator) -> Mesh:
        """All ground as triangles, with indices in ``NAMES`` as slots; ``rng`` roughens unpaved
        ground."""
        bare = self.points(self._s[:, None], self._t[None], 0) - (0, 0, _LIFT[0])
        rough = np.ones(bare.shape[:2], bool)
        soft = np.isin(self._kinds, _ROUGH)
        picks = [
            np.s_[i : len(self._s) - 1 + i, j : len(self._t) - 1 + j]
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        for pick in picks:
            rough[pick] &= soft
        rough[[0, -1]] = rough[:, [0, -1]] = False
        bare[..., 2] += np.where(rough, rng.normal(0, 0.035, rough.shape), 0)
        cells = np.stack([bare[pick] for pick in picks], 2)
        cells[..., 2] += _LIFT[self._kinds][..., None]
        middle = np.meshgrid(
            (self._s[:-1] + self._s[1:]) / 2,
            (self._t[:-1] + self._t[1:]) / 2,
            indexing="ij",
        )
        hole = np.zeros(self._kinds.shape, bool)
        for c in self.corners:
            half = c.radius / 2
            hole |= (abs(middle[0] - c.s - c.along * half) < half) & (
                abs(middle[1] - c.t - c.across * half) < half
            )
        solid = quads(cells[~hole], self._kinds[~hole])
        steps = [_steps(cells, self._kinds, hole, axis) for axis in (0, 1)]
        return merge([solid, *steps, *(self._rounded(c) for c in self.corners)])

    def _rounded(self, c: Corner) -> Mesh:
        """The square cell of a rounded corner: carriageway outside the arc, kerb and pavement
        inside."""
        angle = np.linspace(0, np.pi / 2, 7)
        centre = np.array((c.s + c.along * c.radius, c.t + c.across * c.radius))
        way = -np.stack([c.along * np.cos(angle), c.across * np.sin(angle)], -1)
        arc = centre + c.radius * way
        inner = centre + (c.radius - 0.13) * way
        point = np.broadcast_to((c.s, c.t), arc.shape)
        middle = np.broadcast_to(centre, arc.shape)
        road, kerb, pavement = (NAMES.index(k) for k in ("road", "kerb", "sidewalk"))

        def sheet(a: Array, b: Array, low: int, slot: int) -> Mesh:
            ends = (
                self.points(a[:, 0], a[:, 1], low),
                self.points(b[:, 0], b[:, 1], slot),
            )
            return quads(
                np.stack([ends[0][:-1], ends[0][1:], ends[1][1:], ends[1][:-1]], 1),
                slot,
            )

        return merge(
            [
                sheet(point, arc, road, road),
                sheet(arc, arc, road, kerb),
                sheet(arc, inner, kerb, kerb),
                sheet(inner, middle, kerb, pavement),
            ]
        )


def _lines(
    edges: Array, reach: tuple[float, float], fine: tuple[float, float]
) -> Array:
    """Grid lines along one axis: all edges, and lines between them at most 3 m apart, wider outside
    ``fine``."""
    edges = np.unique(
        np.round(np.r_[edges[(edges > reach[0]) & (edges < reach[1])], reach], 3)
    )
    edges = edges[np.r_[True, np.diff(edges) > 0.02]]
    lines = [edges[:1]]
    for a, b in pairwise(edges):
        outside = max(0.0, fine[0] - (a + b) / 2, (a + b) / 2 - fine[1])
        lines.append(
            np.linspace(a, b, max(1, int(np.ceil((b - a) / (3 + 0.3 * outside)))) + 1)[
                1:
            ]
        )
    return np.concatenate(lines)


def _steps(
    cells: Array, kinds: NDArray[np.int32], hole: NDArray[np.bool_], axis: int
) -> Mesh:
    """Vertical faces between neighbouring cells of different height along an axis."""
    before, after = (
        (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
    )
    a, b = (
        (cells[before][:, :, [1, 2]], cells[after][:, :, [0, 3]])
        if axis == 0
        else (cells[before][:, :, [3, 2]], cells[after][:, :, [0, 1]])
    )
    apart = (np.abs(a[..., 2] - b[..., 2]).max(-1) > 0.004) & ~(
        hole[before] & hole[after]
    )
    faces = np.stack([a[:, :, 0], a[:, :, 1], b[:, :, 1], b[:, :, 0]], 2)[apart]
    upper = np.where(
        a[..., 2].mean(-1) > b[..., 2].mean(-1), kinds[before], kinds[after]
    )[apart]
    return quads(faces, upper)
