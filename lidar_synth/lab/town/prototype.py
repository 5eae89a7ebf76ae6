"""Prototypes of objects with an instance number: mesh, finishes, classes and box name."""

from dataclasses import dataclass

from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh


@dataclass(frozen=True)
class Prototype:
    """One kind of object, with its origin on the ground and its front along +x.

    Args:
        mesh: its triangles; slots are indices in ``finishes``.
        finishes: the finish of each slot; the colour of slot 0 varies per object.
        name: KITTI's class name of its box, "" = no box.
        raw: SemanticKITTI's class id when static, and when moving.
    """

    mesh: Mesh
    finishes: tuple[Finish, ...]
    name: str
    raw: tuple[int, int]

    def painted(self, colour: RGB) -> tuple[Finish, ...]:
        """The finishes with slot 0 in the given colour."""
        return (Finish(self.finishes[0].material, colour), *self.finishes[1:])
