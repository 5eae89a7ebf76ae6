"""The kinds of ground of a street: verges, pavements, parking bays, carriageways, markings,
crossings."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lidar_synth.lab.town.catalogue import Rng, pick_name
from lidar_synth.lab.town.ground import NAMES, Corner, Rect
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, SIDES, SideStreet, Street

PLAZA_DEPTH = 34.0
"""Depth of an open square behind the pavement, metres."""
BEYOND = 260.0
"""Metres of ground around the driven part, so that the camera image has a horizon."""


@dataclass
class Paint:
    """Rectangles of ground; later ones cover earlier ones.

    Args:
        reach: (lowest s, highest s, lowest t, highest t) of all ground, metres.
        rects: the rectangles, see ``Ground``.
        corners: rounded corners of kerbs.
    """

    reach: tuple[float, float, float, float]
    rects: list[Rect] = field(default_factory=list)
    corners: list[Corner] = field(default_factory=list)

    def __call__(
        self, s: tuple[float, float], t: tuple[float, float], kind: str
    ) -> None:
        """Paint a rectangle with a kind of ground; ``s`` and ``t`` are its intervals in metres, in
        either order."""
        self.rects.append((min(s), max(s), min(t), max(t), NAMES.index(kind)))


def pave(street: Street, rng: Rng) -> Paint:
    """Paint all ground of a street except its lots, from the pavements inwards to the markings."""
    paint = Paint((-BEYOND, street.length + BEYOND, -BEYOND, BEYOND))
    full_length = paint.reach[:2]
    asphalt = "road" if rng.random() < 0.7 else "old_road"
    for side in SIDES:
        front = street.front(side)
        if street.kind == "edge" and rng.random() < 0.6:
            far = (side * (front + rng.uniform(2, 8)), side * BEYOND)
            paint(full_length, far, "field")
        if street.plaza == side:
            square = (side * front, side * (front + PLAZA_DEPTH))
            paint((-12, street.length + 12), square, "plaza")
        _paint_bands(street, side, paint, rng)
    for c in street.crossings:
        for side in c.sides if c.pavement else ():
            _paint_pavements(street, c, side, paint)
    paint(full_length, (-street.edge[RIGHT], street.edge[LEFT]), asphalt)
    if street.median:
        inner = street.median - 0.15
        paint(full_length, (-inner, inner), pick_name("medians", rng))
    if street.marked:
        _mark_lanes(street, paint)
    for c in street.crossings:
        _paint_carriageway(street, c, asphalt, paint)
        if street.marked and street.kind in ("junction", "main", "square"):
            for side in c.sides:
                _mark_side_street(street, c, side, paint)
            if street.kind == "junction":
                _mark_zebras(street, c, paint)
    return paint


def _paint_bands(
    street: Street,
    side: int,
    paint: Paint,
    rng: Rng,
) -> None:
    """Paint the strips of a side, their kerbs, and grass between parking bays."""
    full_length = paint.reach[:2]
    inner = street.front(side)
    for kind, width in reversed(street.bands[side]):
        inner -= width
        near = side * inner
        far = side * (inner + width)
        paint(full_length, (near, far), kind)
        if kind == "sidewalk":
            paint(full_length, (near, side * (inner + 0.13)), "kerb")
        if kind == "parking":
            for s in np.arange(-REACH, street.length + REACH, rng.uniform(18, 40)):
                paint((s, s + 1.6), (near, far), "grass")


def _paint_pavements(
    street: Street,
    c: SideStreet,
    side: int,
    paint: Paint,
) -> None:
    """Paint the pavements and kerbs of a side street on one side of the stretch."""
    edge = side * street.edge[side]
    beyond = (edge, side * BEYOND)
    inner = (edge, side * (street.edge[side] + 0.13))
    out = c.half + c.pavement
    paint((c.s - out, c.s + out), beyond, "sidewalk")
    for direction in (-1, 1):
        kerb = c.s + direction * c.half
        paint((kerb, c.s + direction * (c.half + 0.13)), beyond, "kerb")
        paint((c.s, c.s + direction * out), inner, "kerb")
        radius = min(c.pavement, 3.0)
        paint.corners.append(Corner(kerb, edge, direction, side, radius))


def _paint_carriageway(
    street: Street,
    c: SideStreet,
    asphalt: str,
    paint: Paint,
) -> None:
    """Paint the asphalt of a side street, which ends at a median unless it crosses."""
    low = -BEYOND if RIGHT in c.sides else -street.edge[RIGHT]
    high = BEYOND if LEFT in c.sides else street.edge[LEFT]
    if street.median and c.sides == (RIGHT,):
        high = -street.median
    elif street.median and c.sides == (LEFT,):
        low = street.median
    paint((c.s - c.half, c.s + c.half), (low, high), asphalt)
    if street.kind == "junction" and street.median:
        # The median ends before the zebra crossings.
        reach = c.half + 6.5
        median = (-street.median, street.median)
        paint((c.s - reach, c.s + reach), median, asphalt)


def _mark_side_street(
    street: Street,
    c: SideStreet,
    side: int,
    paint: Paint,
) -> None:
    """Paint the stop line and the middle line of a side street."""
    edge = street.edge[side]
    stop = (side * (edge + 1.0), side * (edge + 1.4))
    paint((c.s, c.s - side * c.half), stop, "marking")
    for t in np.arange(edge + 3, 60, 6.0):
        paint((c.s - 0.06, c.s + 0.06), (side * t, side * (t + 3)), "marking")


def _mark_zebras(street: Street, c: SideStreet, paint: Paint) -> None:
    """Paint the zebra crossings and the stop lines before a junction."""
    right = -street.edge[RIGHT]
    left = street.edge[LEFT]
    for direction, lanes in ((-1, (right, -0.1)), (1, (0.1, left))):
        s = c.s + direction * (c.half + 1.8)
        for t in np.arange(right + 0.4, left - 0.5, 1.0):
            paint((s, s + direction * 3.0), (t, t + 0.5), "marking")
        paint((s + direction * 4.2, s + direction * 4.6), lanes, "marking")


def _mark_lanes(street: Street, paint: Paint) -> None:
    """Paint the lane markings of the street."""
    dashes = {
        round((a.t + b.t) / 2, 3)
        for a in street.lanes
        for b in street.lanes
        if a.direction == b.direction and a.t < b.t
    }
    if not street.median:
        dashes.add(0.0)
    for s in np.arange(-REACH - 60, street.length + REACH + 60, 9.0):
        for t in dashes:
            paint((s, s + 3.0), (t - 0.06, t + 0.06), "marking")
    for line in _list_lines(street):
        paint(paint.reach[:2], line, "marking")


def _list_lines(street: Street) -> Iterator[tuple[float, float]]:
    """The intervals of t of the lines along the whole street."""
    if street.median:
        for side in SIDES:
            yield side * street.median, side * (street.median + 0.12)
    if street.kind == "edge":
        for t in (-street.edge[RIGHT] + 0.2, street.edge[LEFT] - 0.32):
            yield t, t + 0.12
    for side in SIDES:
        if street.parking[side] == "street":
            edge = street.edge[side]
            yield side * (edge - 2.15), side * (edge - 2.05)
