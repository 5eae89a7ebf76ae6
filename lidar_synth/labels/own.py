"""Policies that need no other scans: they keep the labels of the synthetic scan, or remove them.

They return a new ``Scan`` that shares its unchanged arrays. They remove ``raw_label``, which would
contradict the labels that they set.
"""

from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, shorten
from lidar_synth.geometry.scan import Scan, Source


@dataclass(frozen=True)
class Unlabelled:
    """``none``: an unlabelled pool; labels, instances, confidence and boxes are removed."""

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return replace(
            scan, label=None, raw_label=None, instance=None, confidence=None, boxes=None
        )


@dataclass(frozen=True)
class Ignored:
    """``ignore``: every label is 255 with confidence 0, so that a loss skips the scan; the sample
    keeps its keys.

    Args:
        boxed: whether the scan keeps its boxes.
    """

    boxed: bool = False

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        label = np.full(len(scan), IGNORE, np.uint8)
        confidence = np.zeros(len(scan), np.float32)
        return replace(
            scan,
            label=label,
            raw_label=None,
            instance=None,
            confidence=confidence,
            boxes=scan.boxes if self.boxed else None,
        )


@dataclass(frozen=True)
class Own:
    """``generated`` and ``condition``: the scan keeps its own labels.

    Args:
        threshold: minimum confidence, 0 to 1; labels below it become 255 = ignore.
        kept: whether to keep the scan's confidence; otherwise it becomes 1 for every labelled
            point.
    """

    threshold: float = 0.0
    kept: bool = True

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if scan.label is None:
            raise DataError(
                f"scan {scan.id!r} has no labels",
                "a label for each point",
                "Use labels='ignore'.",
            )
        return trusted(
            scan, scan.label, scan.confidence if self.kept else None, self.threshold
        )


def trusted(
    scan: Scan,
    label: NDArray[np.uint8],
    confidence: NDArray[np.float32] | None,
    threshold: float = 0.0,
) -> Scan:
    """Set the labels of a scan, and ignore those with a confidence below a threshold.

    Args:
        scan: N points.
        label: (N,) train ids, 255 = ignore.
        confidence: (N,) in [0, 1]; None = 1 for every labelled point.
        threshold: minimum confidence of a label.
    """
    if confidence is None:
        confidence = (label != IGNORE).astype(np.float32)
    if threshold > 0:
        label = np.where(confidence >= threshold, label, np.uint8(IGNORE))
    return replace(scan, label=label, raw_label=None, confidence=confidence)


@dataclass(frozen=True)
class OwnBoxes:
    """``boxes``: for detectors; the scan keeps its own boxes, and its labels if it has any."""

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if scan.boxes is None:
            raise DataError(
                f"synthetic scan {scan.id!r} has no boxes",
                "boxes, for a detector",
                "labels='mix' pastes objects with their boxes.",
            )
        return scan


def boxes(real: Source | None, fields: frozenset[str]) -> OwnBoxes:
    """Make the policy ``boxes``: the scans' own boxes, for a detector; point labels are not needed.

    Raises:
        ConfigError: if the scans have no boxes.
    """
    if "boxes" not in fields:
        raise ConfigError(
            "labels='boxes', but besides points the synthetic scans only have "
            f"{sorted(fields) or 'no fields'}",
            "scans with boxes, such as the town's or those of a layout model",
            "Other models generate none: labels='mix' pastes objects with their boxes.",
        )
    return OwnBoxes()


def unlabelled(real: Source | None, fields: frozenset[str]) -> Unlabelled:
    """Make the policy ``none``, which works with any source."""
    return Unlabelled()


def ignored(real: Source | None, fields: frozenset[str]) -> Ignored:
    """Make the policy ``ignore``, which works with any source."""
    return Ignored()


def generated(
    real: Source | None, fields: frozenset[str], threshold: float = 0.0
) -> Own:
    """Make the policy ``generated``: the labels that the model generated with the scan.

    Raises:
        ConfigError: if the scans have no labels, or no confidence for a threshold.
    """
    _require_label("generated", fields)
    if threshold and "confidence" not in fields:
        raise ConfigError(
            f"threshold {threshold} for synthetic scans without confidence",
            "threshold=0",
        )
    return Own(check_share("threshold", threshold))


def condition(real: Source | None, fields: frozenset[str]) -> Own:
    """Make the policy ``condition``: the labels of the semantic map that conditioned the scan.

    Raises:
        ConfigError: if the scans have no labels.
    """
    _require_label("condition", fields)
    return Own(kept=False)


def check_share(name: str, value: float) -> float:
    """Check that ``value`` is a number from 0 to 1, and return it.

    Raises:
        ConfigError: on any other value.
    """
    if not (isinstance(value, Real) and 0 <= value <= 1):
        raise ConfigError(f"{name} {shorten(repr(value), 40)}", "a number from 0 to 1")
    return value


def _require_label(policy: str, fields: frozenset[str]) -> None:
    if "label" not in fields:
        raise ConfigError(
            f"labels={policy!r}, but besides points the synthetic scans only have "
            f"{sorted(fields) or 'no fields'}",
            "a model or bank with labels",
            "Use labels='none' for an unlabelled pool, 'ignore', 'pseudo' with a teacher, or "
            "'mix' with real scans.",
        )
