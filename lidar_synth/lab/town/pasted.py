"""Objects of the town for pasting into other scans: each is cast anew where it is pasted, by the
rays of that scan's sensor.

Points that are moved keep the pattern of the rays, and the side, of the place where they were
recorded. A cast object has the returns that the sensor would get from it at its new place.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Boxes, Scan, Sensor, load_sensor
from lidar_synth.geometry.arrays import Float32Array, Float64Array
from lidar_synth.lab.town.boxes import box_values
from lidar_synth.lab.town.cast import MISS, SceneHits, Snapshot
from lidar_synth.lab.town.materials import SurfaceTable
from lidar_synth.lab.town.objects import Prototype
from lidar_synth.lab.town.returns import measure, see_through
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.draw import draw_objects
from lidar_synth.labels.objects import Object
from lidar_synth.noise import keyed_rng

MOMENTS = (3, 10, 17)
"""The scans of a stretch of road whose objects are taken."""
NEAR = 3.0
FAR = 60.0
"""Distances of objects from the sensor, metres."""

CYCLES = {11: "Bicycle", 15: "Motorcycle", 32: "Motorcyclist"}
"""Names of objects for which KITTI has none, by SemanticKITTI's class; only taken if asked for."""


class _Alone(Snapshot):
    """One object and nothing else, its mesh stretched to the size of a box (7,)."""

    def __init__(self, prototype: Prototype, box: NDArray[np.float32]) -> None:
        low, high = prototype.mesh.bounds
        c = np.cos(box[6])
        s = np.sin(box[6])
        self._prototype = prototype
        self._scale: Float32Array = (box[3:6] / (high - low)).astype(np.float32)
        self._turn: Float32Array = np.array(
            [
                [c, -s, 0],
                [s, c, 0],
                [0, 0, 1],
            ],
            np.float32,
        )
        middle = self._turn @ (self._scale * (low + high) / 2)
        self._shift: Float32Array = (box[:3] - middle).astype(np.float32)

    def cast(
        self,
        origins: Float32Array,
        directions: Float32Array,
        eye: Float32Array | None = None,
    ) -> SceneHits:
        """The first hit of each ray; surfaces are slots of the mesh."""
        local = origins - self._shift
        start: Float32Array = np.asarray(local @ self._turn / self._scale, np.float32)
        # A distance in multiples of the direction is the same before and after stretching.
        way = directions @ self._turn / self._scale
        ways: Float32Array = np.asarray(way, np.float32)
        distance, face, normal = self._prototype.solid.first(start, ways)
        surface = np.where(face >= 0, self._prototype.mesh.slot[face], MISS)
        turned = (normal / self._scale) @ self._turn.T
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        unit = (turned / np.maximum(length, 1e-12)).astype(np.float32)
        return SceneHits(origins, directions, distance, surface, unit)


class ObjectCaster(Town):
    """The rays, the noise and the skin of a sensor, which objects are cast with."""

    def cast_object(
        self,
        prototype: Prototype,
        surfaces: SurfaceTable,
        boxes: Boxes,
    ) -> Scan:
        """The returns of an object in one box, as a scan of it alone."""
        [box] = boxes.values
        key = np.rint(box.astype(np.float64) * 1000).astype(np.int64) & 0xFFFFFFFF
        rng = keyed_rng(0, *key.tolist())
        fired = self._towards(box)
        directions = self._rays[fired]
        origins = np.zeros_like(directions)
        origins[:, 2] = self._heights[fired]
        alone = _Alone(prototype, box)
        hits = alone.cast(origins, directions)
        see_through(alone, hits, np.zeros(3, np.float32), surfaces, rng)
        laser = self._laser[fired]
        rays, far, reflectance = measure(
            hits,
            laser,
            surfaces,
            self._gains,
            self._noise,
            rng,
        )
        points = origins[rays] + far[:, None] * directions[rays]
        boxed = np.ones(len(rays), bool)
        dressed, kept = self._dress(fired[rays], points, reflectance, boxed, rng)
        rays = rays[kept]
        return Scan(
            points[kept],
            dressed[kept],
            self.sensor,
            label=SEMANTIC_KITTI.decode(surfaces.raw)[hits.surface[rays]],
            ring=laser[rays].astype(np.int16),
            boxes=boxes,
        )

    @cached_property
    def _around(self) -> tuple[NDArray[np.intp], Float32Array]:
        """The rays twice in the order of their azimuths, and these azimuths, from -pi to 3 pi."""
        azimuth = np.arctan2(self._rays[:, 1], self._rays[:, 0])
        order = np.argsort(azimuth, kind="stable")
        both = np.concatenate([azimuth[order], azimuth[order] + np.float32(2 * np.pi)])
        return np.tile(order, 2), both

    def _towards(self, box: NDArray[np.float32]) -> NDArray[np.intp]:
        """The rays that may hit a box."""
        order, azimuths = self._around
        away = float(np.hypot(box[0], box[1]))
        # The lasers stand on the axis.
        sine = float(np.hypot(box[3], box[4])) / 2 / max(away, 1e-3)
        if sine >= 0.95:
            return np.arange(len(self._rays))
        middle = np.arctan2(box[1], box[0]) % (2 * np.pi)
        half = np.arcsin(sine) + 1e-3
        first, last = np.searchsorted(azimuths, (middle - half, middle + half))
        return np.sort(order[first:last])


@lru_cache(maxsize=4)
def _caster(sensor: Sensor, skin: str | Path | None) -> ObjectCaster:
    return ObjectCaster(0, sensor, 1, skin=skin)


