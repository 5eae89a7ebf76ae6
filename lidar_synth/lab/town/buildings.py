"""Meshes of buildings (four walls, a roof, rooms behind the windows, balconies) and of garages."""

import numpy as np

from lidar_synth.lab.town.facades import (
    DOOR,
    GLASS,
    PLINTH,
    RAIL,
    ROOF,
    ROOM,
    SLAB,
    WALL,
    BuildingPlan,
    Frame,
    facade,
    panels,
    reveals,
    wall_around,
)
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, quads, tube


def _balconies(plan: BuildingPlan, rng: np.random.Generator) -> Mesh:
    """Balconies along parts of the front: slabs with railings of bars or of solid panels."""
    parts = []
    x = rng.uniform(0.5, 1.5)
    solid = rng.random() < 0.5
    while x + 3.0 < plan.width:
        for level in range(1, plan.floors):
            z = plan.plinth + level * plan.storey
            parts.append(boxes([(x, -1.3, z - 0.15)], [(x + 2.8, 0.0, z)], SLAB))
            if solid:
                low = [(x, -1.3, z), (x, -1.3, z), (x + 2.75, -1.3, z)]
                parts.append(
                    boxes(
                        low,
                        [
                            (x + 2.8, -1.25, z + 1),
                            (x + 0.05, 0, z + 1),
                            (x + 2.8, 0, z + 1),
                        ],
                        SLAB,
                    )
                )
            else:
                bars = np.arange(x, x + 2.8, 0.14)
                grid = np.c_[bars, bars + 0.025, 0 * bars + z, 0 * bars + z + 1]
                parts.append(
                    quads(
                        panels(grid, -1.28, (np.zeros(3), np.eye(3)[0], np.eye(3)[1])),
                        RAIL,
                    )
                )
                parts.append(
                    boxes([(x, -1.31, z + 0.98)], [(x + 2.8, -1.26, z + 1.03)], RAIL)
                )
        x += rng.uniform(4.5, 6.5)
    return merge(parts)


def _roof(plan: BuildingPlan, rng: np.random.Generator) -> Mesh:
    """The roof with chimney and skylights, or a flat roof."""
    w = plan.width
    d = plan.depth
    z = plan.eaves
    over = 0.45
    if plan.roof == "flat":
        edge = boxes([(-0.1, -0.1, z - 0.2)], [(w + 0.1, d + 0.1, z + 0.25)], SLAB)
        return merge(
            [
                edge,
                boxes(
                    [(0.3 * w, 0.3 * d, z)],
                    [(0.3 * w + 1.6, 0.3 * d + 1.6, z + 1.4)],
                    SLAB,
                ),
            ]
        )
    cross = plan.roof == "cross"
    # Built with the ridge along x; a cross gable is the same roof with x and y swapped.
    along, deep = (d, w) if cross else (w, d)
    top = z + rng.uniform(0.32, 0.5) * deep
    low = z - 2 * over * (top - z) / deep
    inset = 0.35 * deep if plan.roof == "hip" else 0.0
    x0 = -over
    x1 = along + over
    y0 = -over
    y1 = deep + over
    a = (x0 + inset, deep / 2, top)
    b = (x1 - inset, deep / 2, top)
    slopes = [
        [(x0, y0, low), (x1, y0, low), b, a],
        [(x0, y1, low), a, b, (x1, y1, low)],
    ]
    ends = [[(x0, y0, low), a, a, (x0, y1, low)], [(x1, y0, low), (x1, y1, low), b, b]]
    gables = [
        [(x, 0, z), (x, deep, z), (x, deep / 2, top), (x, deep / 2, top)]
        for x in (0, along)
    ]
    sheets = quads(
        [*slopes, *(ends if inset else gables)],
        np.array([ROOF, ROOF] + [ROOF if inset else WALL] * 2),
    )
    turned = Mesh(sheets.triangles[..., [1, 0, 2]], sheets.slot) if cross else sheets
    chimney = np.array([rng.uniform(0.2, 0.8) * w, 0.5 * d, top])
    stack = boxes(
        [chimney - np.array((0.3, 0.3, 1.0))],
        [chimney + np.array((0.3, 0.3, 0.9))],
        PLINTH,
    )
    lights = (
        [_skylights(slopes[0], int(rng.integers(0, 4)), rng)]
        if plan.roof == "gable" and plan.detail
        else []
    )
    return merge([turned, stack, *lights])


