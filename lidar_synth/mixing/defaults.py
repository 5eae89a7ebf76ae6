"""The default recipes of ``mix(epochs=...)``, by task: those that gained most on real scans.

Segmentation with few labelled scans, whose sensor has the same lasers as the synthetic scans':
synthetic scans alone first, then half of each batch, and real scans alone at the end. Persons and
cycles of the town replace those of the synthetic scans.

Segmentation otherwise: synthetic scans alone for a quarter of the epochs, then real scans alone.
This gained less, but showed no loss on the street of the labels (docs/research/proof.md).

Detection: the first schedule, with objects of the real scans pasted into all scans
(docs/research/detectors.md).
"""

import logging
from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.formats.camera_boxes import CameraBoxes
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.compose import Compose
from lidar_synth.labels.mix import PasteObjects
from lidar_synth.labels.policies import Labels
from lidar_synth.mixing.schedules import SyntheticFirst, check_epochs
from lidar_synth.mixing.sources import each

log = logging.getLogger(__name__)

MEASURED = 24
"""Largest number of labelled scans with which a recipe for segmentation has been measured."""
FEW = 40
"""Largest number of labelled scans with which training on synthetic scans first is expected to
gain. Extrapolated: it gained 7 mIoU with 4 scans and 1.5 with 24, falling with the logarithm."""
LEAST = 100
"""Minimum number of samples in an epoch; if there are more real scans, it is their number."""
PASTED = {"Car": 6, "Pedestrian": 4, "Cyclist": 4}
"""Maximum number of objects of a bank that are pasted into a scan."""


TOWN_OBJECTS: Labels = {
    "paste": {
        "bank": "town",
        "count": {
            "Pedestrian": 6,
            "Person_sitting": 1,
            "Cyclist": 2,
            "Motorcyclist": 2,
            "Bicycle": 4,
            "Motorcycle": 3,
        },
        "turn": 180,
        "clear": "same",
    }
}
"""Replaces the persons and cycles of a scan by those of the town, because a segmenter does not
learn to find real ones from those that a model draws."""


def augment_boxes(banks: Iterable[ObjectBank]) -> Compose:
    """Paste objects of some banks, turned about the sensor; then turn by up to 45 degrees, mirror
    and scale the scan."""
    steps: list[Any] = []
    for bank in banks:
        names = set(bank.boxes.names)
        count = {name: most for name, most in PASTED.items() if name in names}
        steps.append(PasteObjects(bank, count or 8, turn=180.0, clear=False))
    return Compose([*steps, {"yaw": {"limit": 45}}, "flip_x", "flip_y", "scale"])


def quarter_of(epochs: int) -> dict[int, float]:
    """The schedule of synthetic scans alone for a quarter of the epochs, then real scans alone.

    Raises:
        ConfigError: on fewer than 4 epochs.
    """
    check_epochs(epochs)
    return {0: 1.0, epochs // 4: 0.0}


def ends_on_real(real: int, same_sensor: bool) -> bool:
    """Whether a segmenter is trained by ``quarter_of``: most of the epochs on real scans alone.

    Args:
        real: number of real scans.
        same_sensor: whether the sensors of real and synthetic scans have the same lasers.
    """
    return real > FEW or not same_sensor


def segmentation_options(
    reals: Any, epochs: int, ratio: Any, same_sensor: bool
) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for training a segmenter; none if the user gives a ratio.

    Logs a warning if a ratio is given, and if there are more real scans than a gain has been
    measured with.

    Args:
        reals: the real samples, or ``Sources`` of several.
        epochs: number of epochs of the training.
        ratio: the user's ratio, which replaces the recipe, or None.
        same_sensor: as for ``ends_on_real``.

    Raises:
        ConfigError: on fewer than 4 epochs.
    """
    if ratio is not None:
        log.warning(
            f"epochs={epochs} has no effect beside ratio={ratio}: without ratio it chooses the "
            "recipe for segmenters"
        )
        return {}
    real = sum(len(source) for source, _ in each(reals))
    if real > MEASURED:
        log.warning(
            f"no gain has been measured with more than {MEASURED} labelled scans ({real} here): "
            "compare with `lidar-synth prove` (docs/how-to/choose.md)"
        )
    size = "replace" if real >= LEAST else LEAST
    if ends_on_real(real, same_sensor):
        return {"ratio": quarter_of(epochs), "epoch_size": size}
    labels = TOWN_OBJECTS
    if find_spec("embreex") is None:
        log.warning(
            "without embreex no persons or cycles are pasted: few will be found"
        )
        labels = "generated"
    return {"ratio": SyntheticFirst(epochs), "labels": labels, "epoch_size": size}


def detection_options(real: Any, epochs: Any) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for training a detector.

    Args:
        real: scans with boxes.
        epochs: number of epochs of the training.

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
    for source, _ in each(real):
        if isinstance(source, CameraBoxes) and source.beyond_view:
            log.warning(
                f"{source.root} has points all around and boxes in the camera's view only: a "
                "detector would learn that objects elsewhere are background. Take "
                f"open_scans({str(source.root)!r}).with_boxes()"
            )
    return {
        "ratio": SyntheticFirst(epochs),
        "labels": "boxes",
        "epoch_size": "replace",
        "balanced": True,
        "augment": augment_boxes([ObjectBank.from_scans(real)]),
        "augment_real": True,
    }
