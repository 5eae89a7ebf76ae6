"""The kinds of ground of a street: verges, pavements, parking bays, carriageways, markings,
crossings."""

from dataclasses import dataclass, field

import numpy as np

from lidar_synth.lab.town.ground import NAMES, Corner, Rect
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, SideStreet, Street

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


def pave(street: Street, rng: np.random.Generator) -> Paint:
    """Paint all ground of a street except its lots, from the pavements inwards to the markings."""
    paint = Paint((-BEYOND, street.length + BEYOND, -BEYOND, BEYOND))
    full_length = paint.reach[:2]
    asphalt = "road" if rng.random() < 0.7 else "old_road"
    for side, sign in ((RIGHT, -1), (LEFT, 1)):
        front = street.front(side)
        if street.kind == "edge" and rng.random() < 0.6:
            paint(
                full_length,
                (sign * (front + rng.uniform(2, 8)), sign * BEYOND),
                "field",
            )
        if street.plaza == side:
            paint(
                (-12, street.length + 12),
                (sign * front, sign * (front + PLAZA_DEPTH)),
                "plaza",
            )
        at = front
        for band in reversed(street.bands[side]):
            at -= band.width
            paint(full_length, (sign * at, sign * (at + band.width)), band.kind)
            if band.kind == "sidewalk":
                paint(full_length, (sign * at, sign * (at + 0.13)), "kerb")
            if band.kind == "parking":
                for s in np.arange(-REACH, street.length + REACH, rng.uniform(18, 40)):
                    paint((s, s + 1.6), (sign * at, sign * (at + band.width)), "grass")
    for c in street.crossings:
        _pavements(street, c, paint)
    paint(full_length, (-street.edge[RIGHT], street.edge[LEFT]), asphalt)
    if street.median:
        inner = street.median - 0.15
        paint(full_length, (-inner, inner), str(rng.choice(["grass", "rails", "kerb"])))
    if street.marked:
        _markings(street, paint)
    for c in street.crossings:
        _carriageway(street, c, asphalt, paint)
    return paint


def _pavements(street: Street, c: SideStreet, paint: Paint) -> None:
    """Paint the pavements and kerbs of a side street."""
    if not c.pavement:
        return
    for side in c.sides:
        sign = 2 * side - 1
        edge = street.edge[side]
        out = c.half + c.pavement
        paint((c.s - out, c.s + out), (sign * edge, sign * BEYOND), "sidewalk")
        for direction in (-1, 1):
            paint(
                (c.s + direction * c.half, c.s + direction * (c.half + 0.13)),
                (sign * edge, sign * BEYOND),
                "kerb",
            )
            paint(
                (c.s, c.s + direction * out),
                (sign * edge, sign * (edge + 0.13)),
                "kerb",
            )
            paint.corners.append(
                Corner(
                    c.s + direction * c.half,
                    sign * edge,
                    direction,
                    sign,
                    min(c.pavement, 3.0),
                )
            )


def _carriageway(street: Street, c: SideStreet, asphalt: str, paint: Paint) -> None:
    """Paint the asphalt of a side street, and on larger streets its lines, stop lines and zebra
    crossings."""
    low = -BEYOND if RIGHT in c.sides else -street.edge[RIGHT]
    high = BEYOND if LEFT in c.sides else street.edge[LEFT]
    if len(c.sides) == 1 and street.median:
        low, high = (low, -street.median) if RIGHT in c.sides else (street.median, high)
    paint((c.s - c.half, c.s + c.half), (low, high), asphalt)
    if street.kind == "junction" and street.median:
        # The median ends before the zebra crossings.
        paint(
            (c.s - c.half - 6.5, c.s + c.half + 6.5),
            (-street.median, street.median),
            asphalt,
        )
    if not street.marked or street.kind not in ("junction", "main", "square"):
        return
    for side in c.sides:
        sign = 2 * side - 1
        edge = street.edge[side]
        paint(
            (c.s, c.s - sign * c.half),
            (sign * (edge + 1.0), sign * (edge + 1.4)),
            "marking",
        )
        for t in np.arange(edge + 3, 60, 6.0):
            paint((c.s - 0.06, c.s + 0.06), (sign * t, sign * (t + 3)), "marking")
    if street.kind == "junction":
        for direction in (-1, 1):
            s = c.s + direction * (c.half + 1.8)
            for t in np.arange(-street.edge[RIGHT] + 0.4, street.edge[LEFT] - 0.5, 1.0):
                paint((s, s + direction * 3.0), (t, t + 0.5), "marking")
            lanes = (
                (-street.edge[RIGHT], -0.1)
                if direction < 0
                else (0.1, street.edge[LEFT])
            )
            paint((s + direction * 4.2, s + direction * 4.6), lanes, "marking")


def _markings(street: Street, paint: Paint) -> None:
    """Paint the lane markings of the street."""
    full_length = paint.reach[:2]
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
    if street.median:
        for sign in (-1, 1):
            paint(
                full_length,
                (sign * street.median, sign * (street.median + 0.12)),
                "marking",
            )
    if street.kind == "edge":
        for t in (-street.edge[RIGHT] + 0.2, street.edge[LEFT] - 0.32):
            paint(full_length, (t, t + 0.12), "marking")
    for side, sign in ((RIGHT, -1), (LEFT, 1)):
        if street.parking[side] == "street":
            paint(
                full_length,
                (sign * (street.edge[side] - 2.15), sign * (street.edge[side] - 2.05)),
                "marking",
            )
