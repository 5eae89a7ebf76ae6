"""Walls of buildings: recessed windows with frames, blinds and curtains, and doors with steps.

A building's own frame has x along its front and y into the building; the front wall is at y = 0,
the ground at z = 0. Behind the glass are curtains, half-closed blinds or a room, so that rays
through a window hit something realistic.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, quads

WALL, GLASS, FRAME, ROOF, DOOR, PLINTH, ROOM, RAIL, BLIND, SLAB = range(10)
WALLS: tuple[RGB, ...] = (
    (0.88, 0.86, 0.80),
    (0.90, 0.89, 0.86),
    (0.84, 0.80, 0.68),
    (0.80, 0.72, 0.54),
    (0.74, 0.73, 0.70),
    (0.78, 0.62, 0.50),
    (0.70, 0.74, 0.70),
    (0.86, 0.82, 0.74),
    (0.62, 0.60, 0.58),
    (0.92, 0.91, 0.89),
)
ROOFS: tuple[RGB, ...] = (
    (0.42, 0.20, 0.15),
    (0.35, 0.17, 0.13),
    (0.25, 0.20, 0.19),
    (0.20, 0.20, 0.22),
    (0.50, 0.26, 0.18),
)
DOORS: tuple[RGB, ...] = (
    (0.35, 0.24, 0.15),
    (0.20, 0.26, 0.22),
    (0.72, 0.72, 0.70),
    (0.30, 0.12, 0.10),
    (0.24, 0.24, 0.26),
)

Array = NDArray[np.float64]
Frame = tuple[Array, Array, Array]
"""The frame of a wall: its lower left corner, and unit vectors along the wall and into the
building."""


@dataclass(frozen=True)
class BuildingPlan:
    """The dimensions and the style of a building.

    Args:
        width, depth: metres.
        floors: number of storeys under the eaves.
        storey: metres from floor to floor.
        plinth: metres, height of the ground floor above the ground.
        roof: ``gable`` (ridge along the front), ``cross`` (gable to the front), ``hip`` or
            ``flat``.
        balconies: whether the front has balconies.
        shop: whether the ground floor is mostly glass.
        detail: False for a building that is only seen from afar; its windows are flat on the wall.
    """

    width: float
    depth: float
    floors: int
    storey: float = 2.75
    plinth: float = 0.5
    roof: str = "gable"
    balconies: bool = False
    shop: bool = False
    detail: bool = True

    @property
    def eaves(self) -> float:
        """Height of the walls, metres."""
        return self.plinth + self.floors * self.storey


def finishes(rng: np.random.Generator) -> tuple[Finish, ...]:
    """Sampled finishes of a building, one per slot."""
    wall = (
        Finish("brick")
        if rng.random() < 0.10
        else Finish("render", WALLS[rng.integers(len(WALLS))])
    )
    return (
        wall,
        Finish("glass"),
        Finish("plastic", (0.86, 0.86, 0.84)),
        Finish("tile", ROOFS[rng.integers(len(ROOFS))]),
        Finish("wood", DOORS[rng.integers(len(DOORS))]),
        Finish("concrete"),
        Finish("curtain", (0.5, 0.46, 0.42)),
        Finish("metal", (0.30, 0.31, 0.32)),
        Finish("plastic", (0.74, 0.73, 0.70)),
        Finish("concrete"),
    )


def panels(rect: Array, deep: float, frame: Frame) -> Array:
    """(n, 4, 3) corners of rectangles (n, 4: u0, u1, z0, z1) parallel to a wall, ``deep`` metres
    behind it."""
    origin, along, inward = frame
    base = origin + deep * inward
    corners = np.empty((len(rect), 4, 3))
    for axis in (0, 1):
        corners[..., axis] = base[axis] + rect[:, [0, 1, 1, 0]] * along[axis]
    corners[..., 2] = base[2] + rect[:, [2, 2, 3, 3]]
    return corners


def reveals(rect: Array, deep: float, frame: Frame) -> Array:
    """(4 n, 4, 3) corners of the sides of rectangular recesses, ``deep`` metres deep."""
    front = panels(rect, 0.0, frame)
    back = panels(rect, deep, frame)
    sides = [
        np.stack([front[:, i], front[:, j], back[:, j], back[:, i]], 1)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    return np.concatenate(sides)


def wall_around(
    width: float, low: float, high: float, holes: Array, frame: Frame
) -> Mesh:
    """A wall with rectangular holes (n, 4: u0, u1, z0, z1), as a grid of rectangles between the
    holes' edges."""
    u = np.unique(np.r_[0.0, width, holes[:, :2].ravel()])
    z = np.unique(np.r_[low, high, holes[:, 2:].ravel()])
    cells = np.stack(
        [*np.meshgrid(u[:-1], z[:-1]), *np.meshgrid(u[1:], z[1:])], -1
    ).reshape(-1, 4)[:, [0, 2, 1, 3]]
    middle = (cells[:, [0, 2]] + cells[:, [1, 3]]) / 2
    inside = (middle[:, :1] > holes[:, 0]) & (middle[:, :1] < holes[:, 1])
    inside &= (middle[:, 1:] > holes[:, 2]) & (middle[:, 1:] < holes[:, 3])
    return quads(panels(cells[~inside.any(1)], 0.0, frame), WALL)


