"""What all corruptions share: severities, and the treatment of labels and boxes.

A corruption gives for each of its points the point of the original scan on the same ray,
and the cause of the return. The point keeps the label, ring and time of the original one.
If the ray met no surface but a drop, a flake or another sensor's pulse, the label is
255 = ignore. Boxes stay; a box that loses all its returns gets the occlusion 3 (unknown),
and ``Compose`` drops it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, choose
from lidar_synth.geometry import (
    CAUSES,
    Boxes,
    Scan,
    require_finite,
    require_reflectance,
)
from lidar_synth.geometry.assign import assign_beams

Values = NDArray[np.float32]

SEVERITIES = "light", "moderate", "heavy"
SURFACE, SCATTERED, CROSSTALK = range(len(CAUSES))

OUT_OF_SIGHT = 3
"""KITTI's level of occlusion for "unknown"."""


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
    points: Values
    reflectance: Values
    cause: NDArray[np.uint8]


@dataclass(frozen=True)
class Corruption(ABC):
    """An augmentation ``(scan, rng) -> scan`` with a physical parameter.

    Args:
        noise_label: label of the returns that no surface caused.

    Attributes:
        name: in ``CORRUPTIONS``.
        SEVERE: the arguments of each of ``SEVERITIES``.
    """

    name: ClassVar[str]
    SEVERE: ClassVar[tuple[dict[str, Any], ...]]

    noise_label: int = field(default=IGNORE, kw_only=True)

    @classmethod
    def at(cls, severity: str, **options: Any) -> Self:
        """The corruption of a severity; ``options`` are further arguments.

        Raises:
            ConfigError: on a name that is not in ``SEVERITIES``.
        """
        known = dict(zip(SEVERITIES, cls.SEVERE, strict=True))
        return cls(**choose("severity", severity, known), **options)

    @abstractmethod
    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        """What becomes of the points of a scan.

        Raises:
            DataError: on a scan without what the corruption needs.
        """

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        """The corrupted scan; the given one is not changed.

        Raises:
            DataError: on points that are NaN or infinite, another reflectance than 0 to 1, or as
            ``change``.
        """
        require_finite(scan)
        require_reflectance(scan)
        settings = {f.name: getattr(self, f.name) for f in fields(self)[1:]}
        scan = scan.noted(self.name, **settings)
        if not len(scan):
            return scan
        change = self.change(scan, rng)
        new = scan[change.source]
        lost = change.cause != SURFACE
        earlier = np.uint8(SURFACE) if new.cause is None else new.cause
        changed: dict[str, Any] = {"cause": np.where(lost, change.cause, earlier)}
        marks = {"label": self.noise_label, "raw_label": 0, "instance": 0}
        for name, value in {**marks, "confidence": 0}.items():
            values = getattr(new, name)
            if values is not None:
                changed[name] = np.where(lost, values.dtype.type(value), values)
        result = replace(
            new, points=change.points, reflectance=change.reflectance, **changed
        )
        if scan.boxes is not None:
            occlusion = scan.boxes.occlusion.copy()
            occlusion[lost_boxes(scan.boxes, scan, result)] = OUT_OF_SIGHT
            result.boxes = replace(scan.boxes, occlusion=occlusion)
        return result


def keep_points(scan: Scan, keep: NDArray[np.bool_]) -> Change:
    """The points of a scan that a mask (N,) keeps."""
    source = np.flatnonzero(keep)
    cause = np.full(len(source), SURFACE, np.uint8)
    points = scan.points.take(source, 0)
    return Change(source, points, scan.reflectance[source], cause)


def rings_of(scan: Scan) -> NDArray[np.int64]:
    """(N,) the beam of each point, 0 = highest: its ring, or the beam nearest to its direction.

    Raises:
        DataError: on rings that the sensor does not have.
    """
    rings = assign_beams(scan).ring if scan.ring is None else scan.ring
    if rings.min() < 0 or rings.max() >= scan.sensor.shape[0]:
        raise DataError(
            f"scan {scan.id!r} with rings from {rings.min()} to {rings.max()}",
            f"0 to {scan.sensor.shape[0] - 1}, the beams of {scan.sensor.name!r}",
            "Remove them by replace(scan, ring=None): the directions of the points tell "
            "their beams.",
        )
    return rings.astype(np.int64)


def require_between(name: str, value: float, low: float, high: float) -> None:
    """Check a parameter.

    Raises:
        ConfigError: if it is not between ``low`` and ``high``.
    """
    if not low <= value <= high:
        raise ConfigError(f"{name}={value}", f"{low:g} to {high:g}")


def lost_boxes(boxes: Boxes, before: Scan, after: Scan) -> NDArray[np.bool_]:
    """(M,) whether boxes held returns of surfaces before a change, and hold none after it."""
    held, left = (
        boxes.contain(s.points if s.cause is None else s.points[s.cause == SURFACE])
        for s in (before, after)
    )
    return np.asarray(held.any(1) & ~left.any(1))
