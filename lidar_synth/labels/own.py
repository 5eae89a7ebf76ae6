"""Policies that need no other scans: they keep the labels of the synthetic scan, or
remove them.

They return a new ``Scan`` that shares its unchanged arrays. They remove ``raw_label``,
which would contradict the labels that they set.
"""

from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, shorten
from lidar_synth.geometry import Scan, Source


@dataclass(frozen=True)
class RemoveLabels:
    """``none``: an unlabelled pool; labels, instances, confidence and boxes are
    removed.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, RemoveLabels
        >>> scan = RemoveLabels()(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> scan.label is None
        True
    """

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return replace(
            scan, label=None, raw_label=None, instance=None, confidence=None, boxes=None
        )


@dataclass(frozen=True)
class IgnoreLabels:
    """``ignore``: every label is 255 with confidence 0, so that a loss skips the scan;
    the sample keeps its keys.

    Args:
        boxed: whether the scan keeps its boxes.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, IgnoreLabels
        >>> scan = IgnoreLabels()(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> np.unique(scan.label)
        array([255], dtype=uint8)
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
class KeepLabels:
    """``generated``: the labels that the model generated with the scan.

    Args:
        threshold: minimum confidence, 0 to 1; labels below it become 255 = ignore.

    Raises:
        ConfigError: on another threshold.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, KeepLabels
        >>> scan = Bank("demo_out/bank")[0]
        >>> sure = KeepLabels(threshold=0.6)(scan, np.random.default_rng(0))
        >>> np.unique(sure.label[scan.confidence < 0.6])  # labels of low confidence are ignored
        array([255], dtype=uint8)
    """

    threshold: float = 0.0

    def __post_init__(self) -> None:
        check_share("threshold", self.threshold)

    def bind(self, real: Source | None, fields: frozenset[str]) -> "KeepLabels":
        """Check that the scans have labels, and confidence for a threshold.

        Raises:
            ConfigError: if they do not.
        """
        require_label("generated", fields)
        if self.threshold and "confidence" not in fields:
            raise ConfigError(
                f"threshold {self.threshold} for synthetic scans without confidence",
                "threshold=0",
            )
        return self

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return trust_labels(scan, label_of(scan), scan.confidence, self.threshold)


@dataclass(frozen=True)
class KeepCondition:
    """``condition``: the labels of the semantic map that conditioned the scan, with
    confidence 1.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, KeepCondition
        >>> scan = KeepCondition()(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> bool((scan.confidence[scan.label < 255] == 1).all())
        True
    """

    def bind(self, real: Source | None, fields: frozenset[str]) -> "KeepCondition":
        """Check that the scans have labels.

        Raises:
            ConfigError: if they do not.
        """
        require_label("condition", fields)
        return self

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return trust_labels(scan, label_of(scan), None)


@dataclass(frozen=True)
class KeepBoxes:
    """``boxes``: for detectors; the scan keeps its own boxes, and its labels if it has
    any.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import KeepBoxes, Town
        >>> scan = KeepBoxes()(Town(seed=0, scans=1)[0], np.random.default_rng(0))
        >>> len(scan.boxes) > 0
        True
    """

    def bind(self, real: Source | None, fields: frozenset[str]) -> "KeepBoxes":
        """Check that the scans have boxes.

        Raises:
            ConfigError: if they do not.
        """
        if "boxes" not in fields:
            raise ConfigError(
                "labels='boxes', but besides points the synthetic scans only have "
                f"{sorted(fields) or 'no fields'}",
                "scans with boxes, such as the town's or those of a layout model",
                "Other models generate none: labels='paste' pastes objects with their boxes.",
            )
        return self

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if scan.boxes is None:
            raise DataError(
                f"synthetic scan {scan.id!r} has no boxes",
                "boxes, for a detector",
                "labels='paste' pastes objects with their boxes.",
            )
        return scan


def keep_own(scan: Scan, rng: np.random.Generator, threshold: float) -> Scan:
    """The scan with its own labels, see ``KeepLabels``; all are ignored if it has none."""
    if scan.label is None:
        return IgnoreLabels(boxed=True)(scan, rng)
    return KeepLabels(threshold)(scan, rng)


def check_own(threshold: float, fields: frozenset[str]) -> None:
    """Check a threshold for scans that may have labels of their own.

    Raises:
        ConfigError: on a threshold that is not from 0 to 1, or for labels without confidence.
    """
    policy = KeepLabels(threshold)
    if "label" in fields:
        policy.bind(None, fields)


def label_of(scan: Scan) -> NDArray[np.uint8]:
    """The labels of a scan.

    Raises:
        DataError: if it has none.
    """
    if scan.label is None:
        raise DataError(
            f"scan {scan.id!r} has no labels",
            "a label for each point",
            "Use labels='ignore'.",
        )
    return scan.label


def trust_labels(
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


def check_share(name: str, value: float, most: float = 1) -> float:
    """Check that ``value`` is a number from 0 to ``most``, and return it.

    Raises:
        ConfigError: on any other value.
    """
    if not (isinstance(value, Real) and 0 <= value <= most):
        given = f"{name} {shorten(repr(value), 40)}"
        raise ConfigError(given, f"a number from 0 to {most:g}")
    return value


def require_label(policy: str, fields: frozenset[str]) -> None:
    """Check that synthetic scans have labels.

    Raises:
        ConfigError: if they do not.
    """
    if "label" not in fields:
        raise ConfigError(
            f"labels={policy!r}, but besides points the synthetic scans only have "
            f"{sorted(fields) or 'no fields'}",
            "a model or bank with labels",
            "Use labels='none' for an unlabelled pool, 'ignore', 'pseudo' with a teacher, or "
            "'paste', 'polarmix' or 'lasermix' with real scans.",
        )
