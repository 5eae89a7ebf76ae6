"""The default recipe for a detector with few real scans: scans of the town or of a bank first, then
half of each batch, with objects of the real scans pasted into all scans (GT sampling).

It is the one that was measured on real cars (docs/research/detectors.md).
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.labels.augment import Augmentation, compose, flip_x, flip_y, scale, yaw
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.mix import PasteObjects
from lidar_synth.mixing.schedules import to_integer

PASTED = {"Car": 6, "Pedestrian": 4, "Cyclist": 4}
"""Maximum number of objects of a bank that are pasted into a scan."""
FIRST = 0.75
"""Share of the epochs with synthetic scans alone."""


def augment_boxes(banks: Iterable[ObjectBank]) -> Augmentation:
    """Paste objects of some banks, turned about the sensor; then turn by up to 45 degrees, mirror
    and scale the scan."""
    steps: list[Augmentation] = []
    for bank in banks:
        there = set(bank.boxes.names)
        count = {name: most for name, most in PASTED.items() if name in there}
        steps.append(PasteObjects(bank, count or 8, turn=180.0, clear=False))
    return compose([*steps, partial(yaw, limit=45), flip_x, flip_y, scale])


def detection_options(real: Any, epochs: Any) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for a detector.

    Args:
        real: scans with boxes.
        epochs: of the training.

    Raises:
        ConfigError: without real scans, or on fewer than 4 epochs.
        DataError: if the real scans have no objects in boxes.
    """
    if real is None or epochs is None or to_integer(epochs, "epochs") < 4:
        raise ConfigError(
            f"task='detection' with epochs={epochs}",
            "real scans with boxes, and at least 4 epochs",
            "mix(real, synth, task='detection', epochs=40)",
        )
    return {
        "ratio": {0: 1.0, int(FIRST * epochs): 0.5},
        "labels": "boxes",
        "epoch_size": "replace",
        "balanced": True,
        "augment": augment_boxes([ObjectBank.from_scans(real)]),
        "augment_real": True,
    }
