"""One object of every kind that the town has, for the boxes of layouts: no street is built."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, Sensor, load_sensor
from lidar_synth.lab.town.bodies import PHASES, cyclist, motorcyclist, sitter, walker
from lidar_synth.lab.town.catalogue import pick_colour
from lidar_synth.lab.town.ego import HEIGHT
from lidar_synth.lab.town.materials import Finishes, SurfaceTable
from lidar_synth.lab.town.objects import Prototype
from lidar_synth.lab.town.pasted import TownObjects, TownShape, make_bank
from lidar_synth.lab.town.vehicles import FINISHES, vehicles
from lidar_synth.noise import keyed_rng

SCALES = (0.7, 0.85, 1.0)
"""Sizes of pedestrians: a small one walks as a tall one does."""

GAP = 8.0
"""Metres between the sensor and the objects of the bank, which are cast once there."""


def collect_shapes(
    sensor: str | Path | Sensor, skin: str | Path | None = None
) -> TownObjects:
    """See ``ObjectBank.from_town_shapes``."""
    kinds = list(_kinds())
    values = np.array([_in_front(*kind) for kind in kinds], np.float32)
    boxes = Boxes(values, tuple(kind.name for kind, _ in kinds))
    surfaces = [_paint(kind, number) for number, (kind, _) in enumerate(kinds)]
    shapes = [
        TownShape(kind, own, skin)
        for (kind, _), own in zip(kinds, surfaces, strict=True)
    ]
    return make_bank(boxes, tuple(shapes), load_sensor(sensor), least=1)


def _kinds() -> Iterator[tuple[Prototype, float]]:
    """Every prototype that has a box, and its scales."""
    rider = motorcyclist()
    kinds = [
        *vehicles().values(),
        sitter(),
        rider,
        replace(rider, name="Motorcyclist"),
        *map(cyclist, range(PHASES)),
    ]
    yield from ((kind, 1.0) for kind in kinds if kind.name)
    for bag in (False, True):
        for standing in (False, True):
            for phase in range(PHASES):
                for scale in SCALES:
                    yield walker(phase, standing, bag), scale


def _in_front(kind: Prototype, scale: float) -> NDArray[np.float64]:
    """(7,) the box of an object that stands across the road in front of the sensor."""
    low, high = kind.mesh.bounds
    size = scale * (high - low)
    middle = (GAP + size[1] / 2, 0.0, size[2] / 2 - HEIGHT)
    return np.array([*middle, *size, np.pi / 2])


def _paint(kind: Prototype, number: int) -> SurfaceTable:
    """The surfaces of an object, in a colour of its own."""
    palette = "paints" if kind.finishes == FINISHES else "clothes"
    colour = pick_colour(palette, keyed_rng(number))
    finishes = Finishes()
    for finish in kind.painted(colour):
        finishes.add(finish, kind.raw[0])
    return finishes.freeze()
