"""Colour scales: a table of 256 colours and a value range for each quantity.

The same tables colour range images, rendered views, colour bars and (as a texture) the viewer of
the HTML page, so that a colour has the same meaning everywhere.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import ConfigError, choose
from lidar_synth.geometry import Scan

Rgb = NDArray[np.uint8]
"""(..., 3) uint8 red, green, blue."""

EMPTY = np.array([16, 18, 24], np.uint8)
"""Colour of cells without a return, and background of all pictures."""

UNLABELLED = np.array([96, 100, 110], np.uint8)
"""Colour of label 255 = ignore."""

DOMAINS = {"real": (92, 172, 255), "synthetic": (255, 162, 64)}
"""Name and colour of each ``Scan.domain``, in the order of their numbers."""


@dataclass(frozen=True)
class Scale:
    """The colour scale of one quantity.

    Args:
        title: the quantity with its unit, as shown on colour bars.
        table: (256, 3) uint8 colours.
        low: the value of the first colour, and of values below.
        high: the value of the last colour, and of values above.
        gamma: position in the table = ((value - low) / (high - low)) ** gamma; a gamma below 1
            spends more colours on low values, where most points of a scan are.
        classes: whether the values are indices of the table (0..255) instead of points on a scale.
    """

    title: str
    table: Rgb
    low: float = 0.0
    high: float = 255.0
    gamma: float = 1.0
    classes: bool = False

    def index(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """Index in the table of each value, any shape."""
        if self.classes:
            return values.astype(np.uint8)
        unit: NDArray[np.float32] = np.clip(
            (np.asarray(values, np.float32) - self.low) / (self.high - self.low), 0, 1
        )
        places: NDArray[np.uint8] = np.rint(unit**self.gamma * 255).astype(np.uint8)
        return places

    def __call__(self, values: NDArray[Any]) -> Rgb:
        """(..., 3) uint8 colours of the values."""
        colours: Rgb = self.table[self.index(values)]
        return colours


@lru_cache(maxsize=8)
def _colour_map(name: str, start: float, stop: float = 1.0) -> Rgb:
    """A part of one of matplotlib's colour maps, chosen so that no colour is as dark as
    ``EMPTY``."""
    from matplotlib import colormaps

    colours: NDArray[np.float64] = colormaps[name](np.linspace(start, stop, 256))
    return np.rint(colours[:, :3] * 255).astype(np.uint8)


def _class_table(colours: ArrayLike) -> Rgb:
    """A table of class colours, filled up with ``UNLABELLED``."""
    table = np.tile(UNLABELLED, (256, 1))
    table[: len(np.asarray(colours))] = colours
    return table


VALUES: dict[str, Callable[[Scan], NDArray[Any] | None]] = {
    "height": lambda scan: scan.points[:, 2],
    "range": lambda scan: np.linalg.norm(scan.points, axis=1),
    "reflectance": lambda scan: scan.reflectance,
    "label": lambda scan: scan.label,
    "confidence": lambda scan: scan.confidence,
    "domain": lambda scan: np.full(len(scan), scan.domain, np.uint8),
}
"""The quantities that can colour points: (N,) values of a scan, or None if the scan does not have
them."""


def make_scales(scans: Sequence[Scan]) -> dict[str, Scale]:
    """One ``Scale`` for each of ``VALUES``, shared by all scans of a sheet or page.

    Heights are scaled between percentiles of all scans, because the height of the sensor above the
    ground is unknown; ranges are scaled to the largest ``range_max`` of the sensors.
    """
    heights = [
        z
        for scan in scans
        for z in scan.points[:: max(1, len(scan) // 5000), 2].tolist()
    ]
    low, high = np.percentile(heights, (2, 99)) if heights else (-2.0, 2.0)
    reach = max((scan.sensor.range_max for scan in scans), default=80.0)
    return {
        "height": Scale(
            "height above the sensor (m)",
            _colour_map("viridis", 0.12),
            float(low),
            float(max(high, low + 4)),
        ),
        "range": Scale(
            "range (m)", _colour_map("plasma_r", 0.0, 0.97), 0.0, float(reach), 0.5
        ),
        "reflectance": Scale("reflectance", _colour_map("bone", 0.25), 0.0, 1.0, 0.7),
        "label": Scale("label", _class_table(COLOURS), classes=True),
        "confidence": Scale(
            "confidence of the label", _colour_map("RdYlGn", 0.0), 0.0, 1.0, 3.0
        ),
        "domain": Scale("domain", _class_table(list(DOMAINS.values())), classes=True),
    }


def point_values(scan: Scan, by: str) -> NDArray[Any]:
    """(N,) the quantity that colours the points.

    Raises:
        ConfigError: on an unknown quantity, or one that the scan does not have.
    """
    values = choose("colour by", by, VALUES)(scan)
    if values is None:
        raise ConfigError(
            f"scan {scan.id!r} has no {by}", f"one of {', '.join(available(scan))}"
        )
    return values


def available(scan: Scan) -> tuple[str, ...]:
    """The quantities of ``VALUES`` that a scan has."""
    return tuple(name for name, value in VALUES.items() if value(scan) is not None)
