"""Traffic signs and traffic lights."""

import numpy as np

from lidar_synth.lab.town.furniture import GALVANISED, OTHER, POLE, SIGN, StaticObject
from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, boxes, disc, fan, merge, tube

RED = (0.72, 0.10, 0.09)
BLUE = (0.10, 0.25, 0.62)
WHITE = (0.92, 0.92, 0.92)
YELLOW = (0.93, 0.80, 0.15)
BLACK = (0.1, 0.1, 0.1)
Outline = list[tuple[float, float]]


def _rectangle(width: float, height: float, up: float = 0.0) -> Outline:
    y = width / 2
    z = height / 2
    return [(-y, up - z), (y, up - z), (y, up + z), (-y, up + z)]


def _regular(sides: int, radius: float) -> Outline:
    angle = 2 * np.pi * np.arange(sides) / sides
    return [(radius * np.sin(a), radius * np.cos(a)) for a in angle]


BOARDS: dict[str, tuple[Outline, RGB, Outline, RGB]] = {
    "warning": (_regular(3, 0.50), RED, _regular(3, 0.31), WHITE),
    "ban": (_regular(14, 0.31), RED, _regular(14, 0.22), WHITE),
    "order": (_regular(14, 0.31), BLUE, _rectangle(0.10, 0.40), WHITE),
    "information": (_rectangle(0.60, 0.60), BLUE, _rectangle(0.24, 0.40), WHITE),
    "priority": (_regular(4, 0.42), WHITE, _regular(4, 0.28), YELLOW),
    "town": (_rectangle(1.20, 0.80), YELLOW, _rectangle(0.80, 0.08, 0.06), BLACK),
    "street": (
        _rectangle(0.90, 0.14),
        (0.12, 0.20, 0.50),
        _rectangle(0.70, 0.04),
        WHITE,
    ),
}
"""The board of each sign and the symbol on it: (outline, colour, outline, colour); outlines in
metres (left, up)."""


def road_sign(kind: str, height: float) -> StaticObject:
    """A traffic sign facing +x; ``kind`` is a key of ``BOARDS``, ``height`` is the centre of the
    board in metres."""
    board, ground, mark, colour = BOARDS[kind]

    def flat(outline: Outline, x: float, slot: int) -> Mesh:
        return fan([(x, y, height + z) for y, z in outline], slot)

    pole = tube([(0, 0, -0.2), (0, 0, height + 0.3)], 0.038, 6)
    mesh = merge(
        [pole, flat(board, 0.05, 1), flat(mark, 0.054, 2), flat(board, 0.042, 3)]
    )
    return StaticObject(
        mesh,
        (GALVANISED, Finish("sign", ground), Finish("sign", colour), GALVANISED),
        (POLE, SIGN, SIGN, SIGN),
    )


def traffic_light(height: float, reach: float) -> StaticObject:
    """Traffic lights on a pole, facing +x, and with ``reach`` > 0 (metres) also on an arm over the
    road towards +y."""
    parts = [tube([(0, 0, -0.2), (0, 0, height)], 0.06, 7)]
    spots = [(0.0, 2.3)]
    if reach:
        parts.append(tube([(0, 0, height - 0.1), (0, reach, height + 0.2)], 0.05, 6))
        spots.append((reach, height - 0.6))
    for y, z in spots:
        parts.append(boxes([(-0.02, y - 0.15, z)], [(0.22, y + 0.15, z + 0.9)], 1))
        parts += [
            disc((0.225, y, z + 0.15 + 0.3 * i), (1, 0, 0), 0.1, 8, 2 + i)
            for i in range(3)
        ]
    colours: tuple[RGB, ...] = ((0.1, 0.5, 0.25), (0.35, 0.25, 0.05), (0.3, 0.05, 0.05))
    dark = Finish("plastic", (0.07, 0.09, 0.08))
    return StaticObject(
        merge(parts),
        (GALVANISED, dark, *(Finish("lamp", c) for c in colours)),
        (POLE, OTHER, OTHER, OTHER, OTHER),
    )