@dataclass(frozen=True)
class TownShape:
    """The shape of an object: it is cast by ``shape(boxes, sensor)``.

    Args:
        prototype: its mesh.
        surfaces: the surface of each slot of the mesh.
        skin: the look of the returns, as ``load_skin`` takes it.
    """

    prototype: Prototype
    surfaces: SurfaceTable
    skin: str | Path | None = None

    def __call__(self, boxes: Boxes, sensor: Sensor) -> Scan:
        """The returns of the object in one box."""
        caster = _caster(sensor, self.skin)
        return caster.cast_object(self.prototype, self.surfaces, boxes)


@dataclass(frozen=True, repr=False, eq=False)
class TownObjects(ObjectBank):
    """Objects of the town at places of the town, each with its shape; see
    ``ObjectBank.from_town``."""

    shapes: tuple[TownShape, ...] = ()

    def __getitem__(self, index: int) -> Object:
        return super().__getitem__(index)._replace(cast=self.shapes[index])

    def draw(self, scan: Scan, boxes: Boxes) -> Scan:
        """See ``draw_objects``."""
        return draw_objects(scan, boxes, self)

    def fit_sizes(self, boxes: Boxes) -> "TownObjects":
        """The objects with the mean size of other boxes, by name; names that the others do not
        have keep theirs.

        Args:
            boxes: of the dataset that objects are pasted into, such as those of its labelled
                scans.
        """
        others = np.array(boxes.names)
        own = np.array(self.boxes.names)
        values = self.boxes.values.copy()
        for name in sorted({*others} & {*own}):
            mine = own == name
            wanted = boxes.values[others == name, 3:6].mean(0)
            factor = wanted / values[mine, 3:6].mean(0)
            floor = values[mine, 2] - values[mine, 5] / 2
            values[mine, 3:6] *= factor
            values[mine, 2] = floor + values[mine, 5] / 2
        return make_bank(replace(self.boxes, values=values), self.shapes, self.sensor)


def _choose(
    found: list[tuple[TownShape, Float64Array]], classes: Any
) -> list[tuple[str, TownShape, Float64Array]]:
    """The objects of some classes by name; None for all that KITTI has a name for."""
    named = [(name, *pair) for pair in found for name in _names(pair[0].prototype)]
    known = {name for name, _, _ in named}
    wanted = known - {*CYCLES.values()} if classes is None else {*classes}
    if unknown := sorted(wanted - known):
        raise ConfigError(
            f"classes {unknown} of the town",
            f"some of {', '.join(sorted(known))}",
            "Use more scans if a rare class is missing.",
        )
    return [one for one in named if one[0] in wanted]


def _names(prototype: Prototype) -> list[str]:
    """The names of an object's box: KITTI's, and that of ``CYCLES``."""
    names = (prototype.name, CYCLES.get(prototype.raw[0]))
    return [name for name in names if name]


def collect_objects(
    sensor: str | Path | Sensor,
    classes: Any,
    scans: int,
    seed: int,
    skin: str | Path | None,
) -> TownObjects:
    """See ``ObjectBank.from_town``."""
    found = load_sensor(sensor)
    town = ObjectCaster(seed, found, scans * STRETCH_FRAMES, 2.0, skin=skin)
    moments = tqdm(
        range(scans), "objects of the town", leave=False, disable=None, delay=2
    )
    pairs = [pair for moment in moments for pair in _at(town, moment, skin)]
    chosen = _choose(pairs, classes)
    if not chosen:
        raise DataError(f"no object in {scans} scans of the town", "objects")
    names, shapes, values = zip(*chosen, strict=True)
    return make_bank(Boxes(np.array(values, np.float32), names), shapes, found)


def _at(
    town: Town, moment: int, skin: str | Path | None
) -> Iterator[tuple[TownShape, NDArray[np.float64]]]:
    """The shapes and boxes (7,) of the objects around the sensor at a moment."""
    stretch, part = divmod(moment, len(MOMENTS))
    index = stretch * STRETCH_FRAMES + MOMENTS[part]
    movers, pose, _ = town.movers(index)
    world = town.world(index)
    to_sensor = np.linalg.inv(pose)
    for placed in (*world.scene.placed, *movers):
        box = box_values(placed, to_sensor @ placed.pose)
        if _names(placed.prototype) and NEAR < np.hypot(box[0], box[1]) < FAR:
            columns: list[Any] = [c[placed.surfaces] for c in world.surfaces]
            own = SurfaceTable(*columns)
            yield TownShape(placed.prototype, own, skin), box


def make_bank(
    boxes: Boxes, shapes: tuple[TownShape, ...], sensor: Sensor, least: int = 5
) -> TownObjects:
    """A bank of objects that are cast at the places of their boxes.

    Args:
        boxes: M boxes.
        shapes: M shapes.
        sensor: casts them.
        least: minimum number of returns; other objects are left out.
    """
    objects = []
    kept = []
    for number, shape in enumerate(shapes):
        box = boxes[[number]]
        scan = replace(shape(box, sensor), id=f"town/{number}")
        if len(scan) >= least:
            ground = float(box.values[0, 2] - box.values[0, 5] / 2)
            objects.append((number, Object(scan, ground)))
            kept.append(shape)
    if not objects:
        raise DataError(f"objects with fewer than {least} returns each", "larger ones")
    return replace(TownObjects.collect(objects), shapes=tuple(kept))
