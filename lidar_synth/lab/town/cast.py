"""Ray casting with Embree against the static world and the movers.

The static world is one Embree scene per stretch. Each prototype of a mover is another one, built
once per process. For each frame, the few rays that can hit a mover are transformed into its own
frame, so that nothing is rebuilt.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.meshes import Mesh
from lidar_synth.lab.town.scene import PlacedObject
from lidar_synth.lab.town.solid import Solid
from lidar_synth.lab.town.world import World

Floats = NDArray[np.float32]
MISS = -1
"""Surface number of a ray that hits nothing."""


class SceneHits(NamedTuple):
    """The first hits of N rays.

    Args:
        distance: (N,) float32 metres from each ray's origin; inf where it hits nothing.
        surface: (N,) int32 surface number, or ``MISS``.
        normal: (N, 3) float32 unit normal in the world frame, of arbitrary sign.
    """

    distance: Floats
    surface: NDArray[np.int32]
    normal: Floats


class _CastShape(NamedTuple):
    """A prototype as an Embree scene, with its bounding sphere.

    It holds a reference to its mesh: ``_SHAPES`` is keyed by ``id(mesh)``, which must not be
    reused.
    """

    mesh: Mesh
    solid: Solid
    middle: Floats
    radius: float


_SHAPES: dict[int, _CastShape] = {}


def _shape(mesh: Mesh) -> _CastShape:
    shape = _SHAPES.get(id(mesh))
    if shape is None:
        low, high = mesh.bounds
        radius = float(np.linalg.norm(high - low)) / 2
        shape = _SHAPES[id(mesh)] = _CastShape(
            mesh,
            Solid(mesh.triangles),
            np.asarray((low + high) / 2, np.float32),
            radius,
        )
    return shape


class Snapshot:
    """A stretch at one moment: its static world, and its movers at their current poses.

    Args:
        world: the stretch.
        movers: the movers at this moment.
    """

    def __init__(self, world: World, movers: list[PlacedObject]) -> None:
        self._solid = world.solid
        self._faces = world.faces
        self.movers = movers
        shapes = [_shape(m.prototype.mesh) for m in movers]
        middles = [
            m.pose[:3, :3] @ (m.scale * s.middle) + m.pose[:3, 3]
            for m, s in zip(movers, shapes, strict=True)
        ]
        self._middles = np.array(middles, np.float32).reshape(-1, 3)
        self._radii = np.array(
            [m.scale * s.radius for m, s in zip(movers, shapes, strict=True)],
            np.float32,
        )

    def cast(
        self, origins: Floats, directions: Floats, eye: Floats | None = None
    ) -> SceneHits:
        """Find the first hit of each ray.

        Args:
            origins: (N, 3) metres, world frame.
            directions: (N, 3) unit vectors.
            eye: (3,) a point near the origin of every ray, such as the sensor; with it, the rays
                that can hit a mover are found faster.
        """
        distance, face, normal = self._solid.first(origins, directions)
        surface = np.where(face >= 0, self._faces[face], MISS)
        candidate_rays = (
            self._candidates_of_any_rays(origins, directions)
            if eye is None
            else self._candidates(
                directions, eye, float(np.abs(origins - eye).sum(1).max(initial=0))
            )
        )
        for mover, is_candidate in zip(self.movers, candidate_rays, strict=True):
            candidates = np.flatnonzero(is_candidate)
            if len(candidates):
                mover_distance, mover_surface, mover_normal = trace(
                    mover, origins[candidates], directions[candidates]
                )
                nearer = mover_distance < distance[candidates]
                hit = candidates[nearer]
                distance[hit], surface[hit], normal[hit] = (
                    mover_distance[nearer],
                    mover_surface[nearer],
                    mover_normal[nearer],
                )
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        normal /= np.maximum(length, 1e-12)[:, None]
        return SceneHits(distance, surface, normal)

    def _candidates(
        self, directions: Floats, eye: Floats, margin: float
    ) -> NDArray[np.bool_]:
        """(M, N) which rays that start within ``margin`` metres of ``eye`` can hit each mover's
        bounding sphere; may include a few more."""
        offset = self._middles - eye
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        sine = np.minimum(
            (self._radii[:, None] + margin) / np.maximum(distance, 1e-3), 1
        )
        smallest_cosine = np.where(sine < 0.95, np.sqrt(1 - sine * sine), -2).astype(
            np.float32
        )
        return np.asarray(
            (offset / np.maximum(distance, 1e-3)) @ directions.T > smallest_cosine
        )

    def _candidates_of_any_rays(
        self, origins: Floats, directions: Floats
    ) -> Iterator[NDArray[np.bool_]]:
        """Which of any rays can hit each mover's bounding sphere: (N,) for one mover after
        another."""
        for middle, radius in zip(self._middles, self._radii, strict=True):
            offset = middle - origins
            along = np.einsum("ij,ij->i", offset, directions)
            yield (
                np.einsum("ij,ij->i", offset, offset) - along * along < radius**2
            ) & (along > -radius)


def trace(
    placed: PlacedObject, origins: Floats, directions: Floats
) -> tuple[Floats, NDArray[np.int32], Floats]:
    """Distance (inf = no hit), surface number and normal (world frame, not unit) of rays cast at
    one object alone."""
    shape = _shape(placed.prototype.mesh)
    rotation = placed.pose[:3, :3].astype(np.float32)
    start = ((origins - placed.pose[:3, 3].astype(np.float32)) @ rotation) / np.float32(
        placed.scale
    )
    distance, face, normal = shape.solid.first(start, directions @ rotation)
    return (
        distance * np.float32(placed.scale),
        placed.surfaces[shape.mesh.slot[face]],
        normal @ rotation.T,
    )
