"""``pseudo``: labels that a teacher predicts for the finished scan."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan
from lidar_synth.labels.own import check_share, trust_labels

Teacher = Callable[[Scan], Any]
"""``scan -> (labels (N,) train ids, confidence (N,) in [0, 1])`` or ``scan -> scan`` with
labels."""


@dataclass(frozen=True)
class PredictLabels:
    """``pseudo``: labels that a teacher predicts for the finished scan.

    Args:
        teacher: any callable; it must be picklable if DataLoader workers are spawned.
        threshold: minimum confidence, 0 to 1; labels below it become 255 = ignore.

    Raises:
        ConfigError: without a teacher, or on a threshold outside [0, 1].

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PredictLabels
        >>> def teacher(scan):  # your network
        ...     return scan.label, scan.confidence
        >>> PredictLabels(teacher)(Bank("demo_out/bank")[0], np.random.default_rng(0)).label.dtype
        dtype('uint8')
    """

    teacher: Teacher | None = None
    threshold: float = 0.9

    def __post_init__(self) -> None:
        check_share("threshold", self.threshold)
        if not callable(self.teacher):
            raise ConfigError(
                f"labels='pseudo' with teacher={self.teacher!r}",
                "a function scan -> (labels, confidence), or scan -> scan",
            )

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        """The scan with the teacher's labels.

        Raises:
            DataError: on an answer that is not one label and one confidence per point.
        """
        assert self.teacher is not None
        answer = self.teacher(scan)
        if isinstance(answer, Scan):
            answer = (answer.label, answer.confidence)
        if not isinstance(answer, tuple) or len(answer) != 2 or answer[0] is None:
            raise DataError(
                f"the teacher's answer {type(answer).__name__} for scan {scan.id!r}",
                "(labels, confidence), (N,) each, or a scan with labels",
            )
        label, confidence = (
            None if values is None else np.asarray(values) for values in answer
        )
        assert label is not None
        bad = (
            label.shape != (len(scan),)
            or ((label != IGNORE) & ((label < 0) | (label >= len(NAMES)))).any()
        )
        if confidence is not None:
            bad = (
                bad
                or confidence.shape != label.shape
                or not ((confidence >= 0) & (confidence <= 1)).all()
            )
            confidence = confidence.astype(np.float32)
        if bad:
            raise DataError(
                f"the teacher's labels of scan {scan.id!r}, {label.shape} for {len(scan)} points",
                "train ids 0..18 or 255 and confidences in [0, 1], one of each per point",
            )
        return trust_labels(scan, label.astype(np.uint8), confidence, self.threshold)
