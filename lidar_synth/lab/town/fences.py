"""Hedges, fences, garden walls and crash barriers, all along +x."""

import numpy as np

from lidar_synth.lab.town.furniture import FENCE, GALVANISED, VEGETATION, StaticObject
from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, boxes, loft, merge, quads, tubes
from lidar_synth.lab.town.plants import hedge


def clipped_hedge(length: float, rng: np.random.Generator) -> StaticObject:
    """A clipped hedge of random height and depth along +x."""
    return _leafy(
        hedge(length, rng.uniform(0.8, 1.9), rng.uniform(0.6, 1.1), True, rng), rng
    )


def thicket(
    length: float, height: float, depth: float, rng: np.random.Generator
) -> StaticObject:
    """An uneven belt of shrubs along +x."""
    return _leafy(hedge(length, height, depth, False, rng), rng)


def _leafy(mesh: Mesh, rng: np.random.Generator) -> StaticObject:
    """A hedge with a random shade of green."""
    green = rng.uniform(0.8, 1.2)
    inside = Finish("foliage", (0.10 * green, 0.18 * green, 0.05))
    return StaticObject(
        mesh,
        (Finish("leaf", (0.18 * green, 0.31 * green, 0.10)), inside),
        (VEGETATION, VEGETATION),
    )


def bar_fence(
    length: float, height: float, pitch: float, colour: RGB, wood: bool
) -> StaticObject:
    """A fence of upright bars or boards along +x; rays pass between them."""
    x = np.arange(0, length, pitch)
    thick = 0.075 if wood else 0.022
    bars = [
        [(a, 0, 0.06), (a + thick, 0, 0.06), (a + thick, 0, height), (a, 0, height)]
        for a in x
    ]
    posts = np.arange(0, length + 0.01, max(1.0, length / max(1, round(length / 2.5))))
    rails = [(0.2, 0.26), (height - 0.18, height - 0.12)]
    mesh = merge(
        [
            quads(bars),
            boxes(
                [(0, 0.01, a) for a, _ in rails], [(length, 0.04, b) for _, b in rails]
            ),
            boxes(
                [(p - 0.04, -0.04, -0.2) for p in posts],
                [(p + 0.04, 0.04, height + 0.05) for p in posts],
            ),
        ]
    )
    return StaticObject(mesh, (Finish("wood" if wood else "metal", colour),), (FENCE,))


def wire_fence(length: float, height: float) -> StaticObject:
    """A wire fence between posts along +x; most rays pass through the mesh."""
    posts = np.arange(0, length + 0.01, max(1.0, length / max(1, round(length / 2.5))))
    mesh = merge(
        [
            quads(
                [
                    [
                        (0, 0, 0.03),
                        (length, 0, 0.03),
                        (length, 0, height),
                        (0, 0, height),
                    ]
                ],
                1,
            ),
            tubes(
                [([(p, 0, -0.2), (p, 0, height + 0.04)], 0.025) for p in posts], 5, 0
            ),
        ]
    )
    return StaticObject(
        mesh, (Finish("metal", (0.25, 0.40, 0.30)), Finish("wire")), (FENCE, FENCE)
    )


def low_wall(length: float, height: float, finish: Finish) -> StaticObject:
    """A garden wall along +x with pillars and a coping."""
    pillars = [0.0, max(0.4, length - 0.4)]
    mesh = merge(
        [
            boxes([(0, -0.12, -0.4)], [(length, 0.12, height)], 0),
            boxes([(0, -0.16, height)], [(length, 0.16, height + 0.06)], 1),
            boxes(
                [(p, -0.2, -0.4) for p in pillars],
                [(p + 0.4, 0.2, height + 0.3) for p in pillars],
                0,
            ),
        ]
    )
    return StaticObject(mesh, (finish, Finish("concrete")), (FENCE, FENCE))


def guard_rail(length: float) -> StaticObject:
    """A crash barrier along +x."""
    profile = np.array(
        [(0.0, 0.45), (0.05, 0.52), (0.0, 0.60), (0.05, 0.68), (0.0, 0.75)]
    )
    x = np.linspace(0, length, max(2, int(length / 4) + 1))
    sections = [[(a, y, z) for y, z in profile] for a in x]
    posts = np.arange(1, length, 2.0)
    mesh = merge(
        [
            loft(sections),
            boxes(
                [(p, -0.12, -0.2) for p in posts],
                [(p + 0.1, -0.01, 0.72) for p in posts],
            ),
        ]
    )
    return StaticObject(mesh, (GALVANISED,), (FENCE,))
