"""Policies that ask nobody else: the labels that a synthetic scan brings along, or none.

They return a new ``Scan`` that shares the arrays which they leave alone. A file's own ``raw_label`` never outlives
them: it would contradict what they decide.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan, Source


@dataclass(frozen=True)
class Unlabelled:
    """``none``: an unlabelled pool; labels, instances, confidence and boxes are taken away."""

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return replace(scan, label=None, raw_label=None, instance=None, confidence=None, boxes=None)


@dataclass(frozen=True)
class Ignored:
    """``ignore``: every label is 255, confidence 0; a loss skips the scan, the sample keeps its keys."""

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        label, confidence = np.full(len(scan), IGNORE, np.uint8), np.zeros(len(scan), np.float32)
        return replace(scan, label=label, raw_label=None, instance=None, confidence=confidence, boxes=None)


@dataclass(frozen=True)
class Own:
    """``generated`` and ``condition``: the labels that arrive with the scan.

    Args:
        threshold: least confidence, 0 to 1; below it a label becomes ignore.
        kept: the arriving confidence counts; otherwise it is 1 wherever there is a label.
    """

    threshold: float = 0.0
    kept: bool = True

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if scan.label is None:
            raise DataError(f"scan {scan.id!r} has no labels", "a label for each point", "Use labels='ignore'.")
        return trusted(scan, scan.label, scan.confidence if self.kept else None, self.threshold)


def trusted(
    scan: Scan, label: NDArray[np.uint8], confidence: NDArray[np.float32] | None, threshold: float = 0.0
) -> Scan:
    """The scan with these labels, those below a threshold ignored.

    Args:
        scan: N points.
        label: (N,) train ids, 255 = ignore.
        confidence: (N,) in [0, 1]; None = 1 wherever there is a label.
        threshold: least confidence that a label needs.
    """
    if confidence is None:
        confidence = (label != IGNORE).astype(np.float32)
    if threshold > 0:
        label = np.where(confidence >= threshold, label, np.uint8(IGNORE))
    return replace(scan, label=label, raw_label=None, confidence=confidence)


def unlabelled(real: Source | None, fields: frozenset[str]) -> Unlabelled:
    """``none``, which every source can serve."""
    return Unlabelled()


def ignored(real: Source | None, fields: frozenset[str]) -> Ignored:
    """``ignore``, which every source can serve."""
    return Ignored()


def generated(real: Source | None, fields: frozenset[str], threshold: float = 0.0) -> Own:
    """``generated``: the labels that the model made with the scan.

    Raises:
        ConfigError: where the scans carry no labels, or no confidence for a threshold.
    """
    _require_label("generated", fields)
    if threshold and "confidence" not in fields:
        raise ConfigError(f"threshold {threshold} for synthetic scans without confidence", "threshold=0")
    return Own(checked_share("threshold", threshold))


def condition(real: Source | None, fields: frozenset[str]) -> Own:
    """``condition``: the labels of the semantic map that conditioned the scan, which arrive with its returns.

    Raises:
        ConfigError: where the scans carry none.
    """
    _require_label("condition", fields)
    return Own(kept=False)


def checked_share(name: str, value: float) -> float:
    """``value``, a number from 0 to 1.

    Raises:
        ConfigError: on another.
    """
    if not 0 <= value <= 1:
        raise ConfigError(f"{name} {value!r}", "a number from 0 to 1")
    return value


def _require_label(policy: str, fields: frozenset[str]) -> None:
    if "label" not in fields:
        raise ConfigError(
            f"labels={policy!r}, but the synthetic scans carry {sorted(fields) or 'nothing'} beside their points",
            "a model or bank with labels",
            "Use labels='none' for an unlabelled pool, 'ignore', 'pseudo' with a teacher, or 'mix' with real scans.",
        )
