"""A complete stretch of road: its plan, its static world as triangles, and its movers.

Everything is sampled from a counter-based generator keyed by (seed, stretch), so that a stretch is
the same in every process and in any order of access.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.backdrop import close_ends, line_horizon, line_side_streets
from lidar_synth.lab.town.catalogue import Rng, pick
from lidar_synth.lab.town.course import Course, Relief
from lidar_synth.lab.town.furnish import furnish_street
from lidar_synth.lab.town.ground import KINDS, TownGround
from lidar_synth.lab.town.lots import paint_lots, sample_lots
from lidar_synth.lab.town.materials import SurfaceTable
from lidar_synth.lab.town.movers import Mover
from lidar_synth.lab.town.paving import pave
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.solid import Solid
from lidar_synth.lab.town.street import (
    KINDS as STREETS,
    REACH,
    SHARES,
    Street,
    sample_street,
)
from lidar_synth.lab.town.traffic import Traffic
from lidar_synth.lab.town.yards import build_lot

STRETCH_FRAMES = 20
"""Frames that share a stretch of road."""


WORLD, LIGHT, SCAN, IMAGE = range(4)
"""Purposes of random numbers; each has its own generator."""


def rng_for(
    purpose: int,
    seed: int,
    stretch: int,
    frame: int = 0,
) -> Rng:
    """The random generator for one purpose in a stretch or in one of its frames."""
    return np.random.Generator(
        np.random.Philox(key=(seed, purpose), counter=(0, 0, stretch, frame))
    )


@dataclass(frozen=True)
class World:
    """One stretch of road.

    Args:
        street: its plan.
        scene: its ground and its objects.
        triangles: (F, 3, 3) float32, metres, the static world.
        faces: (F,) int32 surface number of each triangle.
        surfaces: all surfaces, of the static world and of the movers.
        movers: vehicles, pedestrians and cyclists.
    """

    street: Street
    scene: Scene
    triangles: NDArray[np.float32]
    faces: NDArray[np.int32]
    surfaces: SurfaceTable
    movers: list[Mover]

    @cached_property
    def solid(self) -> Solid:
        """The static world as an Embree scene (built on first access, half a second)."""
        return Solid(self.triangles)


def build_world(seed: int, stretch: int, interval: float) -> World:
    """Build one stretch of a town.

    Args:
        seed: the seed of the town.
        stretch: number of the stretch, 0 and up.
        interval: seconds between neighbouring frames.
    """
    rng = rng_for(WORLD, seed, stretch)
    kind = pick(dict(zip(STREETS, SHARES, strict=True)), rng)
    times = np.arange(STRETCH_FRAMES, dtype=float) * interval
    street = sample_street(kind, float(times[-1]), rng)
    fine = (-REACH, street.length + REACH)
    bend = pick({0.0: 0.3, 1 / 500: 0.2, 1 / 220: 0.3, 1 / 150: 0.2}, rng)
    course = Course(fine[0] - 40, fine[1] + 40, bend, rng)
    relief = Relief(0.004 if rng.random() < 0.6 else 0.014, rng)
    lots = sample_lots(street, rng)
    paint = pave(street, rng)
    paint_lots(lots, paint, rng)
    edges = (paint.reach, fine, paint.rects, paint.corners)
    scene = Scene(TownGround(course, relief, street.edge, *edges))
    rows = [scene.surfaces.add(k.finish, k.raw) for k in KINDS.values()]
    scene.add_mesh(scene.ground.mesh(rng), np.array(rows, np.int32))
    for lot in lots:
        build_lot(lot, street, scene, rng)
    close_ends(street, scene, rng)
    line_side_streets(street, scene, rng)
    furnish_street(street, lots, scene, rng)
    line_horizon(street, scene, rng)
    movers = Traffic(street, scene, times, rng).movers
    mesh = scene.mesh()
    surfaces = scene.surfaces.freeze()
    return World(
        street,
        scene,
        mesh.triangles,
        mesh.slot,
        surfaces,
        movers,
    )
