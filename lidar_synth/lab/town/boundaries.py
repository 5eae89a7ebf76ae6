"""Boundaries of lots (hedges, walls, fences), in pieces that follow the bends of the street."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidar_synth.lab.town.catalogue import RGB, Rng, pick
from lidar_synth.lab.town.furniture import bar_fence, low_wall, wire_fence
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.objects import StaticObject
from lidar_synth.lab.town.plants import clipped_hedge, random_hedge
from lidar_synth.lab.town.scene import Scene


class Style(NamedTuple):
    """What the pieces of a boundary share: its height in metres, the finish of its walls, and the
    colour of its bars."""

    height: float
    stone: Finish
    iron: RGB


def put_boundary(
    scene: Scene,
    kind: str,
    ends: tuple[float, float],
    at: float,
    along: bool,
    rng: Rng,
) -> None:
    """Put a boundary into the scene.

    Args:
        scene: the scene to add it to.
        kind: one of the tables' shares of ``boundaries``.
        ends: metres, start and end along its running coordinate.
        at: metres, its position in the other coordinate.
        along: True if it runs along s, False if it runs along t.
        rng: samples its height, material and leaves.
    """
    length = ends[1] - ends[0]
    if kind == "none" or length < 0.8:
        return
    style = _sample_style(rng)
    count = max(1, int(np.ceil(length / 7)))
    for a, b in pairwise(np.linspace(*ends, count + 1)):
        for item, aside, lift in _piece(kind, b - a, style, rng):
            if along:
                scene.put(item, a, at + aside, 0.0, lift)
            else:
                scene.put(item, at - aside, a, np.pi / 2, lift)


def _sample_style(rng: Rng) -> Style:
    height = rng.uniform(0.7, 1.25)
    shade = rng.uniform(0.1, 0.5)
    stone = Finish("render", (0.8, 0.78, 0.72))
    if rng.random() < 0.6:
        stone = Finish(pick(("stone", "concrete", "brick"), rng))
    return Style(height, stone, (shade, shade, 1.1 * shade))


def _piece(
    kind: str,
    length: float,
    style: Style,
    rng: Rng,
) -> list[tuple[StaticObject, float, float]]:
    """The objects that make up one piece: (object, metres to its left, metres above the ground)."""
    height, stone, iron = style
    match kind:
        case "wallhedge":
            behind = 0.4 if iron[0] > 0.3 else 0.0
            hedge = clipped_hedge(length, rng)
            return [(low_wall(length, 0.4, stone), 0.0, 0.0), (hedge, behind, 0.35)]
        case "thicket":
            depth = rng.uniform(1.2, 2.0)
            return [(random_hedge(length, 2 * height, depth, "wild", rng), 0.9, 0.0)]
        case "hedge":
            item = clipped_hedge(length, rng)
        case "wall":
            item = low_wall(length, height, stone)
        case "bars":
            item = bar_fence(length, height, 0.13, iron, False)
        case "boards":
            item = bar_fence(length, height, 0.12, (0.5, 0.38, 0.25), True)
        case _:
            item = wire_fence(length, height)
    return [(item, 0.0, 0.0)]
