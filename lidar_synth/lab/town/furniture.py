"""Static objects along a street whose measures vary: lamps, signs, walls and fences.

The front of a sign is along +x, as is the arm of a lamp; walls and fences run along +x.
"""

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import RGB, TABLES, Rng, pick_colour
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.meshes import boxes, circle, fan, quads, tube, tubes
from lidar_synth.lab.town.objects import StaticObject, make_object
from lidar_synth.lab.town.plants import random_plant


def lamp_post(height: float, reach: float) -> StaticObject:
    """A street lamp with its arm towards +x."""
    levels = [(0, 0, z) for z in (-0.2, 0.9, 1.0, height)]
    arm = [(0, 0, height), (0.4 * reach, 0, height + 0.25), (reach, 0, height + 0.3)]
    low = (reach - 0.1, -0.14, height + 0.22)
    return make_object(
        "lamp_post",
        tube(levels, (0.085, 0.085, 0.06, 0.045), 8),
        tube(arm, 0.035, 6),
        boxes([low], [(reach + 0.6, 0.14, height + 0.36)], 1),
    )


def bin_(rng: Rng) -> StaticObject:
    """A wheeled rubbish bin of a random colour."""
    return make_object("bin", finishes={0: Finish("plastic", pick_colour("bins", rng))})


def stall(rng: Rng) -> StaticObject:
    """A market stall with an awning of a random colour."""
    return make_object(
        "stall", finishes={1: Finish("cloth", pick_colour("awnings", rng))}
    )


def planter(rng: Rng) -> StaticObject:
    """A tub with flowers."""
    bush = random_plant("bush", rng, 0.45)
    mesh = bush.mesh.moved((0, 0, 0.4))
    return make_object("planter", mesh, finishes=dict(enumerate(bush.finishes)))


def _outline(shape: str, *measures: float) -> Float64Array:
    """(P, 2) left and up of the corners of a board, metres."""
    if shape == "regular":
        sides, radius = measures
        return radius * circle(int(sides))[:, ::-1]
    width, height, *up = measures
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return corners * (width / 2, height / 2) + (0, sum(up))


def road_sign(kind: str, height: float) -> StaticObject:
    """A traffic sign facing +x; ``kind`` is one of the tables' signs, ``height`` is the centre of
    the board in metres."""
    board, ground, mark, colour = TABLES["signs"][kind]
    parts = [tube([(0, 0, -0.2), (0, 0, height + 0.3)], 0.038, 6)]
    for slot, shape, x in ((1, board, 0.05), (2, mark, 0.054), (3, board, 0.042)):
        corners = [(x, y, height + z) for y, z in _outline(*shape)]
        parts.append(fan(corners, slot))
    colours = {1: Finish("sign", (*ground,)), 2: Finish("sign", (*colour,))}
    return make_object("sign", *parts, finishes=colours)


def _post_places(length: float) -> Float64Array:
    """Places of the posts of a fence, about 2.5 m apart."""
    step = max(1.0, length / max(1, round(length / 2.5)))
    return np.arange(0, length + 0.01, step)


def bar_fence(
    length: float,
    height: float,
    pitch: float,
    colour: RGB,
    wood: bool,
) -> StaticObject:
    """A fence of upright bars or boards along +x; rays pass between them."""
    thick = 0.075 if wood else 0.022
    bars = [
        [(a, 0, 0.06), (a + thick, 0, 0.06), (a + thick, 0, height), (a, 0, height)]
        for a in np.arange(0, length, pitch)
    ]
    posts = _post_places(length)
    top = height - 0.18
    return make_object(
        "bar_fence",
        quads(bars),
        boxes(
            [(0, 0.01, 0.2), (0, 0.01, top)],
            [(length, 0.04, 0.26), (length, 0.04, top + 0.06)],
        ),
        boxes(
            [(p - 0.04, -0.04, -0.2) for p in posts],
            [(p + 0.04, 0.04, height + 0.05) for p in posts],
        ),
        finishes={0: Finish("wood" if wood else "metal", colour)},
    )


def wire_fence(length: float, height: float) -> StaticObject:
    """A wire fence between posts along +x; most rays pass through the mesh."""
    wire = [(0, 0, 0.03), (length, 0, 0.03), (length, 0, height), (0, 0, height)]
    posts = [[(p, 0, -0.2), (p, 0, height + 0.04)] for p in _post_places(length)]
    return make_object("wire_fence", quads(wire, 1), tubes(posts, 0.025))


def low_wall(length: float, height: float, finish: Finish) -> StaticObject:
    """A garden wall along +x with pillars and a coping."""
    last = max(0.4, length - 0.4)
    return make_object(
        "low_wall",
        boxes([(0, -0.12, -0.4)], [(length, 0.12, height)]),
        boxes([(0, -0.16, height)], [(length, 0.16, height + 0.06)], 1),
        boxes(
            [(0, -0.2, -0.4), (last, -0.2, -0.4)],
            [(0.4, 0.2, height + 0.3), (last + 0.4, 0.2, height + 0.3)],
        ),
        finishes={0: finish},
    )
