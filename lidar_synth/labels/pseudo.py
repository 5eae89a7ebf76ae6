"""``pseudo``: labels that a teacher predicts for the finished scan."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import check_labels
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan
from lidar_synth.labels.own import check_share, trust_labels

Teacher = Callable[[Scan], Any]
"""``scan -> (labels (N,) train ids, confidence (N,) in [0, 1])`` or ``scan -> scan`` with
labels."""


@dataclass(frozen=True)
class PredictLabels:
    """``pseudo``: labels predicted by a teacher, such as your own network.

    Args:
        teacher: ``scan -> (labels (N,) train ids, confidence (N,) in [0, 1])`` or
            ``scan -> scan`` with labels; it must be picklable if DataLoader workers are
            spawned.
        threshold: minimum confidence, 0 to 1; labels below it become 255 = ignore.

    Raises:
        ConfigError: on a teacher that is no function, or another threshold.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PredictLabels
        >>> def predict(scan):  # your network: here, low returns are road
        ...     return np.where(scan.points[:, 2] < -1.5, 8, 255), np.ones(len(scan))
        >>> policy = PredictLabels(predict)
        >>> scan = policy(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> np.unique(scan.label)
        array([  8, 255], dtype=uint8)
    """

    teacher: Teacher
    threshold: float = 0.9

    def __post_init__(self) -> None:
        if not callable(self.teacher):
            raise ConfigError(
                f"labels='pseudo' with teacher={self.teacher!r}",
                "a function scan -> (labels, confidence), or scan -> scan",
            )
        check_share("threshold", self.threshold)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        """The scan with the teacher's labels.

        Raises:
            DataError: on an answer that is not one label and one confidence per point.
        """
        answer = self.teacher(scan)
        if isinstance(answer, Scan):
            answer = (answer.label, answer.confidence)
        if not isinstance(answer, tuple) or len(answer) != 2 or answer[0] is None:
            raise DataError(
                f"the teacher's answer {type(answer).__name__} for scan {scan.id!r}",
                "(labels, confidence), (N,) each, or a scan with labels",
            )
        label = np.asarray(answer[0])
        confidence = None if answer[1] is None else np.asarray(answer[1])
        if label.shape != (len(scan),) or not _are_shares(confidence, len(scan)):
            raise DataError(
                f"the teacher's labels of scan {scan.id!r}, {label.shape} for {len(scan)} points",
                "train ids 0..18 or 255 and confidences in [0, 1], one of each per point",
            )
        check_labels(label, f"the teacher's answer for scan {scan.id!r}")
        if confidence is not None:
            confidence = confidence.astype(np.float32)
        return trust_labels(scan, label.astype(np.uint8), confidence, self.threshold)


def _are_shares(confidence: NDArray[Any] | None, count: int) -> bool:
    if confidence is None:
        return True
    within = (confidence >= 0) & (confidence <= 1)
    return confidence.shape == (count,) and bool(within.all())
