"""What all corruptions have in common: severities, and what becomes of labels and boxes.

A corruption says which point of the given scan each of its points comes from, and why it
is where it is. A point keeps the label, ring and time of the point that its ray had.
Where the ray met no surface but a drop, a flake or another sensor's pulse, the label is
255 = ignore. Boxes stay; one that held returns and holds none any more gets the
occlusion 3 (unknown), by which a loader can leave it out.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, suggest
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.scan import Boxes, Scan

SEVERITIES = "light", "moderate", "heavy"
CAUSES = "surface", "scattered", "crosstalk"
"""Why a return is where it is: the surface that the ray met in clear air, particles in
the air, or a pulse of another beam."""
SURFACE, SCATTERED, CROSSTALK = range(len(CAUSES))

OUT_OF_SIGHT = 3
"""KITTI's level of occlusion for "unknown"."""

FLOOR = 5e-5
"""Least signal that a sensor detects, as reflectance / range^2 in 1 / m^2: the HDL-64E
sees 10 % at 50 m and 80 % at 120 m (Velodyne's data sheet)."""
DARKEST = 0.05
"""Reflectance that a return reported as 0 may have had."""

COMPENSATED = 0.7
"""Share of the logarithm of a loss that a sensor's automatic power and gain make up for
in the reflectance that it reports (0 = none). Chosen so that a network that learnt in
clear air loses as much as in the Robo3D benchmark."""


@dataclass(frozen=True)
class Change:
    """What a corruption does to a scan of N points.

    Args:
        source: (M,) int64, the point of the given scan that each point of the new one
            comes from.
        points: (M, 3) float32 metres.
        reflectance: (M,) float32 in [0, 1].
        cause: (M,) uint8, an index of ``CAUSES``.
    """

    source: NDArray[np.int64]
    points: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    cause: NDArray[np.uint8]


@dataclass(frozen=True)
class Corruption(ABC):
    """An augmentation ``(scan, rng) -> scan`` with a physical parameter.

    Attributes:
        SEVERE: the arguments of each of ``SEVERITIES``.
    """

    SEVERE: ClassVar[tuple[dict[str, Any], ...]]

    @classmethod
    def at(cls, severity: str) -> Self:
        """The corruption of a severity.

        Raises:
            ConfigError: on a name that is not in ``SEVERITIES``.
        """
        if severity not in SEVERITIES:
            raise ConfigError(
                f"severity {severity!r}",
                f"one of {', '.join(SEVERITIES)}",
                suggest(severity, SEVERITIES),
            )
        return cls(**cls.SEVERE[SEVERITIES.index(severity)])

    @abstractmethod
    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        """What becomes of the points of a scan.

        Raises:
            DataError: on a scan without what the corruption needs.
        """

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        """The corrupted scan; the given one is not changed."""
        if not len(scan):
            return scan
        change = self.change(scan, rng)
        new = scan[change.source]
        fields: dict[str, Any] = {}
        lost = change.cause != SURFACE
        for name, value in (("label", IGNORE), ("raw_label", 0), ("instance", 0)):
            given = getattr(new, name)
            if given is not None:
                fields[name] = np.where(lost, given.dtype.type(value), given)
        if new.confidence is not None:
            fields["confidence"] = np.where(lost, np.float32(0), new.confidence)
        if scan.boxes is not None:
            fields["boxes"] = _flagged(scan.boxes, scan.points, change)
        return replace(
            new, points=change.points, reflectance=change.reflectance, **fields
        )


def keep_points(scan: Scan, keep: NDArray[np.bool_]) -> Change:
    """The points of a scan that a mask (N,) keeps."""
    source = np.flatnonzero(keep)
    cause = np.zeros(len(source), np.uint8)
    return Change(source, scan.points[source], scan.reflectance[source], cause)


def move_returns(
    scan: Scan,
    distance: NDArray[np.float64],
    where: NDArray[np.float64],
    signal: NDArray[np.float64],
    scattered: NDArray[np.bool_],
    seen: NDArray[np.bool_],
) -> Change:
    """Returns at other places along their rays.

    Args:
        scan: N points.
        distance, where: (N,) metres from the sensor, before and after.
        signal: (N,) reflectance / range^2.
        scattered: (N,) whether particles return the pulse.
        seen: (N,) whether there is a return.
    """
    source = np.flatnonzero(seen)
    factor = where / np.maximum(distance, 1e-6)
    points = (scan.points * factor[:, None]).astype(np.float32)
    loss = np.minimum(signal / signal_of(scan, distance), 1)
    surface = scan.reflectance * loss ** (1 - COMPENSATED)
    particle = np.minimum(signal * np.maximum(where, 0.1) ** 2, 1)
    values = np.where(scattered, particle, surface).astype(np.float32)
    cause = np.where(scattered, SCATTERED, SURFACE).astype(np.uint8)
    return Change(source, points[source], values[source], cause[source])


def ranges_of(scan: Scan) -> NDArray[np.float64]:
    """(N,) distances from the sensor, metres."""
    distance: NDArray[np.float64] = np.linalg.norm(
        scan.points.astype(np.float64), axis=1
    )
    return distance


def signal_of(scan: Scan, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) signals of returns in clear air, reflectance / range^2, at least ``FLOOR``:
    what was recorded was strong enough."""
    bright = np.maximum(scan.reflectance, DARKEST)
    signal: NDArray[np.float64] = bright / np.maximum(distance, 0.1) ** 2
    return np.maximum(signal, FLOOR)


def rings_of(scan: Scan) -> NDArray[np.int64]:
    """(N,) beams of the points: their rings, or as their directions tell."""
    rings = assign_beams(scan).ring if scan.ring is None else scan.ring
    if rings.min() < 0 or rings.max() >= scan.sensor.shape[0]:
        raise DataError(
            f"scan {scan.id!r} with rings from {rings.min()} to {rings.max()}",
            f"0 to {scan.sensor.shape[0] - 1}, the beams of {scan.sensor.name!r}",
        )
    return rings.astype(np.int64)


def require_between(name: str, value: float, low: float, high: float) -> None:
    """Check a parameter.

    Raises:
        ConfigError: if it is not between ``low`` and ``high``.
    """
    if not low <= value <= high:
        raise ConfigError(f"{name}={value}", f"{low:g} to {high:g}")


def _flagged(boxes: Boxes, points: NDArray[np.float32], change: Change) -> Boxes:
    """The boxes, with those that have lost all their returns flagged."""
    inside = boxes.contain(points)
    left = inside[:, change.source[change.cause == SURFACE]].any(1)
    gone = inside.any(1) & ~left
    occlusion = np.where(gone, OUT_OF_SIGHT, boxes.occlusion).astype(np.int8)
    return replace(boxes, occlusion=occlusion)
