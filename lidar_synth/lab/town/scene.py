"""A scene under construction: static objects, and objects with an instance number.

Objects are placed in street coordinates. The scene rotates them along the street, puts them on the
ground, and collects their triangles with a surface number for each.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from lidar_synth.geometry.arrays import Float64Array, Int32Array
from lidar_synth.lab.town.catalogue import RGB
from lidar_synth.lab.town.ground import TownGround
from lidar_synth.lab.town.materials import Finishes
from lidar_synth.lab.town.meshes import Mesh, merge
from lidar_synth.lab.town.objects import Prototype, StaticObject

Pose = Float64Array


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
    surfaces: Int32Array
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

    def add_mesh(self, mesh: Mesh, surfaces: Int32Array) -> None:
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
        s, t, yaw, lift = places.T
        points = self.ground.points(s, t)
        points[:, 2] += lift
        yaws = self.ground.course.heading(s) + yaw
        for (item, *_), point, turn in zip(self.pending, points, yaws, strict=True):
            rows = list(map(self.surfaces.add, item.finishes, item.raw))
            self.add_mesh(item.mesh.moved(point, float(turn)), np.array(rows, np.int32))
        self.pending.clear()
        return merge(self.meshes)

    def poses(
        self,
        s: ArrayLike,
        t: ArrayLike,
        yaw: ArrayLike,
        length: ArrayLike,
    ) -> Pose:
        """(..., 4, 4) poses of objects on the ground, tilted with the ground under them.

        Args:
            s, t: street coordinates, metres.
            yaw: radians relative to the street's heading.
            length: length of the objects, metres.
        """
        s, t, yaw, half = np.broadcast_arrays(s, t, yaw, np.asarray(length, float) / 3)
        # One kind of ground under all probes: a wheel on the kerb does not tilt the whole car.
        c = np.cos(yaw) * half
        d = np.sin(yaw) * half
        height = self.ground.height
        rise = height(s + c, t + d, 0) - height(s - c, t - d, 0)
        bank = height(s - d, t + c, 0) - height(s + d, t - c, 0)
        heading = self.ground.course.heading(s) + yaw
        x = np.cos(heading)
        y = np.sin(heading)
        ahead = np.stack([x, y, rise / (2 * half)], -1)
        across = np.stack([-y, x, bank / (2 * half)], -1)
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
    ) -> tuple[int, Int32Array]:
        """Register a new instance; return its number and the surface number of each slot."""
        self.instances += 1
        raw = prototype.raw[int(moving)]
        rows = [
            self.surfaces.add(finish, raw, self.instances)
            for finish in prototype.painted(colour)
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
        pose = self.poses(s, t, yaw, prototype.length)
        placed = PlacedObject(prototype, pose, instance, surfaces, scale)
        self.placed.append(placed)
        self.add_mesh(prototype.mesh.moved(scale=scale).posed(pose), surfaces)
        low, high = prototype.mesh.bounds
        c = np.cos(yaw)
        d = np.sin(yaw)
        half = np.abs([(c, d), (d, c)]) @ (high[:2] - low[:2]) / 2
        self.footprints.append((s - half[0], s + half[0], t - half[1], t + half[1]))

    def is_free(self, s: float, t: float, half: float) -> bool:
        """Whether no obstacle lies in the square of ``half`` metres on each side around a
        position."""
        low_s, high_s, low_t, high_t = np.array(self.footprints).reshape(-1, 4).T
        hit = (low_s < s + half) & (high_s > s - half)
        return not (hit & (low_t < t + half) & (high_t > t - half)).any()
