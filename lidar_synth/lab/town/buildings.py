"""Buildings (four walls, a roof, rooms behind the windows, balconies) and garages."""

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import Rng, pick_colour
from lidar_synth.lab.town.facades import (
    DOOR,
    FRONT,
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
    reveals,
    sheets,
    wall_around,
)
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, quads, tube
from lidar_synth.lab.town.objects import StaticObject, make_object


def _balconies(plan: BuildingPlan, rng: Rng) -> Mesh:
    """Balconies along parts of the front: slabs with railings of bars or of solid panels."""
    parts = []
    x = rng.uniform(0.5, 1.5)
    railing = _solid_railing if rng.random() < 0.5 else _barred_railing
    while x + 3.0 < plan.width:
        for level in range(1, plan.floors):
            z = plan.plinth + level * plan.storey
            parts.append(boxes([(x, -1.3, z - 0.15)], [(x + 2.8, 0.0, z)], SLAB))
            parts += railing(x, z)
        x += rng.uniform(4.5, 6.5)
    return merge(parts)


def _solid_railing(x: float, z: float) -> list[Mesh]:
    end = x + 2.8
    low = [(x, -1.3, z), (x, -1.3, z), (x + 2.75, -1.3, z)]
    high = [(end, -1.25, z + 1), (x + 0.05, 0, z + 1), (end, 0, z + 1)]
    return [boxes(low, high, SLAB)]


def _barred_railing(x: float, z: float) -> list[Mesh]:
    bars = np.arange(x, x + 2.8, 0.14)
    grid = np.c_[bars, bars + 0.025, 0 * bars + z, 0 * bars + z + 1]
    rail = boxes([(x, -1.31, z + 0.98)], [(x + 2.8, -1.26, z + 1.03)], RAIL)
    return [sheets(grid, -1.28, FRONT, RAIL), rail]


def _flat_roof(plan: BuildingPlan) -> Mesh:
    """A roof with an edge and a structure for the lift."""
    w = plan.width
    d = plan.depth
    z = plan.eaves
    x = 0.3 * w
    y = 0.3 * d
    return boxes(
        [(-0.1, -0.1, z - 0.2), (x, y, z)],
        [(w + 0.1, d + 0.1, z + 0.25), (x + 1.6, y + 1.6, z + 1.4)],
        SLAB,
    )


def _roof(plan: BuildingPlan, rng: Rng) -> Mesh:
    """A pitched roof with chimney and skylights."""
    # Built with the ridge along x; a cross gable is the same roof with x and y swapped.
    cross = plan.roof == "cross"
    along, deep = (plan.depth, plan.width) if cross else (plan.width, plan.depth)
    top = plan.eaves + rng.uniform(0.32, 0.5) * deep
    slopes, sides = _roof_faces(along, deep, plan.eaves, top, plan.roof == "hip")
    side = ROOF if plan.roof == "hip" else WALL
    roof = quads([*slopes, *sides], np.array([ROOF, ROOF, side, side]))
    if cross:
        roof = Mesh(roof.triangles[..., [1, 0, 2]], roof.slot)
    x = rng.uniform(0.2, 0.8) * plan.width
    y = 0.5 * plan.depth
    low = (x - 0.3, y - 0.3, top - 1.0)
    parts = [roof, boxes(low, (x + 0.3, y + 0.3, top + 0.9), PLINTH)]
    if plan.roof == "gable" and plan.detail:
        parts.append(_skylights(np.array(slopes[0]), int(rng.integers(0, 4)), rng))
    return merge(parts)


Corners = list[tuple[float, float, float]]


def _roof_faces(
    along: float,
    deep: float,
    eaves: float,
    top: float,
    hip: bool,
) -> tuple[list[Corners], list[Corners]]:
    """Corners of the two slopes of a roof and of its two ends, which slope if it is a ``hip``."""
    over = 0.45
    low = eaves - 2 * over * (top - eaves) / deep
    end = along + over
    back = deep + over
    ridge = deep / 2
    inset = 0.35 * deep if hip else 0.0
    a = (inset - over, ridge, top)
    b = (end - inset, ridge, top)
    front_left = (-over, -over, low)
    front_right = (end, -over, low)
    back_left = (-over, back, low)
    back_right = (end, back, low)
    slopes = [[front_left, front_right, b, a], [back_left, a, b, back_right]]
    if hip:
        return slopes, [[front_left, a, a, back_left], [front_right, back_right, b, b]]
    return slopes, [
        [(x, 0, eaves), (x, deep, eaves), (x, ridge, top), (x, ridge, top)]
        for x in (0, along)
    ]


