"""Walls of buildings: recessed windows with frames, blinds and curtains, and doors with steps.

A building's own frame has x along its front and y into the building; the front wall is at y = 0,
the ground at z = 0. Behind the glass are curtains, half-closed blinds or a room, so that rays
through a window hit something realistic.
"""

from dataclasses import dataclass

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import Rng
from lidar_synth.lab.town.meshes import Mesh, boxes, merge, quads

WALL, GLASS, FRAME, ROOF, DOOR, PLINTH, ROOM, RAIL, BLIND, SLAB = range(10)

Frame = tuple[Float64Array, Float64Array, Float64Array]
"""The frame of a wall: its lower left corner, and unit vectors along the wall and into the
building."""
FRONT: Frame = (np.zeros(3), np.eye(3)[0], np.eye(3)[1])
"""The frame of a front wall."""


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


def sheets(
    rect: Float64Array,
    deep: float,
    frame: Frame,
    slot: int,
) -> Mesh:
    """Rectangles (n, 4: u0, u1, z0, z1) parallel to a wall, ``deep`` metres behind it."""
    return quads(panels(rect, deep, frame), slot)


def panels(rect: Float64Array, deep: float, frame: Frame) -> Float64Array:
    """(n, 4, 3) corners of ``sheets``."""
    origin, along, inward = frame
    base = origin + deep * inward
    corners = np.empty((len(rect), 4, 3))
    for axis in (0, 1):
        corners[..., axis] = base[axis] + rect[:, [0, 1, 1, 0]] * along[axis]
    corners[..., 2] = base[2] + rect[:, [2, 2, 3, 3]]
    return corners


