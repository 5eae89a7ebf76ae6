"""The plan of the lots along a street: houses, driveways and front boundaries.

Lots are sampled before the ground is built, because driveways and yards are painted on it;
``yards`` then builds them.
"""

from dataclasses import dataclass, replace

from lidar_synth.lab.town.catalogue import TABLES, Rng, pick, pick_name, sample_range
from lidar_synth.lab.town.facades import BuildingPlan
from lidar_synth.lab.town.paving import PLAZA_DEPTH, Paint
from lidar_synth.lab.town.street import SIDES, Street


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
        boundary: the kind of its front boundary, one of the choices of ``boundaries``.
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
    def house(self) -> tuple[float, float]:
        """The interval of s of its house, metres; empty without one."""
        low = self.start + self.house_offset
        return low, low + (self.plan.width if self.plan else 0.0)


def sample_house(
    style: str,
    width: float,
    depth: float,
    rng: Rng,
) -> BuildingPlan:
    """The sampled plan of a house, row, block, shop or hall of the given width and depth in
    metres."""
    row = TABLES["houses"][style]
    # The order of the draws: the roof of a row or hall is known.
    roof = pick(row["roofs"], rng)
    return BuildingPlan(
        width,
        depth,
        pick(row["floors"], rng),
        sample_range(row["storey"], rng),
        sample_range(row["plinth"], rng),
        roof,
        balconies="balconies" in row and rng.random() < row["balconies"],
        shop=style == "shop",
    )


def _sample_style(street: Street, side: int, rng: Rng) -> str:
    """The sampled style of a building: house, row, block, shop or hall."""
    if street.kind in ("residential", "edge"):
        return pick_name(f"houses_{street.kind}", rng)
    return "shop" if street.plaza == side else pick_name("houses", rng)


def sample_lots(street: Street, rng: Rng) -> list[Lot]:
    """Sampled lots on both sides, from one end of the stretch to the other."""
    lots = []
    for side in SIDES:
        front = street.front(side)
        boundary = pick_name("boundaries", rng)
        garden = street.kind in ("residential", "edge")
        setback = rng.uniform(*((2.0, 8.0) if garden else (0.0, 6.0)))
        for s, high in street.gaps(side, 1.0):
            while high - s > 7:
                on_plaza = street.plaza == side and -21 < s < street.length + 12
                lot = Lot(
                    s,
                    high,
                    side,
                    front + (PLAZA_DEPTH if on_plaza else 0.0),
                    setback,
                    None,
                    0.0,
                    None,
                    boundary,
                    0.0,
                )
                lots.append(_sample_lot(lot, street, rng))
                s = lots[-1].end
    return lots


def _sample_lot(lot: Lot, street: Street, rng: Rng) -> Lot:
    """The lot with a sampled length and, mostly, a house; it ends at its present end at the
    latest."""
    style = _sample_style(street, lot.side, rng)
    low, high = TABLES["houses"][style]["width"]
    room = lot.end - lot.start
    if rng.random() < (0.72 if street.kind == "edge" else 0.07) or room < low + 2:
        end = min(lot.end, lot.start + rng.uniform(10, 26))
        return replace(lot, end=end, garden=rng.uniform(0.4, 1.0))
    width = min(rng.uniform(low, high), room - 1.5)
    close = style in ("row", "shop") and rng.random() < 0.8
    between = 0.0 if close else rng.uniform(3.2, 9.0)
    end = min(lot.end, lot.start + width + between)
    setback = 0.3
    if style != "shop":
        setback = max(0.3, lot.setback + rng.uniform(-1.5, 1.5))
    first = rng.random() < 0.5
    offset = (0.85 if first else 0.15) * between
    driveway = _sample_driveway(
        lot.start,
        offset,
        width,
        end,
        first,
        rng,
    )
    boundary = lot.boundary
    if rng.random() < 0.25 and style not in ("shop", "row"):
        boundary = pick_name("boundaries", rng)
    near = -45 < lot.start + width / 2 < street.length + 50
    plan = sample_house(style, width, rng.uniform(8, 12), rng)
    return replace(
        lot,
        end=end,
        setback=setback,
        plan=replace(plan, detail=near),
        house_offset=min(offset, end - lot.start - width),
        driveway=driveway,
        boundary="none" if setback < 1.2 else boundary,
        garden=rng.uniform(0, 1),
    )


def _sample_driveway(
    start: float,
    offset: float,
    width: float,
    end: float,
    first: bool,
    rng: Rng,
) -> tuple[float, float] | None:
    """A driveway between a lot's start and its house or, unless ``first``, between the house and
    the lot's end; None where there is no room."""
    house = start + offset
    low, high = (start, house) if first else (house + width, end)
    if high - low <= 3.0 or rng.random() >= 0.7:
        return None
    middle = (low + high) / 2
    return middle - 1.4, middle + 1.4


def paint_lots(lots: list[Lot], paint: Paint, rng: Rng) -> None:
    """Paint driveways, yards and flower beds onto the ground."""
    for lot in lots:
        near = lot.side * lot.front
        house = lot.side * (lot.front + lot.setback)
        if lot.plan and lot.garden < 0.25:
            paint((lot.start, lot.end), (near, house), "yard")
        elif lot.plan and rng.random() < 0.3:
            bed = lot.side * (lot.front + 0.4 * lot.setback)
            paint((lot.start + 1, lot.end - 1), (near, bed), "soil")
        if lot.driveway:
            behind = lot.side * (lot.front + lot.setback + 9)
            paint(lot.driveway, (near, behind), "driveway")
