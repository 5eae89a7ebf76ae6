"""Boundaries of lots (hedges, walls, fences), in pieces that follow the bends of the street."""

from itertools import pairwise

import numpy as np

from lidar_synth.lab.town.fences import (
    bar_fence,
    clipped_hedge,
    low_wall,
    thicket,
    wire_fence,
)
from lidar_synth.lab.town.furniture import StaticObject
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.scene import Scene

KINDS = {
    "hedge": 5,
    "thicket": 5,
    "wall": 1,
    "bars": 2,
    "boards": 1,
    "wire": 1,
    "wallhedge": 2,
    "none": 7,
}
"""{kind of boundary: weight}."""


def sample_kind(rng: np.random.Generator) -> str:
    """A kind of boundary, sampled by the weights of ``KINDS``."""
    weights = np.array(list(KINDS.values()), float)
    return str(rng.choice(list(KINDS), p=weights / weights.sum()))


def put_boundary(
    scene: Scene,
    kind: str,
    ends: tuple[float, float],
    at: float,
    along: bool,
    rng: np.random.Generator,
) -> None:
    """Put a boundary into the scene.

    Args:
        scene: the scene to add it to.
        kind: one of ``KINDS``.
        ends: metres, start and end along its running coordinate.
        at: metres, its position in the other coordinate.
        along: True if it runs along s, False if it runs along t.
        rng: samples its height, material and leaves.
    """
    if kind == "none" or ends[1] - ends[0] < 0.8:
        return
    height = rng.uniform(0.7, 1.25)
    shade = float(rng.uniform(0.1, 0.5))
    built = rng.random() < 0.6
    stone = (
        Finish(str(rng.choice(["stone", "concrete", "brick"])))
        if built
        else Finish("render", (0.8, 0.78, 0.72))
    )
    pieces = np.linspace(*ends, max(1, int(np.ceil((ends[1] - ends[0]) / 7))) + 1)
    for a, b in pairwise(pieces):
        for item, aside, lift in _piece(kind, b - a, height, stone, shade, rng):
            if along:
                scene.put(item, a, at + aside, 0.0, lift)
            else:
                scene.put(item, at - aside, a, np.pi / 2, lift)


def _piece(
    kind: str,
    length: float,
    height: float,
    stone: Finish,
    shade: float,
    rng: np.random.Generator,
) -> list[tuple[StaticObject, float, float]]:
    """The objects that make up one piece: (object, metres to its left, metres above the ground)."""
    iron = (shade, shade, 1.1 * shade)
    match kind:
        case "hedge":
            return [(clipped_hedge(length, rng), 0.0, 0.0)]
        case "thicket":
            return [(thicket(length, 2 * height, rng.uniform(1.2, 2.0), rng), 0.9, 0.0)]
        case "wall":
            return [(low_wall(length, height, stone), 0.0, 0.0)]
        case "bars":
            return [(bar_fence(length, height, 0.13, iron, False), 0.0, 0.0)]
        case "boards":
            return [
                (bar_fence(length, height, 0.12, (0.5, 0.38, 0.25), True), 0.0, 0.0)
            ]
        case "wire":
            return [(wire_fence(length, height), 0.0, 0.0)]
        case "wallhedge":
            behind = 0.4 if shade > 0.3 else 0.0
            return [
                (low_wall(length, 0.4, stone), 0.0, 0.0),
                (clipped_hedge(length, rng), behind, 0.35),
            ]
    return [
        (low_wall(length, 0.45, stone), 0.0, 0.0),
        (bar_fence(length, 0.7, 0.13, iron, False), 0.0, 0.5),
    ]