def reveals(rect: Float64Array, deep: float, frame: Frame) -> Mesh:
    """The sides of rectangular recesses (n, 4: u0, u1, z0, z1), ``deep`` metres deep."""
    front = panels(rect, 0.0, frame)
    back = panels(rect, deep, frame)
    sides = [
        np.stack([front[:, i], front[:, j], back[:, j], back[:, i]], 1)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    return quads(np.concatenate(sides), WALL)


def wall_around(
    width: float,
    low: float,
    high: float,
    holes: Float64Array,
    frame: Frame,
) -> Mesh:
    """A wall with rectangular holes (n, 4: u0, u1, z0, z1), as a grid of rectangles between the
    holes' edges."""
    u = np.unique(np.r_[0.0, width, holes[:, :2].ravel()])
    z = np.unique(np.r_[low, high, holes[:, 2:].ravel()])
    starts = np.meshgrid(u[:-1], z[:-1])
    ends = np.meshgrid(u[1:], z[1:])
    cells = np.stack([starts[0], ends[0], starts[1], ends[1]], -1).reshape(-1, 4)
    middle = (cells[:, [0, 2]] + cells[:, [1, 3]]) / 2
    inside = (middle[:, None] > holes[:, [0, 2]]) & (middle[:, None] < holes[:, [1, 3]])
    return sheets(cells[~inside.all(2).any(1)], 0.0, frame, WALL)


def _make_bars(rect: Float64Array, depth: float, frame: Frame) -> Mesh:
    """The left, right, middle and lower bars of the frames of windows."""
    u0, u1, z0, z1 = rect.T
    middle = (u0 + u1) / 2
    bars = [
        (u0, u0 + 0.07, z0, z1),
        (u1 - 0.07, u1, z0, z1),
        (middle - 0.04, middle + 0.04, z0, z1),
        (u0, u1, z0, z0 + 0.08),
    ]
    return merge([sheets(np.stack(bar, 1), depth, frame, FRAME) for bar in bars])


def _windows(rect: Float64Array, frame: Frame, rng: Rng) -> Mesh:
    """Recessed windows: glass, frames and sills, with a blind in front of the glass or a curtain
    behind it."""
    count = len(rect)
    recess = 0.13
    u0, u1, z0, z1 = rect.T
    shut = rng.choice([0, 0.12, 0.3, 0.6, 1.0], count, p=[0.4, 0.3, 0.1, 0.1, 0.1])
    blind = np.stack([u0, u1, z1 - (z1 - z0) * shut, z1], 1)
    sill = np.stack([u0 - 0.06, u1 + 0.06, z0 - 0.07, z0], 1)
    curtain = rect[rng.random(count) < 0.6] + (-0.1, 0.1, -0.1, 0.1)
    return merge(
        [
            sheets(rect, recess, frame, GLASS),
            reveals(rect, recess, frame),
            _make_bars(rect, recess - 0.02, frame),
            sheets(blind, recess - 0.05, frame, BLIND),
            sheets(sill, -0.06, frame, SLAB),
            sheets(curtain, recess + 0.22, frame, ROOM),
        ]
    )


def _openings(
    plan: BuildingPlan,
    width: float,
    front: bool,
    rng: Rng,
) -> tuple[Float64Array, Float64Array]:
    """Sampled rectangles (n, 4: u0, u1, z0, z1) of the windows and of the doors of a facade."""
    count = max(1, int(width / rng.uniform(2.3, 3.3)))
    pitch = width / count
    half = min(rng.uniform(0.5, 0.85), 0.36 * pitch)
    level, column = np.indices((plan.floors, count)).reshape(2, -1)
    middle = (column + 0.5) * pitch
    floor = plan.plinth + level * plan.storey
    low = floor + 0.9
    high = low + rng.uniform(1.15, 1.45)
    rect = np.stack([middle - half, middle + half, low, high], 1)
    keep = rng.random(len(rect)) > (0.06 if front else 0.35)
    if not front:
        return rect[keep], np.zeros((0, 4))
    ground = level == 0
    if plan.shop:
        wide = 0.45 * pitch
        glass = [middle - wide, middle + wide, floor + 0.35, floor + 2.35]
        rect[ground] = np.stack(glass, 1)[ground]
        keep |= ground
    place = int(rng.integers(count))
    keep &= ~((column == place) & ground)
    if plan.balconies:
        french = (level > 0) & (column % 2 == 1)
        rect[french, 2] = floor[french] + 0.05
    centre = (place + 0.5) * pitch
    door = [centre - 0.55, centre + 0.55, plan.plinth, plan.plinth + 2.1]
    return rect[keep], np.array([door])


def facade(
    plan: BuildingPlan,
    width: float,
    frame: Frame,
    side: int,
    rng: Rng,
) -> Mesh:
    """The mesh of one wall with its windows and doors; side 0 is the front, 3 the back."""
    windows, doors = _openings(plan, width, side == 0, rng)
    if not plan.detail or side == 3:
        wall = np.array([[0.0, width, -1.0, plan.eaves]])
        flat = sheets(windows, -0.01, frame, GLASS)
        return merge([sheets(wall, 0.0, frame, WALL), flat])
    holes = np.concatenate([windows, doors])
    foot = np.array([[0.0, width, -1.0, plan.plinth]])
    parts = [
        wall_around(width, plan.plinth, plan.eaves, holes, frame),
        sheets(foot, -0.02, frame, PLINTH),
        _windows(windows, frame, rng),
    ]
    if len(doors):
        parts += _entrance(doors, plan.plinth, frame)
    return merge(parts)


def _entrance(doors: Float64Array, plinth: float, frame: Frame) -> list[Mesh]:
    """Doors and the steps in front of them."""
    steps = doors + np.array((-0.3, 0.3, 0, 0))
    steps[:, 2:] = -0.3, plinth - 0.02
    low = panels(steps, 0.0, frame)[0, 0]
    high = panels(steps, -0.9, frame)[0, 2]
    return [
        sheets(doors, 0.25, frame, DOOR),
        reveals(doors, 0.25, frame),
        boxes(np.minimum(low, high), np.maximum(low, high), SLAB),
    ]
