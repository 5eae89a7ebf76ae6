"""Static objects along a street: plants, lamps, benches, bins, bus shelters, market stalls.

Every function returns a ``StaticObject`` whose origin is on the ground and whose front (or long
side) is along +x.
"""

from dataclasses import dataclass

import numpy as np

from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, prism, quads, tube, tubes
from lidar_synth.lab.town.plants import (
    SPECIES,
    TREE_CLASSES,
    VARIANTS,
    coarse_plant,
    plant,
    tufts,
)

BUILDING = 50
FENCE = 51
STRUCTURE = 52
VEGETATION = 70
TERRAIN = 72
POLE = 80
SIGN = 81
OTHER = 99
GALVANISED = Finish("metal", (0.55, 0.57, 0.58))


@dataclass(frozen=True)
class StaticObject:
    """A static object without an instance number ("stuff" in panoptic segmentation).

    Args:
        mesh: its triangles.
        finishes: the finish of each slot.
        raw: SemanticKITTI's class id of each slot.
    """

    mesh: Mesh
    finishes: tuple[Finish, ...]
    raw: tuple[int, ...]


def random_plant(
    species: str, rng: np.random.Generator, size: float = 1.0, near: bool = True
) -> StaticObject:
    """A tree or bush of a species with a random shape, size and tint; with fewer leaves unless it
    is ``near``."""
    mesh = (plant if near else coarse_plant)(species, int(rng.integers(VARIANTS)))
    mesh = mesh.moved(
        yaw=rng.uniform(0, 2 * np.pi), scale=size * rng.uniform(0.85, 1.15, 3)
    )
    leaf, *rest = SPECIES[species]
    assert leaf.colour is not None
    tint = rng.uniform(0.8, 1.25) * rng.uniform(0.9, 1.1, 3)
    if species == "bush" and rng.random() < 0.2:
        tint = np.array((1.9, 0.6, 1.0))
    r, g, b = np.clip(np.array(leaf.colour) * tint, 0, 1)
    return StaticObject(mesh, (Finish("leaf", (r, g, b)), *rest), TREE_CLASSES)


def weeds(
    length: float, depth: float, height: float, rng: np.random.Generator
) -> StaticObject:
    """A strip of high grass along +x."""
    return StaticObject(
        tufts(length, depth, height, 26, rng),
        (Finish("leaf", (0.36, 0.45, 0.18)),),
        (TERRAIN,),
    )


def lamp_post(height: float, reach: float) -> StaticObject:
    """A street lamp with its arm towards +x."""
    pole = tube(
        [(0, 0, -0.2), (0, 0, 0.9), (0, 0, 1.0), (0, 0, height)],
        (0.085, 0.085, 0.06, 0.045),
        8,
    )
    arm = tube(
        [(0, 0, height), (0.4 * reach, 0, height + 0.25), (reach, 0, height + 0.3)],
        0.035,
        6,
    )
    head = boxes(
        [(reach - 0.1, -0.14, height + 0.22)], [(reach + 0.6, 0.14, height + 0.36)], 1
    )
    return StaticObject(
        merge([pole, arm, head]),
        (GALVANISED, Finish("lamp", (0.6, 0.6, 0.6))),
        (POLE, POLE),
    )


def mast(height: float, radius: float, wood: bool) -> StaticObject:
    """A plain pole: a telegraph mast, or a mast of a tram's overhead line."""
    return StaticObject(
        tube([(0, 0, -0.2), (0, 0, height)], (radius, 0.75 * radius), 8),
        (Finish("bark") if wood else GALVANISED,),
        (POLE,),
    )


def bench() -> StaticObject:
    """A park bench facing +x, its seat 0.45 m high."""
    slats = [(-0.22 + 0.11 * i, 0.43) for i in range(4)] + [
        (-0.27, 0.60),
        (-0.30, 0.76),
    ]
    low = [(x, -0.85, z) for x, z in slats]
    high = [
        (x + (0.09 if z < 0.5 else 0.03), 0.85, z + (0.04 if z < 0.5 else 0.11))
        for x, z in slats
    ]
    legs = boxes(
        [(-0.25, y, -0.05) for y in (-0.7, 0.64)],
        [(0.2, y + 0.06, 0.43) for y in (-0.7, 0.64)],
        1,
    )
    return StaticObject(
        merge([boxes(low, high), legs]),
        (Finish("wood"), Finish("metal", (0.2, 0.2, 0.2))),
        (OTHER, OTHER),
    )


def bin_(rng: np.random.Generator) -> StaticObject:
    """A wheeled rubbish bin."""
    colours: tuple[RGB, ...] = (
        (0.10, 0.11, 0.12),
        (0.10, 0.22, 0.12),
        (0.10, 0.16, 0.35),
        (0.55, 0.45, 0.10),
    )
    mesh = merge(
        [
            boxes([(-0.26, -0.24, 0.04)], [(0.26, 0.24, 0.98)]),
            boxes([(-0.30, -0.28, 0.98)], [(0.32, 0.28, 1.06)]),
        ]
    )
    return StaticObject(mesh, (Finish("plastic", colours[rng.integers(4)]),), (OTHER,))


