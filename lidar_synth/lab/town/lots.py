"""The plan of the lots along a street: houses, driveways and front boundaries.

Lots are sampled before the ground is built, because driveways and yards are painted on it;
``yards`` then builds them.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidar_synth.lab.town.boundaries import sample_kind
from lidar_synth.lab.town.facades import BuildingPlan
from lidar_synth.lab.town.paving import PLAZA_DEPTH, Paint
from lidar_synth.lab.town.street import LEFT, RIGHT, Street

Rng = np.random.Generator


@dataclass(frozen=True)
class Lot:
    """A lot beside the street.

    Args:
        start, end: its interval of s, metres, start < end.
        side: RIGHT or LEFT.
        front: |t| of its front boundary, metres.
        setback: metres from the front boundary to the house.
        plan: the plan of its house, or None for an empty lot.
        house_offset: metres along s from ``start`` to the house.
        driveway: (start, end) of a paved strip along s, metres, or None.
        boundary: the kind of its front boundary, one of ``boundaries.KINDS``.
        garden: density of its plants, 0..1.
    """

    start: float
    end: float
    side: int
    front: float
    setback: float
    plan: BuildingPlan | None
    house_offset: float
    driveway: tuple[float, float] | None
    boundary: str
    garden: float

    @property
    def sign(self) -> int:
        """The sign of t on this side of the street."""
        return 2 * self.side - 1


def sample_house(style: str, width: float, depth: float, rng: Rng) -> BuildingPlan:
    """The sampled plan of a house, row, block, shop or hall of the given width and depth in
    metres."""
    match style:
        case "house":
            roof = str(rng.choice(["gable", "cross", "hip"], p=[0.6, 0.25, 0.15]))
            floors = int(rng.choice([1, 2, 3], p=[0.3, 0.55, 0.15]))
            return BuildingPlan(
                width,
                depth,
                floors,
                rng.uniform(2.6, 2.9),
                rng.uniform(0.2, 1.1),
                roof,
                rng.random() < 0.15,
            )
        case "row":
            return BuildingPlan(
                width,
                depth,
                int(rng.integers(2, 4)),
                rng.uniform(2.7, 3.0),
                rng.uniform(0.2, 0.8),
            )
        case "block":
            roof = str(rng.choice(["gable", "hip", "flat"]))
            return BuildingPlan(
                width,
                depth,
                int(rng.integers(3, 6)),
                2.8,
                rng.uniform(0.5, 1.2),
                roof,
                rng.random() < 0.6,
            )
        case "shop":
            roof = str(rng.choice(["gable", "hip", "flat"]))
            return BuildingPlan(
                width,
                depth,
                int(rng.integers(2, 5)),
                3.1,
                0.15,
                roof,
                rng.random() < 0.2,
                shop=True,
            )
    return BuildingPlan(width, depth, 1, rng.uniform(4, 7), 0.2, "flat")


_SIZES = {
    "house": (8.5, 13.5),
    "row": (6.0, 8.5),
    "block": (15.0, 26.0),
    "shop": (10.0, 18.0),
    "hall": (18.0, 34.0),
}


def _style(street: Street, side: int, rng: Rng) -> str:
    """The sampled style of a building: house, row, block, shop or hall."""
    if street.kind == "residential":
        return str(rng.choice(["house", "row", "block"], p=[0.74, 0.14, 0.12]))
    if street.kind == "edge":
        return str(rng.choice(["house", "hall"], p=[0.6, 0.4]))
    if street.plaza == side:
        return "shop"
    return str(
        rng.choice(
            ["house", "row", "block", "shop", "hall"], p=[0.25, 0.12, 0.28, 0.27, 0.08]
        )
    )


def sample_lots(street: Street, rng: Rng) -> list[Lot]:
    """Sampled lots on both sides, from one end of the stretch to the other."""
    lots = []
    for side in (RIGHT, LEFT):
        front = street.front(side)
        boundary = sample_kind(rng)
        setback = (
            rng.uniform(2.0, 8.0)
            if street.kind in ("residential", "edge")
            else rng.uniform(0.0, 6.0)
        )
        for low, high in street.gaps(side, 1.0):
            s = low
            while high - s > 7:
                on_plaza = (
                    street.plaza == side and s + 9 > -12 and s < street.length + 12
                )
                lot = _sample_lot(
                    street,
                    side,
                    s,
                    high,
                    front + (PLAZA_DEPTH if on_plaza else 0.0),
                    setback,
                    boundary,
                    rng,
                )
                lots.append(lot)
                s = lot.end
    return lots


def _sample_lot(
    street: Street,
    side: int,
    s: float,
    high: float,
    front: float,
    setback: float,
    boundary: str,
    rng: Rng,
) -> Lot:
    """A sampled lot that starts at s and ends at ``high`` at the latest."""
    style = _style(street, side, rng)
    low, top = _SIZES[style]
    if rng.random() < (0.72 if street.kind == "edge" else 0.07) or high - s < low + 2:
        return Lot(
            s,
            min(high, s + rng.uniform(10, 26)),
            side,
            front,
            setback,
            None,
            0.0,
            None,
            boundary,
            rng.uniform(0.4, 1.0),
        )
    width = min(rng.uniform(low, top), high - s - 1.5)
    between = (
        0.0
        if style in ("row", "shop") and rng.random() < 0.8
        else rng.uniform(3.2, 9.0)
    )
    end = min(high, s + width + between)
    back = 0.3 if style == "shop" else max(0.3, setback + rng.uniform(-1.5, 1.5))
    first = bool(rng.random() < 0.5)
    at = between * 0.85 if first and between else 0.15 * between
    room = (s, s + at) if first else (s + at + width, end)
    driveway = None
    if room[1] - room[0] > 3.0 and rng.random() < 0.7:
        middle = (room[0] + room[1]) / 2
        driveway = (middle - 1.4, middle + 1.4)
    if rng.random() < 0.25 and style not in ("shop", "row"):
        boundary = sample_kind(rng)
    near = -45 < s + width / 2 < street.length + 50
    plan = replace(sample_house(style, width, rng.uniform(8, 12), rng), detail=near)
    return Lot(
        s,
        end,
        side,
        front,
        back,
        plan,
        min(at, end - s - width),
        driveway,
        "none" if back < 1.2 else boundary,
        rng.uniform(0, 1),
    )


def paint_lots(lots: list[Lot], paint: Paint, rng: Rng) -> None:
    """Paint driveways, yards and flower beds onto the ground."""
    for lot in lots:
        if lot.plan is not None and lot.garden < 0.25:
            paint(
                (lot.start, lot.end),
                (lot.sign * lot.front, lot.sign * (lot.front + lot.setback)),
                "yard",
            )
        elif lot.plan is not None and rng.random() < 0.3:
            paint(
                (lot.start + 1, lot.end - 1),
                (lot.sign * lot.front, lot.sign * (lot.front + 0.4 * lot.setback)),
                "soil",
            )
        if lot.driveway:
            paint(
                lot.driveway,
                (lot.sign * lot.front, lot.sign * (lot.front + lot.setback + 9)),
                "driveway",
            )