def _skylights(slope: Float64Array, count: int, rng: Rng) -> Mesh:
    """``count`` windows at random positions on a slope, given by its corners (4, 3)."""
    a, b, c, d = slope
    up = np.cross(b - a, d - a)
    up = 0.04 * up / np.linalg.norm(up)
    width = 0.8 / float(np.linalg.norm(b - a))
    height = 1.2 / float(np.linalg.norm(d - a))
    s = rng.uniform(0.1, 0.85, (count, 1, 1)) + np.array([0, width, width, 0])[:, None]
    v = 0.4 + np.array([0, 0, height, height])[:, None]
    below = (1 - s) * a + s * b
    above = (1 - s) * d + s * c
    corners = (1 - v) * below + v * above + up
    return quads(corners, GLASS)


def make_building(plan: BuildingPlan, rng: Rng) -> Mesh:
    """The mesh of a building; its slots are those of ``finish_building``."""
    w = plan.width
    d = plan.depth
    x, y, _ = np.eye(3)
    sides: list[tuple[float, Frame]] = [
        (w, FRONT),
        (d, (np.zeros(3), y, x)),
        (d, (w * x, y, -x)),
        (w, (d * y, x, -y)),
    ]
    parts = [
        facade(plan, length, frame, i, rng) for i, (length, frame) in enumerate(sides)
    ]
    parts.append(_flat_roof(plan) if plan.roof == "flat" else _roof(plan, rng))
    if plan.detail:
        parts += _rooms(plan)
        if plan.balconies:
            parts.append(_balconies(plan, rng))
    return merge(parts)


def _rooms(plan: BuildingPlan) -> list[Mesh]:
    """What is seen through the windows, the floors, and a gutter."""
    w = plan.width
    d = plan.depth
    inset = min(3.2, 0.35 * d, 0.35 * w)
    inner = (w - inset, d - inset, plan.eaves - 0.1)
    floors = [
        [(0.1, 0.3, z), (w - 0.1, 0.3, z), (w - 0.1, d - 0.3, z), (0.1, d - 0.3, z)]
        for z in plan.plinth + plan.storey * np.arange(plan.floors)
    ]
    return [
        boxes((inset, inset, 0), inner, ROOM),
        quads(floors, ROOM),
        tube([(0.12, -0.06, 0), (0.12, -0.06, plan.eaves)], 0.05, 5, RAIL),
    ]


def garage(width: float, depth: float) -> Mesh:
    """A flat-roofed garage with its door to the front."""
    door = np.array([[0.3, width - 0.3, 0.0, 2.1]])
    slats = np.repeat(door, 5, axis=0)
    heights = np.linspace(0, 2.1, 6)
    slats[:, 2] = heights[:-1] + 0.02
    slats[:, 3] = heights[1:]
    return merge(
        [
            boxes([(0, 0.12, -0.5)], [(width, depth, 2.6)], WALL),
            wall_around(width, -0.5, 2.6, door, FRONT),
            reveals(door, 0.1, FRONT),
            sheets(slats, 0.1, FRONT, DOOR),
            boxes([(-0.1, -0.1, 2.55)], [(width + 0.1, depth + 0.1, 2.75)], SLAB),
        ]
    )


def finish_building(mesh: Mesh, rng: Rng) -> StaticObject:
    """A building with random finishes."""
    wall = Finish("brick")
    if rng.random() >= 0.10:
        wall = Finish("render", pick_colour("walls", rng))
    roof = Finish("tile", pick_colour("roofs", rng))
    door = Finish("wood", pick_colour("doors", rng))
    finishes = {WALL: wall, ROOF: roof, DOOR: door}
    return make_object("building", mesh, finishes=finishes)