def cabinet() -> StaticObject:
    """A roadside cabinet of a telephone or power company."""
    mesh = merge(
        [
            boxes([(-0.2, -0.5, -0.1)], [(0.2, 0.5, 1.15)]),
            boxes([(-0.24, -0.54, 1.15)], [(0.24, 0.54, 1.22)]),
        ]
    )
    return StaticObject(mesh, (Finish("plastic", (0.50, 0.53, 0.50)),), (OTHER,))


def bollard(height: float = 0.9) -> StaticObject:
    """A short post."""
    ring = tube([(0, 0, height - 0.22), (0, 0, height - 0.12)], 0.066, 6, 1)
    return StaticObject(
        merge([tube([(0, 0, -0.1), (0, 0, height)], 0.06, 6), ring]),
        (Finish("metal", (0.3, 0.3, 0.32)), Finish("sign")),
        (POLE, POLE),
    )


def shelter() -> StaticObject:
    """A bus shelter, open to +x: glass walls, a roof, a bench."""
    glass = [
        [(-0.7, -2, 0.15), (-0.7, 2, 0.15), (-0.7, 2, 2.2), (-0.7, -2, 2.2)],
        [(-0.7, -2, 0.15), (0.5, -2, 0.15), (0.5, -2, 2.2), (-0.7, -2, 2.2)],
        [(-0.7, 2, 0.15), (0.5, 2, 0.15), (0.5, 2, 2.2), (-0.7, 2, 2.2)],
    ]
    posts = [(x, y) for x in (-0.7, 0.5) for y in (-2.0, 2.0)]
    mesh = merge(
        [
            quads(glass, 1),
            boxes(
                [(x - 0.04, y - 0.04, -0.1) for x, y in posts],
                [(x + 0.04, y + 0.04, 2.3) for x, y in posts],
            ),
            boxes(
                [(-0.9, -2.2, 2.3), (-0.65, -1.2, 0.42)],
                [(0.8, 2.2, 2.42), (-0.3, 1.2, 0.47)],
            ),
        ]
    )
    return StaticObject(
        mesh,
        (Finish("metal", (0.25, 0.27, 0.28)), Finish("glass")),
        (STRUCTURE, STRUCTURE),
    )


def advertising_column() -> StaticObject:
    """An advertising column."""
    angle = np.linspace(0, 2 * np.pi, 15)[:-1]
    circle = np.c_[np.cos(angle), np.sin(angle)]
    mesh = merge(
        [
            prism(0.6 * circle, -0.2, 2.6, 0, 0),
            prism(0.75 * circle, 2.6, 2.8, 1, 1),
            prism(0.5 * circle, 2.8, 3.1, 1, 1),
        ]
    )
    return StaticObject(
        mesh, (Finish("cloth", (0.75, 0.55, 0.40)), Finish("concrete")), (OTHER, OTHER)
    )


def fountain() -> StaticObject:
    """A basin with a pillar."""
    angle = np.linspace(0, 2 * np.pi, 13)[:-1]
    circle = np.c_[np.cos(angle), np.sin(angle)]
    mesh = merge(
        [
            prism(2.6 * circle, -0.2, 0.55),
            prism(2.3 * circle, 0.0, 0.56, 1, 1),
            prism(0.4 * circle, 0, 2.4),
            prism(0.9 * circle, 1.5, 1.65),
        ]
    )
    return StaticObject(
        mesh,
        (Finish("stone"), Finish("plastic", (0.2, 0.3, 0.34))),
        (STRUCTURE, STRUCTURE),
    )


def stall(rng: np.random.Generator) -> StaticObject:
    """A market stall: counter, posts and an awning."""
    colours: tuple[RGB, ...] = (
        (0.72, 0.10, 0.09),
        (0.85, 0.83, 0.78),
        (0.18, 0.38, 0.22),
        (0.2, 0.3, 0.55),
    )
    posts = [(x, y) for x in (-1.0, 1.0) for y in (-1.5, 1.5)]
    awning = [
        [(-1.3, -1.7, 2.3), (-1.3, 1.7, 2.3), (0, 1.7, 2.8), (0, -1.7, 2.8)],
        [(1.3, -1.7, 2.3), (1.3, 1.7, 2.3), (0, 1.7, 2.8), (0, -1.7, 2.8)],
    ]
    mesh = merge(
        [
            quads(awning, 1),
            tubes([([(x, y, -0.1), (x, y, 2.4)], 0.025) for x, y in posts], 4, 0),
            boxes([(0.2, -1.5, 0.0)], [(1.0, 1.5, 0.9)], 2),
        ]
    )
    return StaticObject(
        mesh,
        (GALVANISED, Finish("cloth", colours[rng.integers(4)]), Finish("wood")),
        (STRUCTURE, STRUCTURE, STRUCTURE),
    )


def planter(rng: np.random.Generator) -> StaticObject:
    """A tub with flowers."""
    bush = random_plant("bush", rng, 0.45)
    tub = boxes([(-0.45, -0.45, -0.05)], [(0.45, 0.45, 0.5)], 3)
    return StaticObject(
        merge([bush.mesh.moved((0, 0, 0.4)), tub]),
        (*bush.finishes, Finish("concrete")),
        (*bush.raw, OTHER),
    )
