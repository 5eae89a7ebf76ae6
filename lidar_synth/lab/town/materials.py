"""Materials, as a 905 nm laser and as a camera see them, and the table of all surfaces of a scene.

Reflectance is in the unit of the KITTI datasets (0..1, neither albedo nor calibrated). The values
are fitted so that each class of the town has the reflectance that it has in labelled street scans
at 10 to 25 m.
"""

from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RGB = tuple[float, float, float]


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


MATERIALS: dict[str, Material] = {
    "asphalt": Material(
        0.296, 0.028, roughness=0.0005, colour=(0.27, 0.27, 0.28), grain=0.18
    ),
    "marking": Material(0.5, 0.06, roughness=0.0005, colour=(0.82, 0.82, 0.8)),
    "paving": Material(
        0.325,
        0.03,
        roughness=0.0006,
        grazing=0.02,
        colour=(0.5, 0.48, 0.46),
        grain=0.14,
    ),
    "cobble": Material(
        0.305,
        0.035,
        roughness=0.002,
        grazing=0.03,
        colour=(0.42, 0.4, 0.39),
        grain=0.25,
    ),
    "kerbstone": Material(
        0.315, 0.035, roughness=0.0008, grazing=0.02, colour=(0.56, 0.55, 0.53)
    ),
    "grass": Material(
        0.365,
        0.052,
        roughness=0.0036,
        relief=0.07,
        grazing=0.12,
        colour=(0.3, 0.37, 0.17),
        grain=0.5,
    ),
    "soil": Material(
        0.35,
        0.05,
        roughness=0.0035,
        relief=0.07,
        grazing=0.1,
        colour=(0.41, 0.33, 0.23),
        grain=0.35,
    ),
    "gravel": Material(
        0.315,
        0.03,
        roughness=0.0022,
        relief=0.02,
        grazing=0.06,
        colour=(0.55, 0.52, 0.48),
        grain=0.3,
    ),
    "render": Material(
        0.42,
        0.035,
        gloss=0.03,
        roughness=0.0008,
        colour=(0.86, 0.84, 0.79),
        grain=0.06,
        colour_dependent=True,
    ),
    "brick": Material(
        0.36, 0.04, roughness=0.0015, colour=(0.55, 0.28, 0.2), grain=0.15
    ),
    "concrete": Material(
        0.35, 0.03, roughness=0.001, colour=(0.58, 0.57, 0.55), grain=0.12
    ),
    "stone": Material(0.37, 0.05, roughness=0.003, colour=(0.5, 0.45, 0.4), grain=0.3),
    "tile": Material(
        0.34, 0.05, roughness=0.002, grazing=0.05, colour=(0.45, 0.21, 0.15), grain=0.15
    ),
    "wood": Material(
        0.38,
        0.05,
        roughness=0.002,
        colour=(0.45, 0.31, 0.19),
        grain=0.18,
        colour_dependent=True,
    ),
    "plastic": Material(
        0.31,
        0.05,
        gloss=0.15,
        dropout=0.01,
        colour=(0.25, 0.25, 0.26),
        grain=0.03,
        colour_dependent=True,
    ),
    "metal": Material(
        0.42,
        0.08,
        gloss=0.45,
        dropout=0.04,
        colour=(0.52, 0.54, 0.55),
        grain=0.05,
        colour_dependent=True,
    ),
    "wire": Material(
        0.3, 0.08, transmission=0.8, roughness=0.003, colour=(0.35, 0.42, 0.36)
    ),
    "paint": Material(
        0.52,
        0.05,
        gloss=0.75,
        dropout=0.015,
        colour=(0.6, 0.6, 0.62),
        grain=0.0,
        colour_dependent=True,
    ),
    "glass": Material(
        0.22,
        0.05,
        gloss=0.6,
        transmission=0.45,
        dropout=0.5,
        colour=(0.1, 0.12, 0.14),
        grain=0.0,
    ),
    "carglass": Material(
        0.15,
        0.03,
        gloss=0.9,
        transmission=0.1,
        dropout=0.9,
        colour=(0.06, 0.07, 0.08),
        grain=0.0,
    ),
    "tyre": Material(0.21, 0.03, gloss=0.1, dropout=0.08, colour=(0.06, 0.06, 0.065)),
    "interior": Material(0.25, 0.04, gloss=0.1, dropout=0.2, colour=(0.11, 0.1, 0.1)),
    "curtain": Material(0.4, 0.05, roughness=0.002, colour=(0.78, 0.76, 0.72)),
    "plate": Material(0.9, 0.1, colour=(0.85, 0.85, 0.82), grain=0.0),
    "sign": Material(0.8, 0.15, colour=(0.8, 0.8, 0.8), grain=0.0),
    "lamp": Material(
        0.38, 0.15, gloss=0.3, dropout=0.1, colour=(0.85, 0.85, 0.8), grain=0.0
    ),
    "leaf": Material(
        0.365,
        0.085,
        transmission=0.35,
        dropout=0.006,
        roughness=0.08,
        relief=0.4,
        grazing=1.0,
        colour=(0.19, 0.33, 0.1),
        grain=0.5,
    ),
    "foliage": Material(
        0.355,
        0.085,
        roughness=0.08,
        relief=0.4,
        grazing=1.0,
        colour=(0.12, 0.21, 0.07),
        grain=0.6,
    ),
    "bark": Material(
        0.39, 0.08, roughness=0.003, colour=(0.33, 0.27, 0.21), grain=0.45
    ),
    "cloth": Material(
        0.4,
        0.06,
        dropout=0.01,
        colour=(0.3, 0.3, 0.4),
        grain=0.12,
        colour_dependent=True,
    ),
    "skin": Material(0.4, 0.05, colour=(0.78, 0.58, 0.47), grain=0.05),
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


@cache
def _reflectance(finish: Finish) -> float:
    material = MATERIALS[finish.material]
    if finish.colour is None or not material.colour_dependent:
        return material.reflectance
    # Dark paints and cloths are mostly dark at 905 nm too; red ones are bright.
    bright = 0.55 * finish.colour[0] + 0.3 * finish.colour[1] + 0.15 * finish.colour[2]
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
        material, raw, instance, reflectance, colour = zip(*self.rows, strict=True)
        return SurfaceTable(
            np.array(material, np.uint8),
            np.array(raw, np.uint32),
            np.array(instance, np.int32),
            np.array(reflectance, np.float32),
            np.array(colour, np.float32),
        )


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
