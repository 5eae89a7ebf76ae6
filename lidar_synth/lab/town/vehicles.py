"""Prototypes of cars, vans, lorries, buses, trams and trailers."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lidar_synth.lab.town.bodywork import (
    FINISHES,
    GLASS,
    HEAD,
    INTERIOR,
    PAINT,
    PLATE,
    SECONDARY,
    TAIL,
    TRIM,
    Station,
    face,
    shell,
    wheels,
)
from lidar_synth.lab.town.cycles import bicycle_mesh, motorcycle_mesh
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, tubes
from lidar_synth.lab.town.prototype import Prototype


@dataclass(frozen=True)
class _CarShape:
    """Dimensions of a car or van.

    Args:
        length, width, height: metres.
        belt: height of the belt line, metres.
        cowl: lower edge of the windscreen, share of the length from the front.
        screen: upper edge of the windscreen, share of the length.
        roof_end: rear end of the roof, share of the length.
        tail: lower edge of the rear window, share of the length.
        boot: height of the boot lid, metres; 0 = none.
        pillars: positions of the pillars between side windows, shares of the length.
        panel_from: from here on the side is metal instead of glass, share of the length.
        roof: width of the roof as a share of ``width``.
    """

    length: float
    width: float
    height: float
    belt: float
    cowl: float
    screen: float
    roof_end: float
    tail: float
    boot: float = 0.0
    pillars: tuple[float, ...] = (0.56, 0.74)
    panel_from: float = 1.0
    roof: float = 0.78


_SHAPES = {
    "hatchback": _CarShape(3.95, 1.68, 1.46, 0.90, 0.25, 0.43, 0.88, 0.965),
    "compact": _CarShape(4.25, 1.76, 1.48, 0.92, 0.26, 0.44, 0.89, 0.97),
    "small": _CarShape(3.50, 1.60, 1.48, 0.90, 0.21, 0.40, 0.90, 0.97, pillars=(0.60,)),
    "sedan": _CarShape(4.65, 1.78, 1.44, 0.92, 0.29, 0.44, 0.70, 0.83, boot=1.03),
    "old_sedan": _CarShape(4.70, 1.72, 1.43, 0.90, 0.31, 0.43, 0.69, 0.79, boot=0.97),
    "estate": _CarShape(
        4.70, 1.78, 1.47, 0.92, 0.28, 0.43, 0.92, 0.975, pillars=(0.55, 0.70, 0.83)
    ),
    "suv": _CarShape(
        4.55, 1.84, 1.70, 1.06, 0.25, 0.41, 0.90, 0.97, pillars=(0.54, 0.71)
    ),
    "mpv": _CarShape(
        4.40, 1.78, 1.64, 0.98, 0.18, 0.40, 0.92, 0.975, pillars=(0.54, 0.72)
    ),
    "minivan": _CarShape(
        4.40,
        1.79,
        1.82,
        1.02,
        0.20,
        0.37,
        0.95,
        0.985,
        pillars=(0.53,),
        panel_from=0.60,
        roof=0.86,
    ),
    "van": _CarShape(
        4.85, 1.88, 1.95, 1.10, 0.13, 0.29, 0.96, 0.99, pillars=(0.43, 0.66), roof=0.87
    ),
    "panel_van": _CarShape(
        5.30,
        1.95,
        2.30,
        1.20,
        0.13,
        0.27,
        0.97,
        0.99,
        pillars=(0.40,),
        panel_from=0.41,
        roof=0.88,
    ),
}
VANS = ("minivan", "van", "panel_van")


def _stations(s: _CarShape) -> list[Station]:
    """The cross-sections of a car or van, front to rear."""
    nose = 0.66 * s.belt + 0.08
    bend = s.belt - 0.05
    stations = [
        Station(0.000, 0.28, nose - 0.16, nose - 0.09, 0.76, 0.92),
        Station(0.025, 0.21, nose, nose + 0.07, 0.91, 0.93),
        Station(0.45 * s.cowl, 0.19, bend - 0.12, bend - 0.04, 0.985, 0.90),
        Station(s.cowl, 0.19, bend, s.belt + 0.02, 1.0, 0.88, above=GLASS),
        Station(s.screen, 0.19, s.belt, s.height - 0.02, 1.0, s.roof, side=GLASS),
    ]
    for p in s.pillars:
        stations.append(Station(p - 0.011, 0.19, s.belt + 0.01, s.height, 1.0, s.roof))
        glass = PAINT if p + 0.011 >= s.panel_from else GLASS
        stations.append(
            Station(p + 0.011, 0.19, s.belt + 0.01, s.height, 1.0, s.roof, side=glass)
        )
    end = PAINT if s.boot else GLASS
    rear = PAINT if s.panel_from < 1 else GLASS
    stations.append(
        Station(
            s.roof_end,
            0.21,
            s.belt + 0.03,
            s.height - 0.05,
            0.985,
            s.roof,
            side=end,
            above=rear,
        )
    )
    if s.boot:
        stations.append(Station(s.tail, 0.22, s.belt + 0.02, s.boot, 0.98, 0.90))
        stations.append(Station(0.985, 0.24, 0.92 * s.belt, s.boot - 0.02, 0.92, 0.90))
    else:
        stations.append(Station(s.tail, 0.23, s.belt + 0.02, s.belt + 0.10, 0.97, 0.93))
    stations.append(Station(1.0, 0.30, 0.70, 0.78, 0.90, 0.93))
    return stations


def _seats(s: _CarShape) -> Mesh:
    """Seats and floor, which rays through the windows hit."""
    rows = [
        0.5 * s.length - s.length * f
        for f in (s.screen + 0.10, min(s.screen + 0.33, s.roof_end - 0.1))
    ]
    low = [(x - 0.12, -0.40 * s.width, 0.4) for x in rows] + [
        (-0.38 * s.length, -0.42 * s.width, 0.30)
    ]
    high = [(x + 0.10, 0.40 * s.width, s.belt + 0.15) for x in rows] + [
        (0.22 * s.length, 0.42 * s.width, 0.45)
    ]
    return boxes(low, high, INTERIOR)


def _car(kind: str) -> Mesh:
    s = _SHAPES[kind]
    radius = 0.31 if s.height < 1.65 else 0.34
    front = s.length / 2
    rear = -s.length / 2
    return merge(
        [
            shell(_stations(s), s.length, s.width, lit=True),
            wheels([front - 0.19 * s.length, rear + 0.19 * s.length], radius, s.width),
            face(front + 0.006, 0.32, 0.36, 0.30, (TRIM, PLATE), 0.36),
            face(rear - 0.006, 0.36, 0.40, 0.30, (TRIM, PLATE), 0.50),
            _seats(s),
        ]
    )


def _lorry(length: float, height: float, open_bed: bool) -> Mesh:
    """A lorry: a cab, and behind it a box or an open bed on a frame."""
    width = 2.35
    cab = 1.9
    front = length / 2
    cab_stations = [
        Station(0.00, 0.45, 1.25, 1.45, 0.94, 0.95, above=GLASS),
        Station(0.12, 0.40, 1.30, 2.45, 1.0, 0.90, side=GLASS),
        Station(0.70, 0.40, 1.30, 2.55, 1.0, 0.90),
        Station(1.00, 0.40, 1.30, 2.50, 1.0, 0.90),
    ]
    back = front - cab - 0.12
    bed = 1.05
    if open_bed:
        half = width / 2
        rim = bed + 0.5
        low = [
            (-front, -half, bed),
            (-front, -half, bed),
            (-front, half - 0.04, bed),
            (-front, -half, bed),
        ]
        high = [
            (back, half, bed + 0.08),
            (back, -half + 0.04, rim),
            (back, half, rim),
            (-front + 0.04, half, rim),
        ]
        load = [
            boxes(low, high, SECONDARY),
            boxes([(-front + 0.5, -0.8, bed)], [(back - 1.0, 0.7, bed + 0.8)], TRIM),
        ]
    else:
        load = [
            boxes(
                [(-front, -width / 2, bed - 0.1)],
                [(back, width / 2, height)],
                SECONDARY,
            )
        ]
    return merge(
        [
            shell(cab_stations, cab, width - 0.15).moved((front - cab / 2, 0, 0)),
            *load,
            boxes([(-front + 0.1, -0.45, 0.6)], [(front - 0.3, 0.45, 0.95)], TRIM),
            wheels([front - 1.1, -front + 1.4], 0.46, width - 0.06, arch=False),
            face(front + 0.005, 0.6, 0.75, 2.0, (HEAD, PLATE), 0.5),
            face(-front - 0.005, 0.8, 0.92, 2.2, (TAIL, PLATE), 0.65),
        ]
    )


def _coach(length: float, width: float, height: float, low: float, rails: bool) -> Mesh:
    """A bus or, with ``rails``, a tram: one long body with a band of windows; ``low`` is the height
    of its sill."""
    stations = [Station(0.0, low, 1.0, height - 0.5, 0.93, 0.9, above=GLASS)]
    stations.append(Station(0.012, low, 1.0, height - 0.08, 0.99, 0.92, side=GLASS))
    for p in np.arange(0.1, 0.96, 0.1):
        stations.append(Station(p, low, 1.0, height, 1.0, 0.93))
        stations.append(Station(p + 0.012, low, 1.0, height, 1.0, 0.93, side=GLASS))
    stations.append(Station(0.985, low, 1.0, height - 0.08, 1.0, 0.92, above=GLASS))
    stations.append(Station(1.0, low, 1.0, height - 0.4, 0.97, 0.9))
    axles = (
        [0.36 * length, 0.27 * length, -0.3 * length]
        if rails
        else [0.31 * length, -0.2 * length]
    )
    return merge(
        [
            shell(stations, length, width),
            wheels(axles, 0.36 if rails else 0.48, width, arch=not rails),
            face(
                length / 2 + 0.006,
                low + 0.2,
                low + 0.4,
                width * 0.9,
                (HEAD, PLATE),
                low + 0.1,
            ),
            face(
                -length / 2 - 0.006,
                low + 0.4,
                low + 0.7,
                width * 0.9,
                (TAIL, PLATE),
                low + 0.2,
            ),
            boxes(
                [(-0.45 * length, -0.4 * width, low + 0.1)],
                [(0.42 * length, 0.4 * width, 1.15)],
                INTERIOR,
            ),
        ]
    )


def _caravan() -> Mesh:
    stations = [
        Station(0.00, 0.50, 1.20, 1.90, 0.97, 0.95, above=GLASS),
        Station(0.06, 0.45, 1.25, 2.45, 1.00, 0.95),
        Station(0.25, 0.45, 1.25, 2.50, 1.00, 0.95, side=GLASS),
        Station(0.60, 0.45, 1.25, 2.50, 1.00, 0.95),
        Station(1.00, 0.50, 1.20, 2.35, 0.98, 0.95),
    ]
    body = shell(stations, 4.6, 2.1).moved((-0.4, 0, 0))
    return merge(
        [
            body,
            wheels([-0.5], 0.33, 2.1),
            tubes([([(2.0, 0, 0.45), (2.7, 0, 0.45)], 0.06)], 5, TRIM),
        ]
    )


def _trailer() -> Mesh:
    back = -1.4
    front = 1.2
    side = 0.75
    low = [
        (back, -side, 0.5),
        (back, -side, 0.5),
        (back, side - 0.04, 0.5),
        (front, -side, 0.5),
        (back, -side, 0.5),
    ]
    high = [
        (front, side, 0.56),
        (front, -side + 0.04, 0.9),
        (front, side, 0.9),
        (front + 0.04, side, 0.9),
        (back + 0.04, side, 0.9),
    ]
    bars = tubes(
        [([(front, y, 0.5), (2.2, 0, 0.45)], 0.04) for y in (-0.6, 0.6)], 4, TRIM
    )
    lights = face(back - 0.01, 0.4, 0.5, 1.4, (TAIL, PLATE), 0.38)
    return merge(
        [
            boxes(low, high, SECONDARY),
            bars,
            wheels([-0.1], 0.28, 1.75, arch=False),
            lights,
        ]
    )


@cache
def vehicles() -> dict[str, Prototype]:
    """The prototypes of all vehicles without a rider, by kind."""
    kinds = {
        k: Prototype(_car(k), FINISHES, "Van" if k in VANS else "Car", (10, 252))
        for k in _SHAPES
    }
    return kinds | {
        "box_lorry": Prototype(_lorry(7.2, 3.3, False), FINISHES, "Truck", (18, 258)),
        "small_lorry": Prototype(_lorry(5.9, 2.9, False), FINISHES, "Truck", (18, 258)),
        "flatbed": Prototype(_lorry(6.6, 2.5, True), FINISHES, "Truck", (18, 258)),
        "bus": Prototype(
            _coach(11.8, 2.55, 3.05, 0.35, False), FINISHES, "Misc", (13, 257)
        ),
        "tram": Prototype(
            _coach(26.0, 2.4, 3.5, 0.30, True), FINISHES, "Tram", (16, 256)
        ),
        "caravan": Prototype(_caravan(), FINISHES, "Misc", (20, 259)),
        "trailer": Prototype(_trailer(), FINISHES, "Misc", (20, 259)),
        "bicycle": Prototype(bicycle_mesh(), FINISHES, "", (11, 11)),
        "motorcycle": Prototype(motorcycle_mesh(), FINISHES, "", (15, 15)),
    }
