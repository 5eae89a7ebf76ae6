"""The plan of a stretch of road: widths of carriageway, pavements and parking bays, and the streets
that cross it.

There are five kinds: ``residential``, ``main`` (main road), ``junction``, ``square``, ``edge``
(edge of town). Traffic drives on the right: lanes at t < 0 run towards +s.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lidar_synth.lab.town.catalogue import TABLES, Rng, pick, pick_name, sample_range

KINDS = tuple(TABLES["streets"])
SHARES = tuple(row["share"] for row in TABLES["streets"].values())
"""Probability of each kind."""
FASTEST = max(row["speed"][1] for row in TABLES["streets"].values())
"""Maximum speed of the ego vehicle, m/s."""
REACH = 88.0
"""Metres of detailed world in front of, behind and beside the ego vehicle: slightly more than the
sensor's range."""
RIGHT = -1
LEFT = 1
SIDES = (RIGHT, LEFT)
"""The sides of the street: the sign of t on each."""


class Band(NamedTuple):
    """A strip along one side of the street: its kind of ground and its width in metres."""

    kind: str
    width: float


class SideStreet(NamedTuple):
    """A street that crosses or meets the stretch.

    Args:
        s: s of its centre line, metres.
        half: half of its width between the kerbs, metres.
        pavement: width of its pavements, metres.
        sides: the sides of the stretch on which it continues: RIGHT, LEFT or both.
    """

    s: float
    half: float
    pavement: float
    sides: tuple[int, ...]


class Lane(NamedTuple):
    """A lane of moving traffic along s: t of its centre in metres, and its direction (+1 or -1)."""

    t: float
    direction: int


@dataclass(frozen=True)
class Street:
    """The plan of a stretch of road.

    Args:
        kind: one of ``KINDS``.
        length: metres that the ego vehicle drives, from s = 0.
        speed: speed of the ego vehicle, m/s.
        ends: lowest and highest s of the street, where it meets a cross street with houses behind
            it; infinite where the street continues.
        crossings: the side streets.
        marked: whether lane markings are painted.
        plaza: the side with an open square (RIGHT or LEFT), or None.
        edge: metres from the centre line to the kerb, by side.
        bands: strips beyond the kerb, from the inside to the outside, by side.
        lanes: the lanes; the ego vehicle drives in the first.
        parking: how cars park, by side: ``none``, ``street`` (inside the kerb), ``bay``, ``kerb``
            (half on the pavement).
        median: half of the width of the strip between the two directions of traffic, metres; 0 =
            none.
        turn: (side street into which the ego vehicle turns, side to which it turns), or None.
    """

    kind: str
    length: float
    speed: float
    ends: tuple[float, float]
    crossings: list[SideStreet]
    marked: bool
    plaza: int | None
    edge: dict[int, float]
    bands: dict[int, list[Band]]
    lanes: list[Lane]
    parking: dict[int, str]
    median: float = 0.0
    turn: tuple[SideStreet, int] | None = None

    @property
    def row(self) -> dict[str, Any]:
        """The line of its kind in the table of streets."""
        line: dict[str, Any] = TABLES["streets"][self.kind]
        return line

    def front(self, side: int) -> float:
        """|t| at which the lots of a side begin, metres."""
        return self.edge[side] + sum(b.width for b in self.bands[side])

    def band(self, side: int, kind: str) -> tuple[float, float] | None:
        """|t| at which the strip of a kind of ground on a side begins and ends, metres, or None."""
        at = self.edge[side]
        for b in self.bands[side]:
            if b.kind == kind:
                return at, at + b.width
            at += b.width
        return None

    def gaps(self, side: int, margin: float) -> list[tuple[float, float]]:
        """Intervals of s between the side streets of a side, within ``REACH`` and the ends of the
        street, metres."""
        low = max(-REACH, self.ends[0])
        high = min(self.length + REACH, self.ends[1])
        gaps = []
        for c in sorted(self.crossings):
            if side in c.sides:
                half = c.half + c.pavement + margin
                gaps.append((low, c.s - half))
                low = c.s + half
        return [(a, b) for a, b in [*gaps, (low, high)] if b - a > 2]


def _sample_ends(kind: str, length: float, rng: Rng) -> tuple[float, float]:
    """Sampled ends of the street; infinite where it continues."""
    share = {"edge": 0.1, "main": 0.3}.get(kind, 0.6)
    back, ahead = (
        rng.uniform(30, 85) if rng.random() < share else np.inf for _ in SIDES
    )
    return -back, length + ahead


def _sample_crossings(
    kind: str,
    length: float,
    ends: tuple[float, float],
    rng: Rng,
) -> list[SideStreet]:
    """Sampled side streets: at closed ends, at a junction, and at random elsewhere."""
    places = [
        SideStreet(e - np.sign(e) * 6.0, 2.8, 1.6, SIDES)
        for e in ends
        if np.isfinite(e)
    ]
    if kind == "junction":
        middle = length * rng.uniform(0.45, 0.75) + 5
        half = rng.uniform(3.3, 6.8)
        return _add_apart(places, SideStreet(middle, half, rng.uniform(2, 3.2), SIDES))
    share = 0.10 if kind == "edge" else 0.22
    for s in np.arange(-70, length + 70, 14.0) + rng.uniform(0, 14):
        if all(abs(s - p.s) > 45 for p in places) and rng.random() < share:
            places.append(_sample_side_street(kind, float(s), rng))
    return places