def _skylights(
    slope: list[tuple[float, float, float]], count: int, rng: np.random.Generator
) -> Mesh:
    """``count`` windows at random positions on a slope, given by its corners."""
    a, b, c, d = np.array(slope, float)
    up = np.cross(b - a, d - a)
    up = 0.04 * up / np.linalg.norm(up)
    width = 0.8 / float(np.linalg.norm(b - a))
    height = 1.2 / float(np.linalg.norm(d - a))
    corners = []
    for u in map(float, rng.uniform(0.1, 0.85, count)):
        edges = [
            (u, 0.4),
            (u + width, 0.4),
            (u + width, 0.4 + height),
            (u, 0.4 + height),
        ]
        corners.append(
            [
                (1 - v) * ((1 - s) * a + s * b) + v * ((1 - s) * d + s * c) + up
                for s, v in edges
            ]
        )
    return quads(np.array(corners).reshape(-1, 4, 3), GLASS)


def make_building(plan: BuildingPlan, rng: np.random.Generator) -> Mesh:
    """The mesh of a building; the slots are those of ``facades.finishes``."""
    w = plan.width
    d = plan.depth
    axes = np.eye(3)
    sides: list[tuple[float, Frame]] = [
        (w, (np.zeros(3), axes[0], axes[1])),
        (d, (np.zeros(3), axes[1], axes[0])),
        (d, (w * axes[0], axes[1], -axes[0])),
        (w, (d * axes[1], axes[0], -axes[1])),
    ]
    parts = [
        facade(plan, length, frame, i, rng) for i, (length, frame) in enumerate(sides)
    ]
    parts.append(_roof(plan, rng))
    if plan.detail:
        inset = min(3.2, 0.35 * d, 0.35 * w)
        parts.append(
            boxes([(inset, inset, 0)], [(w - inset, d - inset, plan.eaves - 0.1)], ROOM)
        )
        floors = plan.plinth + plan.storey * np.arange(plan.floors)
        parts.append(
            quads(
                [
                    [
                        (0.1, 0.3, z),
                        (w - 0.1, 0.3, z),
                        (w - 0.1, d - 0.3, z),
                        (0.1, d - 0.3, z),
                    ]
                    for z in floors
                ],
                ROOM,
            )
        )
        parts.append(tube([(0.12, -0.06, 0), (0.12, -0.06, plan.eaves)], 0.05, 5, RAIL))
        if plan.balconies:
            parts.append(_balconies(plan, rng))
    return merge(parts)


def garage(width: float, depth: float) -> Mesh:
    """A flat-roofed garage with its door to the front."""
    axes = np.eye(3)
    frame: Frame = (np.zeros(3), axes[0], axes[1])
    door = np.array([[0.3, width - 0.3, 0.0, 2.1]])
    shell = boxes([(0, 0.12, -0.5)], [(width, depth, 2.6)], WALL)
    slats = np.linspace(0, 2.1, 6)
    leaves = np.stack(
        [np.full(5, 0.3), np.full(5, width - 0.3), slats[:-1] + 0.02, slats[1:]], 1
    )
    return merge(
        [
            shell,
            wall_around(width, -0.5, 2.6, door, frame),
            quads(reveals(door, 0.1, frame), WALL),
            quads(panels(leaves, 0.1, frame), DOOR),
            boxes([(-0.1, -0.1, 2.55)], [(width + 0.1, depth + 0.1, 2.75)], SLAB),
        ]
    )