def _window(rect: Array, frame: Frame, rng: np.random.Generator) -> Mesh:
    """Recessed windows: glass, frames and sills, with a blind in front of the glass or a curtain
    behind it."""
    count = len(rect)
    recess = 0.13
    u0, u1, z0, z1 = rect.T
    middle = (u0 + u1) / 2
    bars = [
        (u0, u0 + 0.07, z0, z1),
        (u1 - 0.07, u1, z0, z1),
        (middle - 0.04, middle + 0.04, z0, z1),
        (u0, u1, z0, z0 + 0.08),
    ]
    shut = rng.choice([0, 0.12, 0.3, 0.6, 1.0], count, p=[0.4, 0.3, 0.1, 0.1, 0.1])
    blind = np.stack([u0, u1, z1 - (z1 - z0) * shut, z1], 1)
    sill = np.stack([u0 - 0.06, u1 + 0.06, z0 - 0.07, z0], 1)
    curtain = rect[rng.random(count) < 0.6] + np.array((-0.1, 0.1, -0.1, 0.1))
    return merge(
        [
            quads(panels(rect, recess, frame), GLASS),
            quads(reveals(rect, recess, frame), WALL),
            *(
                quads(panels(np.stack(bar, 1), recess - 0.02, frame), FRAME)
                for bar in bars
            ),
            quads(panels(blind, recess - 0.05, frame), BLIND),
            quads(panels(sill, -0.06, frame), SLAB),
            quads(panels(curtain, recess + 0.22, frame), ROOM),
        ]
    )


def _openings(
    plan: BuildingPlan, width: float, front: bool, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Sampled rectangles (n, 4: u0, u1, z0, z1) of the windows and of the doors of a facade."""
    count = max(1, int(width / rng.uniform(2.3, 3.3)))
    pitch = width / count
    half = min(rng.uniform(0.5, 0.85), 0.36 * pitch)
    column, level = (
        g.ravel() for g in np.meshgrid(np.arange(count), np.arange(plan.floors))
    )
    middle = (column + 0.5) * pitch
    floor = plan.plinth + level * plan.storey
    rect = np.stack(
        [
            middle - half,
            middle + half,
            floor + 0.9,
            floor + 0.9 + rng.uniform(1.15, 1.45),
        ],
        1,
    )
    keep = rng.random(len(rect)) > (0.06 if front else 0.35)
    doors = np.zeros((0, 4))
    if plan.shop and front:
        ground = level == 0
        rect[ground] = np.stack(
            [middle - 0.45 * pitch, middle + 0.45 * pitch, floor + 0.35, floor + 2.35],
            1,
        )[ground]
        keep |= ground
    if front:
        at = int(rng.integers(count))
        keep &= ~((column == at) & (level == 0))
        doors = np.array(
            [
                [
                    (at + 0.5) * pitch - 0.55,
                    (at + 0.5) * pitch + 0.55,
                    plan.plinth,
                    plan.plinth + 2.1,
                ]
            ]
        )
        if plan.balconies:
            french = (level > 0) & (column % 2 == 1)
            rect[french, 2] = floor[french] + 0.05
    return rect[keep], doors


def facade(
    plan: BuildingPlan, width: float, frame: Frame, side: int, rng: np.random.Generator
) -> Mesh:
    """The mesh of one wall with its windows and doors; side 0 is the front, 3 the back."""
    windows, doors = _openings(plan, width, side == 0, rng)
    if not plan.detail or side == 3:
        wall = quads(
            panels(np.array([[0.0, width, -1.0, plan.eaves]]), 0.0, frame), WALL
        )
        return merge([wall, quads(panels(windows, -0.01, frame), GLASS)])
    parts = [
        wall_around(
            width, plan.plinth, plan.eaves, np.concatenate([windows, doors]), frame
        ),
        quads(
            panels(np.array([[0.0, width, -1.0, plan.plinth]]), -0.02, frame), PLINTH
        ),
        _window(windows, frame, rng),
    ]
    if len(doors):
        steps = doors + np.array((-0.3, 0.3, 0, 0))
        steps[:, 2:] = -0.3, plan.plinth - 0.02
        low = panels(steps, 0.0, frame)[0, 0]
        high = panels(steps, -0.9, frame)[0, 2]
        parts += [
            quads(panels(doors, 0.25, frame), DOOR),
            quads(reveals(doors, 0.25, frame), WALL),
            boxes([np.minimum(low, high)], [np.maximum(low, high)], SLAB),
        ]
    return merge(parts)