def _sample_side_street(kind: str, s: float, rng: Rng) -> SideStreet:
    sides = pick((SIDES, (RIGHT,), (LEFT,)), rng)
    half = rng.uniform(2.5, 3.4)
    pavement = 0.0 if kind == "edge" else rng.uniform(1.5, 2.2)
    return SideStreet(s, half, pavement, sides)


def _add_apart(places: list[SideStreet], new: SideStreet) -> list[SideStreet]:
    """The side streets that lie more than 30 m from a new one, and that one."""
    return [p for p in places if abs(p.s - new.s) > 30] + [new]


def _sample_bands(section: str, parking: dict[int, str], rng: Rng) -> dict[int, Any]:
    """Sampled strips beyond the kerb, by side."""
    bands = {}
    for side, how in parking.items():
        bay = Band("parking", 2.2 if section == "main" else 2.1)
        bands[side] = [bay] if how == "bay" else []
        for kind, share, width in TABLES["strips"][section]:
            if share == 1 or rng.random() < share:
                bands[side].append(Band(kind, sample_range(width, rng)))
    return bands


def _lay_lanes(each: int, width: float, median: float = 0.0) -> list[Lane]:
    """Lanes in both directions, ``each`` in one."""
    middles = [median + width * (i + 0.5) for i in range(each)]
    return [Lane(-t, 1) for t in middles] + [Lane(t, -1) for t in middles]


def _sample_residential(rng: Rng) -> dict[str, Any]:
    """The sampled cross-section of a residential street."""
    parking = {side: pick_name("parking_residential", rng) for side in SIDES}
    lane = rng.uniform(2.7, 3.5)
    return {
        "parking": parking,
        "lanes": _lay_lanes(1, lane),
        "edge": {
            side: lane + (2.0 if how == "street" else 0.0)
            for side, how in parking.items()
        },
        "bands": _sample_bands("residential", parking, rng),
    }


def _sample_main(rng: Rng) -> dict[str, Any]:
    """The sampled cross-section of a main road."""
    each = pick({1: 0.6, 2: 0.4}, rng)
    width = rng.uniform(3.2, 3.9)
    median = pick({0.0: 0.6, rng.uniform(1.0, 3.6): 0.4}, rng)
    lanes = _lay_lanes(each, width, median)
    if each == 2 and rng.random() < 0.5:
        lanes[:2] = lanes[1::-1]
    parking = {side: pick_name("parking_main", rng) for side in SIDES}
    kerb = median + width * each + 0.2
    return {
        "parking": parking,
        "lanes": lanes,
        "edge": {
            side: kerb + (2.2 if how == "street" else 0.0)
            for side, how in parking.items()
        },
        "bands": _sample_bands("main", parking, rng),
        "median": median,
    }


def _sample_edge(rng: Rng) -> dict[str, Any]:
    """The sampled cross-section of a road at the edge of town."""
    width = rng.uniform(3.1, 4.4)
    parking = dict.fromkeys(SIDES, "none")
    return {
        "parking": parking,
        "lanes": _lay_lanes(1, width),
        "edge": dict.fromkeys(SIDES, width),
        "bands": _sample_bands("edge", parking, rng),
    }


def sample_street(kind: str, seconds: float, rng: Rng) -> Street:
    """The sampled plan of a street of a kind, long enough for the ego vehicle to drive
    ``seconds``."""
    row = TABLES["streets"][kind]
    turns = rng.random() < row["turns"]
    speed = rng.uniform(*((4.5, 7.0) if turns else row["speed"]))
    length = speed * seconds
    marked = True
    if kind == "main" or (kind in ("junction", "square") and rng.random() < 0.55):
        section = _sample_main(rng)
    elif kind == "edge":
        section = _sample_edge(rng)
    else:
        section = _sample_residential(rng)
        marked = rng.random() < 0.25
    ends = _sample_ends(kind, length, rng)
    plaza = pick(SIDES, rng) if kind == "square" else None
    crossings = _sample_crossings(kind, length, ends, rng)
    street = Street(
        kind,
        length,
        speed,
        ends,
        crossings,
        marked,
        plaza,
        **section,
    )
    return _sample_turn(street, rng) if turns else street


def _sample_turn(street: Street, rng: Rng) -> Street:
    """The street with a side street into which the ego vehicle turns, which is added if there is
    none."""
    exits = [
        (c, side)
        for c in street.crossings
        for side in c.sides
        if 12 < c.s < street.length - 10
    ]
    crossings = street.crossings
    if not exits:
        half = rng.uniform(2.7, 3.4)
        pavement = rng.uniform(1.5, 2.2)
        added = SideStreet(0.4 * street.length + 4, half, pavement, SIDES)
        crossings = _add_apart(crossings, added)
        exits = [(added, side) for side in SIDES]
    return replace(street, crossings=crossings, turn=pick(exits, rng))
