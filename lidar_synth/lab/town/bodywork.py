"""Parts of vehicles: body shells, wheels, lights and number plates.

A body is lofted through cross-sections from the front bumper to the tail. Each cross-section is
given by its height and width at sill, belt line and roof; windows are glass panels above the belt
line.
"""

from typing import NamedTuple

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.meshes import Mesh, disc, loft, merge, quads, tube

PAINT, GLASS, TYRE, TRIM, PLATE, HEAD, TAIL, INTERIOR, RIM, SECONDARY = range(10)


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

    def outline(self, length: float, width: float) -> Float64Array:
        """(9, 3) its corners, from the right sill over the roof to the left one."""
        half = self.width * width / 2
        middle = self.sill + 0.55 * (self.belt - self.sill)
        drop = min(0.06, 0.5 * (self.top - self.belt))
        y = np.array([0.84 * half, half, 0.965 * half, self.roof * half])
        z = [self.sill, middle, self.belt, self.top - drop]
        flat = np.c_[np.r_[-y, 0, y[::-1]], [*z, self.top, *z[::-1]]]
        return np.insert(flat, 0, length * (0.5 - self.at), axis=1)

    def panels(self) -> list[int]:
        """(8,) slots of the panels from this cross-section to the next."""
        right = [PAINT, PAINT, self.side, self.above]
        return right + right[::-1]


def shell(
    stations: list[list[float]],
    length: float,
    width: float,
    lit: bool = False,
    at: float = 0.0,
) -> Mesh:
    """The closed surface of a body through its cross-sections.

    Args:
        stations: the cross-sections, front to rear, each the values of a ``Station``.
        length, width: metres.
        lit: whether the facets at the four corners of the body are its lights.
        at: metres, its middle along the vehicle.
    """
    sections = [Station(*row) for row in stations]  # type: ignore[arg-type]
    skin = np.array([s.outline(length, width) for s in sections])
    panels = np.array([s.panels() for s in sections[:-1]])
    if lit:
        panels[0, [1, 6]] = HEAD
        panels[-1, [1, 6]] = TAIL
    floor = loft(skin[:, [0, -1]], TRIM)
    whole = merge([loft(skin, panels), floor, _end(skin[0]), _end(skin[-1])])
    return whole.moved((at, 0, 0))


def _end(section: Float64Array) -> Mesh:
    """The flat front or rear of a body: quadrilaterals between the left and right half of a
    cross-section."""
    right = section[:5]
    left = section[::-1][:5]
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], 1)
    return quads(corners, np.array([TRIM, PAINT, PAINT, PAINT]))


def wheels(
    axles: list[float],
    radius: float,
    width: float,
    arch: bool = True,
) -> Mesh:
    """A pair of wheels at each x of ``axles`` (metres), with dark wheel arches if ``arch`` is
    set."""
    parts = []
    for x in axles:
        for side in (-1, 1):
            y = side * width / 2
            hub = [(x, y - side * 0.2, radius), (x, y + side * 0.008, radius)]
            parts.append(tube(hub, radius, 12, TYRE))
            outside = (x, y + side * 0.012, radius)
            parts.append(disc(outside, (0, 1, 0), 0.62 * radius, 10, RIM))
            if arch:
                parts.append(_arch(x, y + side * 0.003, radius))
    return merge(parts)


def _arch(x: float, y: float, radius: float) -> Mesh:
    """The dark arch above a wheel."""
    angle = np.linspace(0, np.pi, 8)
    across = x + 1.2 * radius * np.cos(angle)
    rim = np.c_[across, np.full(8, y), radius + 1.2 * radius * np.sin(angle)]
    return loft([rim * (1, 1, 0) + (0, 0, 0.18), rim], TRIM)


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
    corners = [
        [(x, a, bottom), (x, b, bottom), (x, b, top), (x, a, top)]
        for a, b, bottom, top in (
            (-0.46 * width, -0.30 * width, low, high),
            (0.46 * width, 0.30 * width, low, high),
            (-0.26, 0.26, plate, plate + 0.11),
        )
    ]
    return quads(corners, np.array(slots)[[0, 0, 1]])
