"""Ray casting with Embree against the static world and the movers.

The static world is one Embree scene per stretch. Each prototype of a mover is another one, built
once per process. For each frame, the few rays that can hit a mover are transformed into its own
frame, so that nothing is rebuilt.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float32Array, Int32Array
from lidar_synth.lab.town.scene import PlacedObject
from lidar_synth.lab.town.world import World

MISS = -1
"""Surface number of a ray that hits nothing."""


class SceneHits(NamedTuple):
    """The first hits of N rays.

    Args:
        origins: (N, 3) metres, world frame.
        directions: (N, 3) unit vectors.
        distance: (N,) float32 metres from each ray's origin; inf where it hits nothing.
        surface: (N,) int32 surface number, or ``MISS``.
        normal: (N, 3) float32 unit normal in the world frame, of arbitrary sign.
    """

    origins: Float32Array
    directions: Float32Array
    distance: Float32Array
    surface: Int32Array
    normal: Float32Array

    def found(self) -> NDArray[np.intp]:
        """The rays that hit something."""
        return np.flatnonzero(self.surface != MISS)

    def places(self, rays: NDArray[np.intp]) -> Float32Array:
        """(K, 3) where some rays hit, metres, world frame."""
        way = self.distance[rays, None] * self.directions[rays]
        return np.asarray(self.origins[rays] + way)


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
        middles = []
        radii = []
        for m in movers:
            middle, radius = m.prototype.mesh.sphere
            middles.append(m.pose[:3, :3] @ (m.scale * middle) + m.pose[:3, 3])
            radii.append(m.scale * radius)
        self._middles = np.array(middles, np.float32).reshape(-1, 3)
        self._radii = np.array(radii, np.float32)

    def cast(
        self,
        origins: Float32Array,
        directions: Float32Array,
        eye: Float32Array | None = None,
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
        near = self._find_near(origins, directions, eye)
        for mover, candidates in zip(self.movers, near, strict=True):
            rays = np.flatnonzero(candidates)
            if len(rays):
                found = trace(mover, origins[rays], directions[rays])
                nearer = found[0] < distance[rays]
                for own, values in zip((distance, surface, normal), found, strict=True):
                    own[rays[nearer]] = values[nearer]
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        normal /= np.maximum(length, 1e-12)[:, None]
        return SceneHits(origins, directions, distance, surface, normal)

    def cast_on(
        self,
        hits: SceneHits,
        rays: NDArray[np.intp],
        step: float,
        eye: Float32Array,
    ) -> NDArray[np.intp]:
        """Continue some rays, in place, from ``step`` metres behind their hits; return those that
        hit something again."""
        start = hits.distance[rays] + np.float32(step)
        directions = hits.directions[rays]
        origins = hits.origins[rays] + start[:, None] * directions
        beyond = self.cast(origins, directions, eye)
        hits.distance[rays] = start + beyond.distance
        hits.surface[rays] = beyond.surface
        hits.normal[rays] = beyond.normal
        return np.asarray(rays[beyond.surface != MISS])

    def _find_near(
        self, origins: Float32Array, directions: Float32Array, eye: Float32Array | None
    ) -> Iterable[NDArray[np.bool_]]:
        """Which rays can hit each mover, (N,) for one after another; may include a few more."""
        if eye is None:
            return self._near_any(origins, directions)
        margin = float(np.abs(origins - eye).sum(1).max(initial=0))
        return self._near_from(directions, eye, margin)

    def _near_from(
        self, directions: Float32Array, eye: Float32Array, margin: float
    ) -> NDArray[np.bool_]:
        """(M, N) which rays that start within ``margin`` metres of ``eye`` can hit each mover's
        bounding sphere; may include a few more."""
        offset = self._middles - eye
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        far = np.maximum(distance, 1e-3)
        sine = np.minimum((self._radii[:, None] + margin) / far, 1)
        cosine = np.where(sine < 0.95, np.sqrt(1 - sine * sine), -2)
        return np.asarray((offset / far) @ directions.T > cosine.astype(np.float32))

    def _near_any(
        self, origins: Float32Array, directions: Float32Array
    ) -> Iterator[NDArray[np.bool_]]:
        """Which of any rays can hit each mover's bounding sphere: (N,) for one mover after
        another."""
        for middle, radius in zip(self._middles, self._radii, strict=True):
            offset = middle - origins
            along = np.einsum("ij,ij->i", offset, directions)
            across = np.einsum("ij,ij->i", offset, offset) - along * along
            yield (across < radius**2) & (along > -radius)


def trace(
    placed: PlacedObject, origins: Float32Array, directions: Float32Array
) -> tuple[Float32Array, Int32Array, Float32Array]:
    """Distance (inf = no hit), surface number and normal (world frame, not unit) of rays cast at
    one object alone."""
    prototype = placed.prototype
    turn = placed.pose[:3, :3].astype(np.float32)
    scale = np.float32(placed.scale)
    start = ((origins - placed.pose[:3, 3].astype(np.float32)) @ turn) / scale
    distance, face, normal = prototype.solid.first(start, directions @ turn)
    surface = placed.surfaces[prototype.mesh.slot[face]]
    return distance * scale, surface, normal @ turn.T
