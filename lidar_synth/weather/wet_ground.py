"""Wet ground: a film of water reflects the pulse away from the sensor.

After Hahner et al. 2022 ("LiDAR snowfall simulation for robust 3D object detection"):
the pulse passes the surface of the water twice and loses a part by Fresnel reflection
each time. The more the film fills the texture of the ground, the more is also lost by
specular reflection. Returns below the sensor's noise floor vanish.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, has_ground
from lidar_synth.geometry import Scan
from lidar_synth.weather.corruption import Change, require_between
from lidar_synth.weather.signal import SignalLoss, ranges_of

WATER = 1.33
"""Refractive index."""
TEXTURE = 1.2
"""Depth of the texture of asphalt, mm; a deeper film is a mirror."""
CELL = 4.0
"""Side of the squares in which unlabelled ground is found, metres."""
SIDE = 64
"""Number of squares on each side of the area in which it is looked for."""
THICK = 0.3
"""Height above the lowest return of a square below which unlabelled returns are ground,
metres."""


@dataclass(frozen=True)
class WetGround(SignalLoss):
    """Wet ground.

    Args:
        depth: of the film of water, mm.

    Raises:
        ConfigError: on a depth outside 0 to 10 mm.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import WetGround
        >>> scan = Town(seed=0, scans=1)[0]
        >>> len(WetGround(depth=1.0)(scan, np.random.default_rng(0))) < len(scan)
        True
    """

    depth: float
    name = "wet_ground"
    SEVERE = {"depth": 0.2}, {"depth": 1.0}, {"depth": 1.2}

    def __post_init__(self) -> None:
        require_between("depth", self.depth, 0, 10)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        left = np.ones(len(scan), np.float32)
        ground = np.flatnonzero(find_ground(scan))
        incidence = np.abs(scan.points[ground, 2]) / distance[ground]
        passed = (1 - reflect_from_water(np.minimum(incidence, 1))) ** 2
        flat = min(self.depth / TEXTURE, 1.0)
        left[ground] = 1 - flat + flat * passed
        return self.attenuate(scan, distance, left, rng)


def reflect_from_water(cosine: NDArray[np.floating]) -> NDArray[np.floating]:
    """Fresnel's reflection of unpolarised light by water, for cosines of the angle of
    incidence."""
    inside = np.sqrt(1 - (1 - cosine**2) / WATER**2)
    across = (cosine - WATER * inside) / (cosine + WATER * inside)
    along = (inside - WATER * cosine) / (inside + WATER * cosine)
    return np.asarray((across**2 + along**2) / 2)


def find_ground(scan: Scan) -> NDArray[np.bool_]:
    """(N,) whether points are of the ground: by their labels, or near the lowest return
    around them."""
    if has_ground(scan.label):
        return np.asarray(GROUND[scan.label])
    height = scan.points[:, 2]
    column = np.clip(scan.points[:, :2] / CELL + SIDE / 2, 0, SIDE - 1).astype(np.int64)
    cell = column[:, 0] * SIDE + column[:, 1]
    lowest = np.full(SIDE * SIDE, np.inf)
    np.minimum.at(lowest, cell, height)
    return np.asarray(height < np.minimum(lowest[cell] + THICK, 0))
