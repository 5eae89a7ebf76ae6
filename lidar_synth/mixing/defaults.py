"""What ``mix(epochs=...)`` does unless it is told otherwise: the recipe that gained most on real
scans, by task.

Segmentation: synthetic scans first, then half of each batch, real scans alone at the end, with
persons and cycles of the town in the place of the synthetic scans' own, where labelled scans are
few and of the synthetic scans' lasers; otherwise synthetic scans for a quarter of the epochs, then
real scans alone, which gained less there but showed no loss on the street of the labels
(docs/research/proof.md).
Detection: the same schedule, with objects of the real scans pasted into all scans
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
"""Labelled scans up to which synthetic scans first gain, if the gains of 7 mIoU with 4 scans and
1.5 with 24 go on falling by the logarithm of their number."""
LEAST = 100
"""Minimum number of samples of an epoch; as many as there are real scans, if these are more."""
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
"""Persons and cycles of the town in the place of a scan's own: from those that a model draws, a
segmenter does not learn to find real ones."""


def augment_boxes(banks: Iterable[ObjectBank]) -> Compose:
    """Paste objects of some banks, turned about the sensor; then turn by up to 45 degrees, mirror
    and scale the scan."""
    steps: list[Any] = []
    for bank in banks:
        there = set(bank.boxes.names)
        count = {name: most for name, most in PASTED.items() if name in there}
        steps.append(PasteObjects(bank, count or 8, turn=180.0, clear=False))
    return Compose([*steps, {"yaw": {"limit": 45}}, "flip_x", "flip_y", "scale"])


def quarter_of(epochs: int) -> dict[int, float]:
    """The schedule of synthetic scans alone in a quarter of the epochs, then real scans alone.

    Raises:
        ConfigError: on fewer than 4 epochs.
    """
    check_epochs(epochs)
    return {0: 1.0, epochs // 4: 0.0}


def ends_on_real(real: int, same_sensor: bool) -> bool:
    """Whether a segmenter's training ends on real scans alone.

    Args:
        real: number of real scans.
        same_sensor: whether the synthetic scans are of a sensor with the real one's lasers.
    """
    return real > FEW or not same_sensor


def segmentation_options(
    reals: Any, epochs: int, ratio: Any, same_sensor: bool
) -> dict[str, Any]:
    """The arguments of ``MixedScans`` for a segmenter, none with a ratio; warns of that, and where
    no gain has been measured.

    Args:
        reals: the real samples, or ``Sources`` of several.
        epochs: of the training.
        ratio: in the place of the recipe's; None for none.
        same_sensor: as ``ends_on_real``.

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
