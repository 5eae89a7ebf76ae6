"""Prototypes of cars, vans, lorries, buses, trams and trailers."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from lidar_synth.lab.town.bodywork import (
    GLASS,
    HEAD,
    INTERIOR,
    PAINT,
    PLATE,
    SECONDARY,
    TAIL,
    TRIM,
    face,
    shell,
    wheels,
)
from lidar_synth.lab.town.catalogue import TABLES
from lidar_synth.lab.town.materials import read_finishes
from lidar_synth.lab.town.meshes import Mesh, boxes, merge
from lidar_synth.lab.town.objects import Prototype, assemble

_FINISHES = {kind: read_finishes(rows) for kind, rows in TABLES["finishes"].items()}
FINISHES = _FINISHES["vehicle"]


@dataclass(frozen=True)
class CarShape:
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


def _stations(s: CarShape) -> list[list[float]]:
    """The cross-sections of a car or van, front to rear."""
    nose = 0.66 * s.belt + 0.08
    bend = s.belt - 0.05
    stations = [
        [0.000, 0.28, nose - 0.16, nose - 0.09, 0.76, 0.92],
        [0.025, 0.21, nose, nose + 0.07, 0.91, 0.93],
        [0.45 * s.cowl, 0.19, bend - 0.12, bend - 0.04, 0.985, 0.90],
        [s.cowl, 0.19, bend, s.belt + 0.02, 1.0, 0.88, PAINT, GLASS],
        [s.screen, 0.19, s.belt, s.height - 0.02, 1.0, s.roof, GLASS],
    ]
    for p in s.pillars:
        glass = PAINT if p + 0.011 >= s.panel_from else GLASS
        window = [0.19, s.belt + 0.01, s.height, 1.0, s.roof]
        stations += [[p - 0.011, *window], [p + 0.011, *window, glass]]
    return stations + _rear_stations(s)


def _rear_stations(s: CarShape) -> list[list[float]]:
    """The cross-sections behind the last side window."""
    side = PAINT if s.boot else GLASS
    above = PAINT if s.panel_from < 1 else GLASS
    end = [s.roof_end, 0.21, s.belt + 0.03, s.height - 0.05, 0.985, s.roof, side, above]
    bumper = [1.0, 0.30, 0.70, 0.78, 0.90, 0.93]
    if not s.boot:
        return [end, [s.tail, 0.23, s.belt + 0.02, s.belt + 0.10, 0.97, 0.93], bumper]
    lid = [
        [s.tail, 0.22, s.belt + 0.02, s.boot, 0.98, 0.90],
        [0.985, 0.24, 0.92 * s.belt, s.boot - 0.02, 0.92, 0.90],
    ]
    return [end, *lid, bumper]


def _seats(s: CarShape) -> Mesh:
    """Seats and floor, which rays through the windows hit."""
    half = 0.40 * s.width
    low = []
    high = []
    for row in (s.screen + 0.10, min(s.screen + 0.33, s.roof_end - 0.1)):
        x = 0.5 * s.length - s.length * row
        low.append((x - 0.12, -half, 0.4))
        high.append((x + 0.10, half, s.belt + 0.15))
    low.append((-0.38 * s.length, -0.42 * s.width, 0.30))
    high.append((0.22 * s.length, 0.42 * s.width, 0.45))
    return boxes(low, high, INTERIOR)


def _car(**measures: Any) -> Mesh:
    s = CarShape(**measures)
    radius = 0.31 if s.height < 1.65 else 0.34
    front = s.length / 2
    axle = front - 0.19 * s.length
    return merge(
        [
            shell(_stations(s), s.length, s.width, lit=True),
            wheels([axle, -axle], radius, s.width),
            face(
                front + 0.006,
                0.32,
                0.36,
                0.30,
                (TRIM, PLATE),
                0.36,
            ),
            face(
                -front - 0.006,
                0.36,
                0.40,
                0.30,
                (TRIM, PLATE),
                0.50,
            ),
            _seats(s),
        ]
    )


def _lorry(length: float, load: Mesh) -> Mesh:
    """A lorry: a cab, and behind it a load on a frame."""
    front = length / 2
    return merge(
        [
            assemble("lorry_cab").moved((front - 0.95, 0, 0)),
            load,
            boxes([(-front + 0.1, -0.45, 0.6)], [(front - 0.3, 0.45, 0.95)], TRIM),
            wheels([front - 1.1, -front + 1.4], 0.46, 2.29, arch=False),
            face(
                front + 0.005,
                0.6,
                0.75,
                2.0,
                (HEAD, PLATE),
                0.5,
            ),
            face(
                -front - 0.005,
                0.8,
                0.92,
                2.2,
                (TAIL, PLATE),
                0.65,
            ),
        ]
    )


def _box_lorry(length: float, height: float) -> Mesh:
    front = length / 2
    box = boxes([(-front, -1.175, 0.95)], [(front - 2.02, 1.175, height)], SECONDARY)
    return _lorry(length, box)


def _make_coach_stations(low: float, height: float) -> list[list[float]]:
    """The cross-sections of a bus or a tram, front to rear."""
    stations: list[list[float]] = [
        [0.0, low, 1.0, height - 0.5, 0.93, 0.9, PAINT, GLASS],
        [0.012, low, 1.0, height - 0.08, 0.99, 0.92, GLASS],
    ]
    for p in np.arange(0.1, 0.96, 0.1):
        window = [low, 1.0, height, 1.0, 0.93]
        stations += [[p, *window], [p + 0.012, *window, GLASS]]
    return [
        *stations,
        [0.985, low, 1.0, height - 0.08, 1.0, 0.92, PAINT, GLASS],
        [1.0, low, 1.0, height - 0.4, 0.97, 0.9],
    ]


def _coach(
    length: float,
    width: float,
    height: float,
    low: float,
    tyres: Mesh,
) -> Mesh:
    """A bus or a tram: one long body with a band of windows; ``low`` is the height of its sill."""
    front = length / 2 + 0.006
    lights = width * 0.9
    return merge(
        [
            shell(_make_coach_stations(low, height), length, width),
            tyres,
            face(
                front,
                low + 0.2,
                low + 0.4,
                lights,
                (HEAD, PLATE),
                low + 0.1,
            ),
            face(
                -front,
                low + 0.4,
                low + 0.7,
                lights,
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


@cache
def vehicles() -> dict[str, Prototype]:
    """The prototypes of all vehicles without a rider, by kind."""
    bus = wheels([3.658, -2.36], 0.48, 2.55)
    tram = wheels([9.36, 7.02, -7.8], 0.36, 2.4, arch=False)
    meshes = {kind: _car(**measures) for kind, measures in TABLES["cars"].items()}
    meshes |= {
        "box_lorry": _box_lorry(7.2, 3.3),
        "small_lorry": _box_lorry(5.9, 2.9),
        "flatbed": _lorry(6.6, assemble("flatbed")),
        "bus": _coach(11.8, 2.55, 3.05, 0.35, bus),
        "tram": _coach(26.0, 2.4, 3.5, 0.30, tram),
    }
    kinds = {}
    for kind, (name, still, moving) in TABLES["vehicles"].items():
        mesh = meshes[kind] if kind in meshes else assemble(kind)
        finishes = _FINISHES.get(kind, FINISHES)
        kinds[kind] = Prototype(mesh, finishes, name, (still, moving))
    return kinds
