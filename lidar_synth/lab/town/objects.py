"""Static objects and prototypes of movable ones, each a mesh with finishes and classes.

What never changes its shape is a list of parts in the tables: of each, the function that builds it
and its arguments.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property

from lidar_synth.lab.town import bodywork, meshes
from lidar_synth.lab.town.catalogue import RGB, TABLES
from lidar_synth.lab.town.materials import Finish, read_finishes
from lidar_synth.lab.town.meshes import Mesh, merge
from lidar_synth.lab.town.solid import Solid


@dataclass(frozen=True)
class StaticObject:
    """A static object without an instance number ("stuff" in panoptic segmentation).

    Args:
        mesh: its triangles.
        finishes: the finish of each slot.
        raw: SemanticKITTI's class id of each slot.
    """

    mesh: Mesh
    finishes: tuple[Finish, ...]
    raw: tuple[int, ...]


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

    @cached_property
    def solid(self) -> Solid:
        """Its triangles for casting rays, built once per process."""
        return Solid(self.mesh.triangles)

    @property
    def length(self) -> float:
        """Metres along x."""
        low, high = self.mesh.bounds
        return float(high[0] - low[0])

    def painted(self, colour: RGB) -> tuple[Finish, ...]:
        """The finishes with slot 0 in the given colour."""
        return (Finish(self.finishes[0].material, colour), *self.finishes[1:])


@cache
def assemble(name: str) -> Mesh:
    """The mesh of an object's parts in the tables."""
    parts = []
    for function, *arguments in TABLES["parts"].get(name, ()):
        room = bodywork if hasattr(bodywork, function) else meshes
        parts.append(getattr(room, function)(*arguments))
    return merge(parts)


def make_object(
    name: str, *parts: Mesh, finishes: Mapping[int, Finish] | None = None
) -> StaticObject:
    """A static object of the tables.

    Args:
        name: its name in the tables.
        parts: meshes that come before those of the tables.
        finishes: those of some slots, in place of those of the tables.
    """
    own, raw = _surfaces(name)
    rows = dict(enumerate(own)) | dict(finishes or {})
    return StaticObject(merge([*parts, assemble(name)]), tuple(rows.values()), raw)


@cache
def _surfaces(name: str) -> tuple[tuple[Finish, ...], tuple[int, ...]]:
    """The finish and the class of each slot of an object."""
    entry = TABLES["objects"][name]
    return read_finishes(entry["finishes"]), tuple(entry["raw"])
