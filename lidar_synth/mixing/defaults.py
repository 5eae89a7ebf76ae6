"""What ``mix(epochs=...)`` does unless it is told otherwise: the recipe that gained most on real
scans, by task.

Segmentation: synthetic scans first, then half of each batch (docs/research/proof.md). Detection:
the same, with objects of the real scans pasted into all scans (docs/research/detectors.md).
"""

import logging
from collections.abc import Iterable
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.compose import Compose
from lidar_synth.labels.mix import PasteObjects
from lidar_synth.mixing.schedules import SyntheticFirst

log = logging.getLogger(__name__)

MEASURED = 24
"""Largest number of labelled scans with which the recipe for segmentation has been measured."""
LEAST = 100
"""Minimum number of samples of an epoch; as many as there are real scans, if these are more."""
PASTED = {"Car": 6, "Pedestrian": 4, "Cyclist": 4}
"""Maximum number of objects of a bank that are pasted into a scan."""


def augment_boxes(banks: Iterable[ObjectBank]) -> Compose:
    """Paste objects of some banks, turned about the sensor; then turn by up to 45 degrees, mirror
    and scale the scan."""
    steps: list[Any] = []
    for bank in banks:
        there = set(bank.boxes.names)
        count = {name: most for name, most in PASTED.items() if name in there}
        steps.append(PasteObjects(bank, count or 8, turn=180.0, clear=False))
    return Compose([*steps, {"yaw": {"limit": 45}}, "flip_x", "flip_y", "scale"])


def segmentation_options(real: int, epochs: int, same_sensor: bool) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for a segmenter; warns where no gain has been measured.

    Args:
        real: number of real scans.
        epochs: of the training.
        same_sensor: whether the synthetic scans are of the real scans' sensor without a transfer.

    Raises:
        ConfigError: on fewer than 4 epochs.
    """
    doubts = []
    if real > MEASURED:
        doubts.append(f"with more than {MEASURED} labelled scans ({real} here)")
    if not same_sensor:
        doubts.append("on scans of a sensor that the synthetic ones are not made for")
    if doubts:
        log.warning(
            "synthetic scans first: no gain has been measured %s; compare with "
            "`lidar-synth prove` (docs/how-to/choose.md)",
            " and ".join(doubts),
        )
    return {
        "ratio": SyntheticFirst(epochs),
        "epoch_size": "replace" if real >= LEAST else LEAST,
    }


def detection_options(real: Any, epochs: Any) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for a detector.

    Args:
        real: scans with boxes.
        epochs: of the training.

    Raises:
        ConfigError: without real scans, or on fewer than 4 epochs.
        DataError: if the real scans have no objects in boxes.
    """
    if real is None or epochs is None:
        raise ConfigError(
            f"task='detection' with epochs={epochs}",
            "real scans with boxes, and epochs",
            "mix(real, synth, task='detection', epochs=40)",
        )
    return {
        "ratio": SyntheticFirst(epochs),
        "labels": "boxes",
        "epoch_size": "replace",
        "balanced": True,
        "augment": augment_boxes([ObjectBank.from_scans(real)]),
        "augment_real": True,
    }
