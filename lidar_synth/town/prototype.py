"""One kind of object with an instance: its shape, its looks, its classes and the name of its box."""

from dataclasses import dataclass

from lidar_synth.town.materials import RGB, Finish
from lidar_synth.town.meshes import Mesh


@dataclass(frozen=True)
class Prototype:
    """One kind of object, standing on the ground at the origin and facing +x.

    Args:
        mesh: its triangles, slots numbered by place in ``finishes``.
        finishes: what each slot wears; slot 0 is repainted per object.
        name: KITTI's name of its box, "" = no box.
        raw: SemanticKITTI's class standing still, and moving.
    """

    mesh: Mesh
    finishes: tuple[Finish, ...]
    name: str
    raw: tuple[int, int]

    def painted(self, colour: RGB) -> tuple[Finish, ...]:
        """The finishes with another colour in slot 0."""
        return (Finish(self.finishes[0].material, colour), *self.finishes[1:])
