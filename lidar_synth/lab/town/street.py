"""The plan of a stretch of road: widths of carriageway, pavements and parking bays, and the streets
that cross it.

There are five kinds: ``residential``, ``main`` (main road), ``junction``, ``square``, ``edge``
    (edge of town).
Traffic drives on the right: lanes at t < 0 run towards +s.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

KINDS = ("residential", "main", "junction", "square", "edge")
SHARES = (0.40, 0.15, 0.12, 0.08, 0.25)
"""Probability of each kind."""
REACH = 88.0
"""Metres of detailed world in front of, behind and beside the ego vehicle: slightly more than the
sensor's range."""
RIGHT = 0
LEFT = 1


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
        edge: metres from the centre line to the kerb, (right, left).
        bands: strips beyond the kerb, from the inside to the outside, (right, left).
        lanes: the lanes; the ego vehicle drives in the first.
        crossings: the side streets.
        parking: how cars park, (right, left): ``none``, ``street`` (inside the kerb), ``bay``,
            ``kerb`` (half on the pavement).
        speed: speed of the ego vehicle, m/s.
        median: half of the width of the strip between the two directions of traffic, metres; 0 =
            none.
        marked: whether lane markings are painted.
        plaza: the side with an open square (RIGHT or LEFT), or None.
        turn: (side street into which the ego vehicle turns, side to which it turns), or None.
        ends: lowest and highest s of the street, where it meets a cross street with houses behind
            it; infinite where the street continues.
    """

    kind: str
    length: float
    edge: tuple[float, float]
    bands: tuple[tuple[Band, ...], tuple[Band, ...]]
    lanes: tuple[Lane, ...]
    crossings: tuple[SideStreet, ...]
    parking: tuple[str, str]
    speed: float
    median: float = 0.0
    marked: bool = True
    plaza: int | None = None
    turn: tuple[SideStreet, int] | None = None
    ends: tuple[float, float] = (-np.inf, np.inf)

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


def _ends(kind: str, length: float, rng: np.random.Generator) -> tuple[float, float]:
    """Sampled ends of the street; infinite where it continues."""
    share = {"edge": 0.1, "main": 0.3}.get(kind, 0.6)
    back = -rng.uniform(30, 85) if rng.random() < share else -np.inf
    return back, length + rng.uniform(30, 85) if rng.random() < share else np.inf


def _crossings(
    kind: str, length: float, ends: tuple[float, float], rng: np.random.Generator
) -> tuple[SideStreet, ...]:
    """Sampled side streets: at closed ends, at a junction, and at random elsewhere."""
    places = [
        SideStreet(e - np.sign(e) * 6.0, 2.8, 1.6, (RIGHT, LEFT))
        for e in ends
        if np.isfinite(e)
    ]
    if kind == "junction":
        middle = length * rng.uniform(0.45, 0.75) + 5
        places = [p for p in places if abs(p.s - middle) > 30]
        return (
            *places,
            SideStreet(
                middle, rng.uniform(3.3, 6.8), rng.uniform(2, 3.2), (RIGHT, LEFT)
            ),
        )
    for s in np.arange(-70, length + 70, 14.0) + rng.uniform(0, 14):
        apart = all(abs(s - p.s) > 45 for p in places)
        if apart and rng.random() < (0.10 if kind == "edge" else 0.22):
            sides = ((RIGHT, LEFT), (RIGHT,), (LEFT,))[rng.integers(3)]
            places.append(
                SideStreet(
                    float(s),
                    rng.uniform(2.5, 3.4),
                    0.0 if kind == "edge" else rng.uniform(1.5, 2.2),
                    sides,
                )
            )
    return tuple(places)


def _residential(
    rng: np.random.Generator,
) -> tuple[list[list[Band]], list[float], list[str], list[Lane]]:
    """Sampled bands, kerbs, parking and lanes of a residential street."""
    parking = [
        str(rng.choice(["none", "street", "bay", "kerb"], p=[0.34, 0.30, 0.18, 0.18]))
        for _ in range(2)
    ]
    lane = rng.uniform(2.7, 3.5)
    edge = [lane + (2.0 if p == "street" else 0.0) for p in parking]
    bands = []
    for p in parking:
        side = [Band("parking", 2.1)] if p == "bay" else []
        if rng.random() < 0.3:
            side.append(Band("grass", rng.uniform(1.0, 3.5)))
        bands.append([*side, Band("sidewalk", rng.uniform(1.4, 2.4))])
    return bands, edge, parking, [Lane(-lane / 2, 1), Lane(lane / 2, -1)]


def _main(
    rng: np.random.Generator,
) -> tuple[list[list[Band]], list[float], list[str], list[Lane], float]:
    """Sampled bands, kerbs, parking, lanes and median of a main road."""
    each = int(rng.choice([1, 2], p=[0.6, 0.4]))
    width = rng.uniform(3.2, 3.9)
    median = float(rng.choice([0.0, rng.uniform(1.0, 3.6)], p=[0.6, 0.4]))
    lanes = [Lane(-(median + width * (i + 0.5)), 1) for i in range(each)]
    lanes += [Lane(median + width * (i + 0.5), -1) for i in range(each)]
    if each == 2 and rng.random() < 0.5:
        lanes[0], lanes[1] = lanes[1], lanes[0]
    parking = [
        str(rng.choice(["none", "bay", "street"], p=[0.4, 0.4, 0.2])) for _ in range(2)
    ]
    edge = [
        median + width * each + 0.2 + (2.2 if p == "street" else 0.0) for p in parking
    ]
    bands = []
    for p in parking:
        side = [Band("parking", 2.2)] if p == "bay" else []
        if rng.random() < 0.5:
            side.append(Band("grass", rng.uniform(1.5, 4.5)))
        if rng.random() < 0.4:
            side.append(Band("cycleway", 1.7))
        bands.append([*side, Band("sidewalk", rng.uniform(2.2, 3.6))])
    return bands, edge, parking, lanes, median


def _edge(
    rng: np.random.Generator,
) -> tuple[list[list[Band]], list[float], list[str], list[Lane]]:
    """Sampled bands, kerbs, parking and lanes of a road at the edge of town."""
    width = rng.uniform(3.1, 4.4)
    bands = []
    for _ in range(2):
        side = [Band("soil", rng.uniform(0.5, 1.2)), Band("grass", rng.uniform(1.5, 5))]
        if rng.random() < 0.3:
            side.append(Band("cycleway", 2.0))
        bands.append(side)
    return (
        bands,
        [width, width],
        ["none", "none"],
        [Lane(-width / 2, 1), Lane(width / 2, -1)],
    )


_TURNS = {"residential": 0.3, "main": 0.1, "junction": 0.4, "square": 0.25, "edge": 0.0}
"""Probability that the ego vehicle turns into a side street."""
_SPEEDS = {
    "residential": (6.5, 9.5),
    "main": (10.0, 14.5),
    "junction": (6.0, 11.0),
    "square": (5.0, 9.0),
    "edge": (12.0, 18.0),
}


def sample_street(kind: str, seconds: float, rng: np.random.Generator) -> Street:
    """The sampled plan of a street of a kind, long enough for the ego vehicle to drive
    ``seconds``."""
    turns = rng.random() < _TURNS[kind]
    speed = rng.uniform(4.5, 7.0) if turns else rng.uniform(*_SPEEDS[kind])
    length = speed * seconds
    median = 0.0
    marked = True
    plaza = None
    wide = kind == "main" or (kind in ("junction", "square") and rng.random() < 0.55)
    if wide:
        bands, edge, parking, lanes, median = _main(rng)
    elif kind == "edge":
        bands, edge, parking, lanes = _edge(rng)
    else:
        bands, edge, parking, lanes = _residential(rng)
        marked = rng.random() < 0.25
    ends = _ends(kind, length, rng)
    if kind == "square":
        plaza = int(rng.integers(2))
    crossings = _crossings(kind, length, ends, rng)
    exits = [(c, side) for c in crossings for side in c.sides if 12 < c.s < length - 10]
    if turns and not exits:
        added = SideStreet(
            0.4 * length + 4,
            rng.uniform(2.7, 3.4),
            rng.uniform(1.5, 2.2),
            (RIGHT, LEFT),
        )
        crossings = (*(c for c in crossings if abs(c.s - added.s) > 30), added)
        exits = [(added, RIGHT), (added, LEFT)]
    turn = exits[rng.integers(len(exits))] if turns and exits else None
    return Street(
        kind,
        length,
        (edge[0], edge[1]),
        (tuple(bands[0]), tuple(bands[1])),
        tuple(lanes),
        crossings,
        (parking[0], parking[1]),
        speed,
        median,
        marked,
        plaza,
        turn,
        ends,
    )
