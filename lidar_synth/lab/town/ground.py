"""The ground: rectangles in street coordinates, then bent along the centre line and laid over the
hills.

In street coordinates every kerb, bay and driveway is a rectangle, so the ground is a grid of cells
whose lines are the rectangles' edges. The course bends this grid, and the relief lifts it. A
vertical face (a kerb) closes the gap where neighbouring cells differ in height.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.geometry.arrays import Float64Array, Int32Array
from lidar_synth.lab.town.catalogue import TABLES, Rng
from lidar_synth.lab.town.course import Course, Relief
from lidar_synth.lab.town.materials import Finish, read_finishes
from lidar_synth.lab.town.meshes import Mesh, merge, quads
from lidar_synth.lab.town.street import LEFT, RIGHT

Rect = tuple[float, float, float, float, int]


class GroundKind(NamedTuple):
    """One kind of ground: its finish, SemanticKITTI's class id, and its height above the
    carriageway, metres."""

    finish: Finish
    raw: int
    lift: float


KINDS = {
    name: GroundKind(read_finishes([row["finish"]])[0], row["raw"], row["lift"])
    for name, row in TABLES["ground"].items()
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
        edge: metres from the centre line to the kerb, by side; the carriageway slopes down towards
            the kerb.
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
        edge: Mapping[int, float],
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
        squares = [
            (c.s, c.s + c.along * c.radius, c.t, c.t + c.across * c.radius)
            for c in corners
        ]
        edges = np.concatenate([ends[:, :4], np.reshape(squares, (-1, 4))])
        self._s = _lines(edges[:, :2].ravel(), reach[:2], fine)
        self._t = _lines(edges[:, 2:].ravel(), reach[2:], (-15.0, 15.0))
        self._kinds = np.zeros((len(self._s) - 1, len(self._t) - 1), np.int32)
        along = np.searchsorted(self._s, ends[:, :2] - 0.011)
        across = np.searchsorted(self._t, ends[:, 2:4] - 0.011)
        for (s0, s1), (t0, t1), kind in zip(along, across, ends[:, 4], strict=True):
            self._kinds[s0:s1, t0:t1] = int(kind)

    def kind(self, s: ArrayLike, t: ArrayLike) -> Int32Array:
        """Index in ``NAMES`` of the ground at street coordinates (rounded corners count as
        square)."""
        return np.asarray(self._kinds[_below(self._s, s), _below(self._t, t)])

    def height(
        self, s: ArrayLike, t: ArrayLike, kind: ArrayLike | None = None
    ) -> Float64Array:
        """Height at street coordinates, metres: of the ground there, or of the given kind of ground
        instead."""
        lift = _LIFT[self.kind(s, t) if kind is None else np.asarray(kind)]
        half = np.where(np.asarray(t) > 0, self.edge[LEFT], self.edge[RIGHT])
        slope = 0.018 * np.minimum(np.abs(t), half)
        return np.asarray(self.relief(s, t) - slope + lift)

    def points(
        self, s: ArrayLike, t: ArrayLike, kind: ArrayLike | None = None
    ) -> Float64Array:
        """(..., 3) world coordinates of the ground's surface at street coordinates, metres."""
        s, t = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float))
        return np.concatenate(
            [self.course.points(s, t), self.height(s, t, kind)[..., None]], -1
        )

    def mesh(self, rng: Rng) -> Mesh:
        """All ground as triangles, with indices in ``NAMES`` as slots; ``rng`` roughens unpaved
        ground."""
        bare = self.points(self._s[:, None], self._t[None], 0) - (0, 0, _LIFT[0])
        rows, columns = self._kinds.shape
        picks = [
            np.s_[i : rows + i, j : columns + j]
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        bare[..., 2] += self._roughness(picks, rng)
        cells = np.stack([bare[pick] for pick in picks], 2)
        cells[..., 2] += _LIFT[self._kinds][..., None]
        hole = self._holes()
        return merge(
            [
                quads(cells[~hole], self._kinds[~hole]),
                *_steps(cells, self._kinds, hole),
                *(self._round(c) for c in self.corners),
            ]
        )

    def _roughness(self, picks: list[tuple[slice, slice]], rng: Rng) -> Float64Array:
        """Random heights of the grid's points that have unpaved ground on all sides, metres."""
        rough = np.zeros((len(self._s), len(self._t)), bool)
        rough[1:-1, 1:-1] = True
        soft = np.isin(self._kinds, _ROUGH)
        for pick in picks:
            rough[pick] &= soft
        return np.where(rough, rng.normal(0, 0.035, rough.shape), 0)

    def _holes(self) -> NDArray[np.bool_]:
        """Cells of rounded corners, which are built apart."""
        s, t = np.meshgrid(_middles(self._s), _middles(self._t), indexing="ij")
        hole = np.zeros(self._kinds.shape, bool)
        for c in self.corners:
            half = c.radius / 2
            along = abs(s - c.s - c.along * half) < half
            hole |= along & (abs(t - c.t - c.across * half) < half)
        return hole

    def _round(self, c: Corner) -> Mesh:
        """The square cell of a rounded corner: carriageway outside the arc, kerb and pavement
        inside."""
        angle = np.linspace(0, np.pi / 2, 7)
        point = np.array((c.s, c.t))
        sense = np.array((c.along, c.across))
        centre = point + c.radius * sense
        way = -sense * np.stack([np.cos(angle), np.sin(angle)], -1)
        arc = centre + c.radius * way
        inner = centre + (c.radius - 0.13) * way
        road, kerb, pavement = (NAMES.index(k) for k in ("road", "kerb", "sidewalk"))
        return merge(
            [
                self._sheet(np.broadcast_to(point, arc.shape), arc, road, road),
                self._sheet(arc, arc, road, kerb),
                self._sheet(arc, inner, kerb, kerb),
                self._sheet(inner, np.broadcast_to(centre, arc.shape), kerb, pavement),
            ]
        )

    def _sheet(
        self,
        outer: Float64Array,
        inner: Float64Array,
        low: int,
        kind: int,
    ) -> Mesh:
        """A strip of one kind of ground between two lines of street coordinates (P, 2); the outer
        one lies as high as the kind ``low``."""
        a = self.points(outer[:, 0], outer[:, 1], low)
        b = self.points(inner[:, 0], inner[:, 1], kind)
        return quads(np.stack([a[:-1], a[1:], b[1:], b[:-1]], 1), kind)


def _below(lines: Float64Array, values: ArrayLike) -> Int32Array:
    """Index of the last line that is not above each value, within the cells."""
    found = np.searchsorted(lines, values, "right") - 1
    return np.asarray(np.clip(found, 0, len(lines) - 2))


def _lines(
    edges: Float64Array, reach: tuple[float, float], fine: tuple[float, float]
) -> Float64Array:
    """Grid lines along one axis: all edges, and lines between them at most 3 m apart, wider outside
    ``fine``."""
    low, high = reach
    inside = edges[(edges > low) & (edges < high)]
    edges = np.unique(np.round(np.r_[inside, low, high], 3))
    edges = edges[np.r_[True, np.diff(edges) > 0.02]]
    lines = [edges[:1]]
    for a, b in pairwise(edges):
        middle = (a + b) / 2
        outside = max(0.0, fine[0] - middle, middle - fine[1])
        steps = max(1, int(np.ceil((b - a) / (3 + 0.3 * outside))))
        lines.append(np.linspace(a, b, steps + 1)[1:])
    return np.concatenate(lines)


def _middles(lines: Float64Array) -> Float64Array:
    return (lines[:-1] + lines[1:]) / 2


def _steps(
    cells: Float64Array, kinds: Int32Array, hole: NDArray[np.bool_]
) -> Iterator[Mesh]:
    """Vertical faces between neighbouring cells of different height, along each axis."""
    along = (np.s_[:-1, :], np.s_[1:, :], [1, 2], [0, 3])
    across = (np.s_[:, :-1], np.s_[:, 1:], [3, 2], [0, 1])
    for before, after, here, there in (along, across):
        a = cells[before][:, :, here]
        b = cells[after][:, :, there]
        apart = np.abs(a[..., 2] - b[..., 2]).max(-1) > 0.004
        apart &= ~(hole[before] & hole[after])
        faces = np.stack([a[:, :, 0], a[:, :, 1], b[:, :, 1], b[:, :, 0]], 2)
        above = a[..., 2].mean(-1) > b[..., 2].mean(-1)
        upper = np.where(above, kinds[before], kinds[after])
        yield quads(faces[apart], upper[apart])
