"""Wet ground: a film of water reflects the pulse away from the sensor.

After Hahner et al. 2022 ("LiDAR snowfall simulation for robust 3D object detection"):
what a dry surface of reflectance p returns at an angle of incidence i passes the surface
of the water twice, and is lost by Fresnel's reflection and, as the film fills the
texture, by specular reflection below it. Returns below the sensor's noise floor vanish.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND
from lidar_synth.geometry.scan import Scan
from lidar_synth.weather.corruption import (
    FLOOR,
    Change,
    Corruption,
    move_returns,
    ranges_of,
    require_between,
    signal_of,
)

WATER = 1.33
"""Refractive index."""
TEXTURE = 1.2
"""Depth of an asphalt's texture, mm: a deeper film is a mirror."""
CELL = 4.0
"""Side of the squares in which unlabelled ground is found, metres."""
THICK = 0.3
"""Height above the lowest return of a square below which unlabelled returns are ground,
metres."""


@dataclass(frozen=True)
class WetGround(Corruption):
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
    SEVERE = {"depth": 0.2}, {"depth": 1.0}, {"depth": 1.2}

    def __post_init__(self) -> None:
        require_between("depth", self.depth, 0, 10)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        ground = find_ground(scan)
        incidence = np.abs(scan.points[:, 2]) / np.maximum(distance, 1e-6)
        passed = (1 - reflect_from_water(np.clip(incidence, 0, 1))) ** 2
        flat = min(self.depth / TEXTURE, 1.0)
        factor = np.where(ground, 1 - flat + flat * passed, 1)
        signal = signal_of(scan, distance) * factor
        nowhere = np.zeros(len(scan), bool)
        return move_returns(scan, distance, distance, signal, nowhere, signal >= FLOOR)


def reflect_from_water(cosine: NDArray[np.floating]) -> NDArray[np.float64]:
    """Fresnel's reflection of unpolarised light by water, for cosines of the angle of
    incidence."""
    inside = np.sqrt(1 - (1 - cosine**2) / WATER**2)
    across = (cosine - WATER * inside) / (cosine + WATER * inside)
    along = (inside - WATER * cosine) / (inside + WATER * cosine)
    return np.asarray((across**2 + along**2) / 2, np.float64)


def find_ground(scan: Scan) -> NDArray[np.bool_]:
    """(N,) whether points are of the ground: by their labels, or near the lowest return
    around them."""
    if scan.label is not None:
        return np.asarray(GROUND[scan.label])
    places = np.floor(scan.points[:, :2] / CELL).astype(np.int64)
    _, cell = np.unique(places, axis=0, return_inverse=True)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, scan.points[:, 2])
    return np.asarray(scan.points[:, 2] < np.minimum(lowest[cell] + THICK, 0))
