"""Materials, as a 905 nm laser and as a camera see them, and the table of all surfaces of a scene.

Reflectance is in the unit of the KITTI datasets (0..1, neither albedo nor calibrated). The values
are fitted so that each class of the town has the reflectance that it has in labelled street scans
at 10 to 25 m.
"""

from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.catalogue import RGB, TABLES


class Material(NamedTuple):
    """One material.

    Args:
        reflectance: of a face towards the sensor within 20 m, before the sensor's response.
        speckle: standard deviation of the measured reflectance between returns.
        gloss: how specular it is, 0..1; glossy faces return little unless they face the sensor.
        transmission: share of rays that pass through it.
        dropout: share of rays that never return.
        roughness: metres, standard deviation of the surface about its triangle, from return to
            return.
        relief: metres, standard deviation of its bumps between 0.1 and 1.3 m wide.
        grazing: how far its facets turn away from its triangle, added to the cosine of the angle of
            incidence: 0 for a smooth surface, 1 for leaves, which look alike from all sides.
        colour: RGB in 0..1 for the camera.
        grain: strength of its texture in the camera image.
        colour_dependent: whether a darker finish also reflects less at 905 nm.
    """

    reflectance: float
    speckle: float = 0.05
    gloss: float = 0.0
    transmission: float = 0.0
    dropout: float = 0.0
    roughness: float = 0.0
    relief: float = 0.0
    grazing: float = 0.0
    colour: RGB = (0.5, 0.5, 0.5)
    grain: float = 0.1
    colour_dependent: bool = False


MATERIALS = {
    name: Material(**{**row, "colour": tuple(row["colour"])})
    for name, row in TABLES["materials"].items()
}
"""The materials by name."""

INDEX = {name: i for i, name in enumerate(MATERIALS)}
"""The number of each material by name."""


def column(name: str) -> NDArray[np.float32]:
    """One property of all materials, indexed by material number."""
    return np.array([getattr(m, name) for m in MATERIALS.values()], np.float32)


class Finish(NamedTuple):
    """The finish of a slot: a material and, unless it is the material's own, a colour."""

    material: str
    colour: RGB | None = None


def read_finishes(rows: list[list[Any]]) -> tuple[Finish, ...]:
    """Finishes as the tables have them: a material, and the values of its colour."""
    return tuple(Finish(material, (*colour,) or None) for material, *colour in rows)


@cache
def _reflectance(finish: Finish) -> float:
    material = MATERIALS[finish.material]
    if finish.colour is None or not material.colour_dependent:
        return material.reflectance
    # Dark paints are mostly dark at 905 nm too; red ones are bright.
    red, green, blue = finish.colour
    bright = 0.55 * red + 0.3 * green + 0.15 * blue
    low = 0.03 if material.gloss > 0.5 else 0.45
    return material.reflectance * (low + (1.15 - low) * min(1.0, bright / 0.75))


@dataclass
class Finishes:
    """All surfaces of a scene, each a finish on one object; triangles refer to surfaces by number.

    ``freeze`` returns them as columns, for lookups by the surface numbers of ray hits.
    """

    rows: list[tuple[int, int, int, float, RGB]] = field(default_factory=list)

    def add(self, finish: Finish, raw: int, instance: int = 0) -> int:
        """Add a surface and return its number.

        Args:
            finish: its material and colour.
            raw: SemanticKITTI's class id.
            instance: instance number of its object, 0 = none.
        """
        colour = finish.colour or MATERIALS[finish.material].colour
        self.rows.append(
            (INDEX[finish.material], raw, instance, _reflectance(finish), colour)
        )
        return len(self.rows) - 1

    def freeze(self) -> "SurfaceTable":
        """The surfaces as columns."""
        columns = zip(*self.rows, strict=True)
        return SurfaceTable(*map(np.array, columns, _TYPES))


class SurfaceTable(NamedTuple):
    """All surfaces as columns, indexed by surface number.

    Args:
        material: (S,) uint8, index in ``MATERIALS``.
        raw: (S,) uint32 SemanticKITTI class id.
        instance: (S,) int32, 0 = none.
        reflectance: (S,) float32.
        colour: (S, 3) float32 RGB.
    """

    material: NDArray[np.uint8]
    raw: NDArray[np.uint32]
    instance: NDArray[np.int32]
    reflectance: NDArray[np.float32]
    colour: NDArray[np.float32]


_TYPES = (np.uint8, np.uint32, np.int32, np.float32, np.float32)
"""Types of the columns of ``SurfaceTable``."""
