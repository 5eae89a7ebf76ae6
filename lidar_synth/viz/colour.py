"""How a quantity becomes a colour: one table of 256 colours, and where its ends lie.

The same tables colour the range images, the renderer, the colour bars and (as a texture) the viewer of the
HTML page, so that a colour means the same wherever it is seen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.datasets.classes import COLOURS
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan

Rgb = NDArray[np.uint8]
"""(..., 3) red, green, blue."""

EMPTY = np.array([16, 18, 24], np.uint8)
"""Where there is no return; the background of every picture."""

UNLABELLED = np.array([96, 100, 110], np.uint8)
"""Of label 255 = ignore."""

DOMAINS = {"real": (92, 172, 255), "synthetic": (255, 162, 64)}
"""Name and colour by ``Scan.domain``."""


@dataclass(frozen=True)
class Scale:
    """What the colours of one quantity mean.

    Args:
        title: the quantity with its unit, for people.
        table: (256, 3) uint8 colours.
        low: the value of the first colour; anything below has it too.
        high: the value of the last colour; anything above has it too.
        gamma: position in the table = ((value - low) / (high - low)) ** gamma; below 1 it gives the low
            values, where most of a scan is, more of the table.
        classes: the values are places in the table (0..255), not points on a scale.
    """

    title: str
    table: Rgb
    low: float = 0.0
    high: float = 255.0
    gamma: float = 1.0
    classes: bool = False

    def index(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Place in the table of each value, any shape."""
        if self.classes:
            return values.astype(np.uint8)
        unit: NDArray[np.float32] = np.clip((np.asarray(values, np.float32) - self.low) / (self.high - self.low), 0, 1)
        places: NDArray[np.uint8] = np.rint(unit**self.gamma * 255).astype(np.uint8)
        return places

    def __call__(self, values: NDArray[Any]) -> Rgb:
        """(..., 3) colours of the values."""
        colours: Rgb = self.table[self.index(values)]
        return colours


@lru_cache(maxsize=8)
def _map(name: str, start: float, stop: float = 1.0) -> Rgb:
    """A part of one of matplotlib's maps: none of them may begin as dark as what is empty."""
    from matplotlib import colormaps

    colours: NDArray[np.float64] = colormaps[name](np.linspace(start, stop, 256))
    return np.rint(colours[:, :3] * 255).astype(np.uint8)


def _few(colours: ArrayLike) -> Rgb:
    """A table that begins with some colours; the rest of it is for what has none."""
    table = np.tile(UNLABELLED, (256, 1))
    table[: len(np.asarray(colours))] = colours
    return table


VALUES: dict[str, Callable[[Scan], NDArray[Any] | None]] = {
    "height": lambda scan: scan.points[:, 2],
    "range": lambda scan: np.linalg.norm(scan.points, axis=1),
    "reflectance": lambda scan: scan.reflectance,
    "label": lambda scan: scan.label,
    "domain": lambda scan: np.full(len(scan), scan.domain, np.uint8),
}
"""What points can be coloured by: a value per point, or None where the scan does not know it."""


def scales(scans: Sequence[Scan]) -> dict[str, Scale]:
    """One ``Scale`` for each of ``VALUES``, the same for all scans of a sheet or page.

    Heights run between percentiles of what is there, for no scan says how high its sensor stands; ranges to the
    farthest that one of the sensors sees.
    """
    heights = [z for scan in scans for z in scan.points[:: max(1, len(scan) // 5000), 2].tolist()]
    low, high = np.percentile(heights, (2, 99)) if heights else (-2.0, 2.0)
    reach = max((scan.sensor.range_max for scan in scans), default=80.0)
    return {
        "height": Scale("height above the sensor (m)", _map("viridis", 0.12), float(low), float(max(high, low + 4))),
        "range": Scale("range (m)", _map("plasma_r", 0.0, 0.97), 0.0, float(reach), 0.5),
        "reflectance": Scale("reflectance", _map("bone", 0.25), 0.0, 1.0, 0.7),
        "label": Scale("label", _few(COLOURS), classes=True),
        "domain": Scale("domain", _few(list(DOMAINS.values())), classes=True),
    }


def point_values(scan: Scan, by: str) -> NDArray[Any]:
    """(N,) the quantity that points are to be coloured by.

    Raises:
        ConfigError: on an unknown quantity, or one that the scan does not know.
    """
    if by not in VALUES:
        raise ConfigError(f"colour by {by!r}", f"one of {', '.join(VALUES)}")
    values = VALUES[by](scan)
    if values is None:
        raise ConfigError(f"scan {scan.id!r} has no {by}", f"one of {', '.join(known(scan))}")
    return values


def known(scan: Scan) -> tuple[str, ...]:
    """The quantities that this scan's points can be coloured by."""
    return tuple(name for name, value in VALUES.items() if value(scan) is not None)
