"""The town as a source of scans: ``Town(seed)[i]`` is the same scan in every process and in any
order of access. Twenty neighbouring scans share a stretch of road. The ego vehicle drives along it,
with ``interval`` seconds from scan to scan, among static and moving objects. Stretches lie a
kilometre apart in the world frame of the poses, or more at long intervals (``Town.apart``), so that
accumulating scans by pose never mixes two of them.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, check_count
from lidar_synth.files.parsing import json_checksum
from lidar_synth.formats.calibration import Calibration
from lidar_synth.geometry import SYNTHETIC, Scan, Sensor, index_of, load_sensor
from lidar_synth.geometry.arrays import Float32Array, Int32Array
from lidar_synth.lab.town.boxes import boxes_of
from lidar_synth.lab.town.camera import CAMERA
from lidar_synth.lab.town.cast import SceneHits, Snapshot
from lidar_synth.lab.town.catalogue import TABLES_HASH, Rng
from lidar_synth.lab.town.ego import HEIGHT, free_rays, point_rays
from lidar_synth.lab.town.materials import SurfaceTable
from lidar_synth.lab.town.movers import ego_place, ego_pose, place_movers
from lidar_synth.lab.town.returns import ReturnNoise, laser_gains, measure, see_through
from lidar_synth.lab.town.scene import PlacedObject, Pose
from lidar_synth.lab.town.shading import render, sample_light
from lidar_synth.lab.town.skin.skin import Skin, load_skin
from lidar_synth.lab.town.street import FASTEST
from lidar_synth.lab.town.world import (
    IMAGE,
    LIGHT,
    SCAN,
    STRETCH_FRAMES,
    World,
    build_world,
    rng_for,
)

REVOLUTION = 0.1
"""Seconds of one turn of the sensor."""
APART = 1000.0
"""Minimum metres between the origins of two stretches in the world frame of the poses."""


class Town:
    """An indexable source of ray-cast scans of a procedural town, with labels, boxes and poses.

    Args:
        seed: of the whole town, 0 or more.
        sensor: the sensor whose rays are cast, as ``load_sensor`` takes it.
        scans: number of scans.
        interval: seconds between neighbouring scans of a stretch, 0 < interval < 60.
        noise: the measurement noise of the sensor; by default ``ReturnNoise()``, beside a skin,
            which has the lasers' gains, ``ReturnNoise(gain_std=0)``.
        motion: whether the vehicle moves while the sensor turns. The points are motion compensated,
            as SemanticKITTI's: in the frame of the scan's pose, each cast from where the sensor
            was. Other objects stand still.
        skin: the look of a real sensor's returns, as ``load_skin`` takes it; by default the
            physical model's alone. Labels, rings and boxes are the same with it; a few returns are
            missing.

    Attributes:
        apart: metres between the origins of two stretches in the world frame of the poses: more
            than the vehicle drives on one and sees at its ends.

    Raises:
        ConfigError: on a negative seed or number of scans, an interval out of range, an unknown
            sensor or skin, or a skin of another sensor.
        FileError: on a skin that cannot be read.
        DataError: on a damaged skin.
        LibraryError: if embreex is missing.

    Example:
        >>> from lidar_synth import Town
        >>> town = Town(seed=0, scans=100)
        >>> scan = town[0]
        >>> list(scan.fields())
        ['reflectance', 'label', 'raw_label', 'instance', 'ring']
        >>> "Car" in scan.boxes.names, scan.pose.shape
        (True, (4, 4))
    """

    def __init__(
        self,
        seed: int = 0,
        sensor: str | Path | Sensor = "town",
        scans: int = 1000,
        interval: float = 0.4,
        noise: ReturnNoise | None = None,
        motion: bool = True,
        skin: str | Path | Skin | None = None,
    ) -> None:
        check_count("seed", seed, 0)
        check_count("scans", scans, 0)
        if not 0 < interval < 60:
            raise ConfigError(f"interval {interval}", "0 < interval < 60 s")
        self.seed = int(seed)
        self.sensor = load_sensor(sensor)
        self.interval = interval
        self.skin = None if skin is None else load_skin(skin)
        if self.skin is not None:
            self.skin.check(self.sensor)
        # A skin has the offsets of the real lasers.
        self._noise = noise or (ReturnNoise(gain_std=0) if self.skin else ReturnNoise())
        driven = STRETCH_FRAMES * interval * FASTEST
        self.apart = max(APART, driven + 2 * self.sensor.range_max)
        self._scans = int(scans)
        self._motion = motion
        self._worlds: dict[int, World] = {}
        self._fire()
        self._gains = laser_gains(self.sensor, self._noise)

    def _fire(self) -> None:
        """The rays of one turn, in the order in which the sensor writes points: ring by ring from
        the top, counter-clockwise from straight ahead."""
        elevation, height = self.sensor.optics()
        azimuths = self.sensor.firing_azimuths()
        order = np.argsort(-azimuths % (2 * np.pi), axis=1)
        free = np.take_along_axis(free_rays(self.sensor), order, 1)
        self._laser, place = np.nonzero(free)
        azimuth = azimuths[self._laser, order[self._laser, place]]
        rays = point_rays(azimuth, elevation[self._laser])
        self._rays = rays.astype(np.float32)
        self._heights = height[self._laser].astype(np.float32)
        # It turns counter-clockwise and looks straight ahead at the moment of the pose.
        turned = -(azimuth + np.pi) % (2 * np.pi) / (2 * np.pi) - 0.5
        self._turned = turned.astype(np.float32)

    def __reduce__(self) -> tuple[type["Town"], tuple[object, ...]]:
        return Town, (
            self.seed,
            self.sensor,
            self._scans,
            self.interval,
            self._noise,
            self._motion,
            self.skin,
        )

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the scans come from: the town's seed and interval, and its skin with the licence of
        that."""
        made = {"made_by": "town", "seed": self.seed, "interval": self.interval}
        if self.skin is None:
            return made
        licence = self.skin.provenance["licence"]
        return made | {"skin": self.skin.digest, "skin_licence": licence}

    @property
    def settings(self) -> dict[str, Any]:
        """Plain values that determine the scans, apart from their number."""
        return {
            "seed": self.seed,
            "interval": self.interval,
            "sensor": self.sensor.to_dict(),
            "noise": asdict(self._noise),
            "motion": self._motion,
            "skin": self.skin and self.skin.digest,
            "tables": TABLES_HASH,
        }

    @property
    def identity(self) -> str:
        """A text that tells it from other towns."""
        return f"town:{len(self)}:{json_checksum(self.settings)[:16]}"

    @property
    def calibration(self) -> Calibration:
        """The calibration of the camera next to the sensor."""
        return CAMERA

    def __repr__(self) -> str:
        scans = f"{len(self)} scans, {self.interval:g} s apart"
        return f"Town of seed {self.seed}: {scans}\n  sensor {self.sensor.grid_text()}"

    def __len__(self) -> int:
        return self._scans

    def world(self, index: int) -> World:
        """The stretch of road of a scan; the last two stretches are cached."""
        stretch = index // STRETCH_FRAMES
        if stretch not in self._worlds:
            self._worlds = dict(list(self._worlds.items())[-1:])
            self._worlds[stretch] = build_world(self.seed, stretch, self.interval)
        return self._worlds[stretch]

    def moment(self, index: int) -> tuple[Snapshot, Pose, Rng]:
        """The scene of a scan, the sensor's pose in its stretch, and the random generator of the
        scan."""
        movers, pose, rng = self.movers(index)
        return Snapshot(self.world(index), movers), pose, rng

    def movers(self, index: int) -> tuple[list[PlacedObject], Pose, Rng]:
        """As ``moment``, without what rays are cast against, which takes half of its time."""
        stretch, frame = divmod(index, STRETCH_FRAMES)
        rng = rng_for(SCAN, self.seed, stretch, frame)
        world = self.world(index)
        time = frame * self.interval
        sway = rng.normal(0, 0.003, 2)
        pose = ego_pose(world.street, world.scene, time, HEIGHT, sway)
        about = ego_place(world.street, time)[:2]
        reach = self.sensor.range_max + 20
        movers = place_movers(world.movers, world.scene, time, about, reach)
        return movers, pose, rng

    def image(self, index: int) -> NDArray[np.uint8]:
        """(376, 1408, 3) uint8 RGB, the image that the camera of ``calibration`` takes with scan
        ``index``.

        Raises:
            TypeError, IndexError: as ``index_of``.
        """
        index = index_of(index, len(self))
        snapshot, pose, _ = self.moment(index)
        stretch, frame = divmod(index, STRETCH_FRAMES)
        light = sample_light(rng_for(LIGHT, self.seed, stretch))
        rng = rng_for(IMAGE, self.seed, stretch, frame)
        return render(snapshot, pose, self.world(index).surfaces, light, rng)

    def __getitem__(self, index: int) -> Scan:
        """Scan number ``index``, which may count from the end.

        Raises:
            TypeError, IndexError: as ``index_of``.
        """
        index = index_of(index, len(self))
        snapshot, pose, rng = self.moment(index)
        world = self.world(index)
        travelled = self._travelled(index)
        rays, surface, points, reflectance = self._turn(
            snapshot, pose, travelled, world.surfaces, rng
        )
        raw = world.surfaces.raw[surface]
        instance = world.surfaces.instance[surface]
        returned = set(instance.tolist())
        objects = [
            o
            for o in (*world.scene.placed, *snapshot.movers)
            if o.prototype.name and o.instance in returned
        ]
        placed = pose.copy()
        placed[0, 3] += self.apart * (index // STRETCH_FRAMES)
        return Scan(
            points=points,
            reflectance=reflectance,
            sensor=self.sensor,
            label=SEMANTIC_KITTI.decode(world.surfaces.raw)[surface],
            raw_label=raw | instance.astype(np.uint32) << np.uint32(16),
            instance=instance,
            ring=self._laser[rays].astype(np.int16),
            boxes=boxes_of(objects, pose, snapshot),
            pose=placed,
            id=f"town-{self.seed}-{index:06d}",
            domain=SYNTHETIC,
            provenance=self.provenance,
        )

    def _travelled(self, index: int) -> Float32Array:
        """(3,) metres that the ego vehicle drives during the revolution of a scan, in the world
        frame."""
        world = self.world(index)
        time = index % STRETCH_FRAMES * self.interval
        still = np.zeros(2)
        half = REVOLUTION / 2 if self._motion else 0.0
        before, after = (
            ego_pose(world.street, world.scene, time + t, HEIGHT, still)
            for t in (-half, half)
        )
        return (after - before)[:3, 3].astype(np.float32)

    def _turn(
        self,
        snapshot: Snapshot,
        pose: Pose,
        travelled: Float32Array,
        surfaces: SurfaceTable,
        rng: Rng,
    ) -> tuple[NDArray[np.intp], Int32Array, Float32Array, Float32Array]:
        """Ray, surface number, point in the sensor frame and reflectance of each return of one
        revolution.

        The vehicle moves while the sensor turns; the points are in the frame of ``pose``, as motion
        compensated scans.
        """
        moved = self._turned[:, None] * travelled
        hits = self._cast(snapshot, pose, moved, surfaces, rng)
        rays, far, reflectance = measure(
            hits, self._laser, surfaces, self._gains, self._noise, rng
        )
        points = far[:, None] * self._rays[rays]
        points[:, 2] += self._heights[rays]
        points += moved[rays] @ pose[:3, :3].astype(np.float32)
        surface = hits.surface[rays]
        boxed = surfaces.instance[surface] > 0
        dressed, kept = self._dress(rays, points, reflectance, boxed, rng)
        return rays[kept], surface[kept], points[kept], dressed[kept]

    def _cast(
        self,
        snapshot: Snapshot,
        pose: Pose,
        moved: Float32Array,
        surfaces: SurfaceTable,
        rng: Rng,
    ) -> SceneHits:
        """The hits of the rays of one revolution, with those behind what they see through."""
        turn = pose[:3, :3].astype(np.float32)
        eye = pose[:3, 3].astype(np.float32)
        origins = eye + moved + self._heights[:, None] * turn[:, 2]
        hits = snapshot.cast(origins, self._rays @ turn.T, eye)
        see_through(snapshot, hits, eye, surfaces, rng)
        return hits

    def _dress(
        self,
        rays: NDArray[np.intp],
        points: Float32Array,
        reflectance: Float32Array,
        boxed: NDArray[np.bool_],
        rng: Rng,
    ) -> tuple[Float32Array, NDArray[np.bool_]]:
        """Move returns along their rays as the skin does; their reflectance with it, and which of
        them are left, within the sensor's range."""
        kept = np.ones(len(rays), bool)
        if self.skin is not None:
            laser = self._laser[rays]
            dressed = self.skin.apply(points, reflectance, laser, boxed, rng)
            points += dressed.shift[:, None] * self._rays[rays]
            reflectance = dressed.reflectance
            kept = dressed.kept
        distance = np.sqrt(np.einsum("ij,ij->i", points, points))
        kept &= distance >= self.sensor.range_min
        kept &= distance <= self.sensor.range_max
        return reflectance, kept
