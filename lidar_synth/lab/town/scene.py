"""A scene under construction: static objects, and objects with an instance number.

Objects are placed in street coordinates. The scene rotates them along the street, puts them on the
ground, and collects their triangles with a surface number for each.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.lab.town.furniture import StaticObject
from lidar_synth.lab.town.ground import TownGround
from lidar_synth.lab.town.materials import RGB, Finishes
from lidar_synth.lab.town.meshes import Mesh, merge
from lidar_synth.lab.town.prototype import Prototype

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedObject:
    """An object with an instance number, placed in the world: a vehicle, a person or a rider.

    Args:
        prototype: its kind.
        pose: (4, 4) from its own frame to the world.
        instance: its instance number, 1 and up, unique in the stretch.
        surfaces: the surface number of each slot of its mesh.
        scale: the scale of its prototype.
    """

    prototype: Prototype
    pose: Pose
    instance: int
    surfaces: NDArray[np.int32]
    scale: float = 1.0


@dataclass
class Scene:
    """The contents of a stretch.

    Args:
        ground: the ground of the stretch.
        surfaces: all surfaces, of static objects and of movers.
        pending: static objects that are not in ``meshes`` yet: (object, s, t, yaw, lift).
        meshes: static triangles in the world, with surface numbers as slots.
        placed: static objects with an instance number.
        footprints: (lowest s, highest s, lowest t, highest t) of obstacles, metres.
        instances: the number of instances, of static objects and of movers.
    """

    ground: TownGround
    surfaces: Finishes = field(default_factory=Finishes)
    pending: list[tuple[StaticObject, float, float, float, float]] = field(
        default_factory=list
    )
    meshes: list[Mesh] = field(default_factory=list)
    placed: list[PlacedObject] = field(default_factory=list)
    footprints: list[tuple[float, float, float, float]] = field(default_factory=list)
    instances: int = 0

    def add_mesh(self, mesh: Mesh, surfaces: NDArray[np.int32]) -> None:
        """Add a mesh in world coordinates; ``surfaces`` holds the surface number of each slot."""
        self.meshes.append(Mesh(mesh.triangles, surfaces[mesh.slot]))

    def put(
        self,
        item: StaticObject,
        s: float,
        t: float,
        yaw: float = 0.0,
        lift: float = 0.0,
        solid: float = 0.0,
    ) -> None:
        """Put a static object on the ground.

        Args:
            item: the object.
            s, t: street coordinates of its origin, metres.
            yaw: radians relative to the street's heading.
            lift: metres above the ground.
            solid: half the side of the square around its origin that pedestrians and cyclists
                avoid, metres.
        """
        self.pending.append((item, s, t, yaw, lift))
        if solid:
            self.footprints.append((s - solid, s + solid, t - solid, t + solid))

    def mesh(self) -> Mesh:
        """All static triangles in the world, with surface numbers as slots."""
        places = np.array([row[1:] for row in self.pending]).reshape(-1, 4)
        points = self.ground.points(places[:, 0], places[:, 1]) + places[:, 3:] * (
            0,
            0,
            1,
        )
        yaws = self.ground.course.heading(places[:, 0]) + places[:, 2]
        for (item, *_), point, yaw in zip(self.pending, points, yaws, strict=True):
            rows = [
                self.surfaces.add(f, raw)
                for f, raw in zip(item.finishes, item.raw, strict=True)
            ]
            self.add_mesh(item.mesh.moved(point, float(yaw)), np.array(rows, np.int32))
        self.pending.clear()
        return merge(self.meshes)

    def poses(
        self, s: ArrayLike, t: ArrayLike, yaw: ArrayLike, length: ArrayLike
    ) -> Pose:
        """(..., 4, 4) poses of objects on the ground, tilted with the ground under them.

        Args:
            s, t: street coordinates, metres.
            yaw: radians relative to the street's heading.
            length: length of the objects, metres.
        """
        s, t, yaw, half = np.broadcast_arrays(
            *(np.asarray(v, float) for v in (s, t, yaw, np.asarray(length, float) / 3))
        )
        heading = self.ground.course.heading(s) + yaw
        c = np.cos(yaw)
        d = np.sin(yaw)
        # One kind of ground under all probes: a wheel on the kerb does not tilt the whole car.
        probes = [
            (s + a * half, t + b * half)
            for a, b in ((c, d), (-c, -d), (-d, c), (d, -c))
        ]
        front, back, left, right = (self.ground.height(*p, 0) for p in probes)
        ahead = np.stack(
            [np.cos(heading), np.sin(heading), (front - back) / (2 * half)], -1
        )
        across = np.stack(
            [-np.sin(heading), np.cos(heading), (left - right) / (2 * half)], -1
        )
        up = np.cross(ahead, across)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        pose = np.zeros((*s.shape, 4, 4))
        pose[..., :3, :3] = np.stack([ahead, np.cross(up, ahead), up], -1)
        pose[..., :3, 3] = self.ground.points(s, t)
        pose[..., 3, 3] = 1
        return pose

    def add_instance(
        self, prototype: Prototype, colour: RGB, moving: bool
    ) -> tuple[int, NDArray[np.int32]]:
        """Register a new instance; return its number and the surface number of each slot."""
        self.instances += 1
        rows = [
            self.surfaces.add(f, prototype.raw[int(moving)], self.instances)
            for f in prototype.painted(colour)
        ]
        return self.instances, np.array(rows, np.int32)

    def park(
        self,
        prototype: Prototype,
        colour: RGB,
        s: float,
        t: float,
        yaw: float,
        scale: float = 1.0,
    ) -> None:
        """Put a static object with an instance number on the ground."""
        instance, surfaces = self.add_instance(prototype, colour, moving=False)
        low, high = prototype.mesh.bounds
        pose = self.poses(s, t, yaw, high[0] - low[0])
        placed = PlacedObject(prototype, pose, instance, surfaces, scale)
        self.placed.append(placed)
        self.add_mesh(prototype.mesh.moved(scale=scale).posed(pose), surfaces)
        half = (
            np.abs(np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]))
            @ (high[:2] - low[:2])
            / 2
        )
        self.footprints.append((s - half[0], s + half[0], t - half[1], t + half[1]))

    def is_free(self, s: float, t: float, half: tuple[float, float]) -> bool:
        """Whether no obstacle lies within the half extents ``half`` (along s, along t) around a
        position, metres."""
        if not self.footprints:
            return True
        f = np.array(self.footprints)
        hit = (
            (f[:, 0] < s + half[0])
            & (f[:, 1] > s - half[0])
            & (f[:, 2] < t + half[1])
            & (f[:, 3] > t - half[1])
        )
        return not hit.any()
