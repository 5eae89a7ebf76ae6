"""Parts of vehicles: body shells, wheels, lights and number plates, and their finishes.

A body is lofted through cross-sections from the front bumper to the tail. Each cross-section is
given by its height and width at sill, belt line and roof; windows are glass panels above the belt
line.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, disc, loft, merge, quads, tube

PAINT, GLASS, TYRE, TRIM, PLATE, HEAD, TAIL, INTERIOR, RIM, SECONDARY = range(10)


FINISHES = (
    Finish("paint"),
    Finish("carglass"),
    Finish("tyre"),
    Finish("plastic", (0.09, 0.09, 0.09)),
    Finish("plate"),
    Finish("lamp"),
    Finish("lamp", (0.55, 0.04, 0.04)),
    Finish("interior"),
    Finish("metal", (0.62, 0.62, 0.64)),
    Finish("metal", (0.75, 0.75, 0.74)),
)

PAINTS: tuple[RGB, ...] = (
    (0.75, 0.76, 0.78),
    (0.72, 0.73, 0.74),
    (0.86, 0.86, 0.86),
    (0.90, 0.90, 0.88),
    (0.05, 0.05, 0.055),
    (0.06, 0.06, 0.07),
    (0.03, 0.03, 0.03),
    (0.12, 0.13, 0.15),
    (0.33, 0.35, 0.37),
    (0.42, 0.43, 0.44),
    (0.07, 0.10, 0.25),
    (0.10, 0.18, 0.40),
    (0.48, 0.05, 0.05),
    (0.62, 0.09, 0.07),
    (0.09, 0.20, 0.13),
    (0.55, 0.50, 0.40),
    (0.70, 0.62, 0.20),
    (0.25, 0.17, 0.12),
)
"""Colours of vehicles; common ones appear in several shades."""


class Station(NamedTuple):
    """One cross-section of a body.

    Args:
        at: position along the body, 0 = front, 1 = rear.
        sill, belt, top: heights of the sill, the belt line and the roof, metres above the ground.
        width: width at the belt line as a share of the vehicle's width.
        roof: width at the top as a share of the vehicle's width.
        side, above: slots of the side windows and of the panels above them, from this cross-section
            to the next.
    """

    at: float
    sill: float
    belt: float
    top: float
    width: float
    roof: float
    side: int = PAINT
    above: int = PAINT


def shell(
    stations: list[Station], length: float, width: float, lit: bool = False
) -> Mesh:
    """The closed surface of a body through its cross-sections.

    Args:
        stations: the cross-sections, front to rear.
        length, width: metres.
        lit: whether the facets at the four corners of the body are its lights.
    """
    sections = []
    for s in stations:
        half = s.width * width / 2
        x = length * (0.5 - s.at)
        middle = s.sill + 0.55 * (s.belt - s.sill)
        drop = min(0.06, 0.5 * (s.top - s.belt))
        right = [
            (0.84 * half, s.sill),
            (half, middle),
            (0.965 * half, s.belt),
            (s.roof * half, s.top - drop),
        ]
        outline = [(-y, z) for y, z in right] + [(0.0, s.top)] + right[::-1]
        sections.append([(x, y, z) for y, z in outline])
    panels = np.array(
        [
            [PAINT, PAINT, s.side, s.above, s.above, s.side, PAINT, PAINT]
            for s in stations[:-1]
        ]
    )
    if lit:
        panels[0, [1, 6]] = HEAD
        panels[-1, [1, 6]] = TAIL
    skin = np.array(sections)
    floor = loft(skin[:, [0, -1]], TRIM)
    return merge([loft(skin, panels), floor, _end(skin[0]), _end(skin[-1])])


def _end(section: NDArray[np.float64]) -> Mesh:
    """The flat front or rear of a body: quadrilaterals between the left and right half of a
    cross-section."""
    right = section[:5]
    left = section[::-1][:5]
    return quads(
        np.stack([right[:-1], right[1:], left[1:], left[:-1]], 1),
        np.array([TRIM, PAINT, PAINT, PAINT]),
    )


def wheels(axles: list[float], radius: float, width: float, arch: bool = True) -> Mesh:
    """A pair of wheels at each x of ``axles`` (metres), with dark wheel arches if ``arch`` is
    set."""
    parts = []
    for x in axles:
        for side in (-1, 1):
            y = side * width / 2
            parts.append(
                tube(
                    [(x, y - side * 0.2, radius), (x, y + side * 0.008, radius)],
                    radius,
                    12,
                    TYRE,
                )
            )
            parts.append(
                disc((x, y + side * 0.012, radius), (0, 1, 0), 0.62 * radius, 10, RIM)
            )
            if arch:
                angle = np.linspace(0, np.pi, 8)
                rim = np.c_[
                    x + 1.2 * radius * np.cos(angle),
                    np.full(8, y + side * 0.003),
                    radius + 1.2 * radius * np.sin(angle),
                ]
                low = rim * (1, 1, 0) + (0, 0, 0.18)
                parts.append(loft([low, rim], TRIM))
    return merge(parts)


def face(
    x: float,
    low: float,
    high: float,
    width: float,
    slots: tuple[int, int],
    plate: float,
) -> Mesh:
    """Two lights and a number plate on the flat front or rear of a body.

    Args:
        x: metres, where along the vehicle.
        low, high: metres, lower and upper edge of the lights.
        width: metres, of the vehicle.
        slots: of the lights and of the number plate.
        plate: metres, lower edge of the number plate.
    """
    lights = [
        [
            (x, s * 0.46 * width, low),
            (x, s * 0.30 * width, low),
            (x, s * 0.30 * width, high),
            (x, s * 0.46 * width, high),
        ]
        for s in (-1, 1)
    ]
    plates = [
        [
            (x, -0.26, plate),
            (x, 0.26, plate),
            (x, 0.26, plate + 0.11),
            (x, -0.26, plate + 0.11),
        ]
    ]
    return quads([*lights, *plates], np.array([slots[0], slots[0], slots[1]]))
