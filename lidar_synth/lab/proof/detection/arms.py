"""The trainings of a detector that are compared, and their training sets.

All arms have the same network, iterations, batch, augmentation, optimiser and test. To add an arm,
enter it in ``ARMS``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from lidar_synth.geometry import Scan, Source
from lidar_synth.lab.proof.arms import EPOCHS
from lidar_synth.lab.proof.detection.network import collate, sample
from lidar_synth.lab.town.returns import CALIBRATED_ON
from lidar_synth.labels import ObjectBank
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.defaults import augment_boxes, quarter_of
from lidar_synth.mixing.schedules import Ratio, SyntheticFirst

BASE = "gt_sampling"
"""The arm with which the others are compared."""
OWN = "own"
TOWN = "town"


@dataclass(frozen=True)
class DetectionArm:
    """One of the compared trainings.

    Args:
        title: its row in tables.
        pasted: the objects that are pasted into all scans: those of the labelled scans
            (``OWN``), of the town (``TOWN``), or both.
        ratio: share of synthetic scans, as ``mix`` takes it.
        budget: what it uses besides the labelled scans.
        generated: whether a model draws them, from the layouts of the town's scans.
    """

    title: str
    pasted: tuple[str, ...] = ()
    ratio: Ratio = 0.0
    budget: str = "none"
    generated: bool = False


_TOWN = f"boxes of the town; {CALIBRATED_ON}"
ARMS = {
    "real": DetectionArm("real scans only"),
    "gt_sampling": DetectionArm("GT sampling", (OWN,)),
    "objects": DetectionArm(
        "objects of the town beside GT sampling",
        (OWN, TOWN),
        budget=_TOWN,
    ),
    "half": DetectionArm(
        "the town in half of each batch, GT sampling",
        (OWN,),
        0.5,
        _TOWN,
    ),
    "first": DetectionArm(
        "the town first, then half, real scans last, GT sampling",
        (OWN,),
        SyntheticFirst(EPOCHS),
        _TOWN,
    ),
    "layouts": DetectionArm(
        "scans of layouts first, then half, real scans last, GT sampling",
        (OWN,),
        SyntheticFirst(EPOCHS),
        f"{_TOWN}; labels of the town's scans that the model learnt from",
        generated=True,
    ),
    "quarter": DetectionArm(
        "the town for a quarter, then real scans alone, GT sampling",
        (OWN,),
        quarter_of(EPOCHS),
        _TOWN,
    ),
    "town": DetectionArm("the town only (no real box)", (), 1.0, _TOWN),
}
"""Arms by name."""


def make_mixture(
    arm: DetectionArm,
    labelled: Sequence[Scan],
    synthetic: Source | None,
    objects: ObjectBank | None,
    seed: int,
    epoch_size: int,
) -> MixedScans:
    """The training set of an arm, as a user of the package makes it.

    Args:
        arm: the arm.
        labelled: real scans with boxes.
        synthetic: scans of the town, or generated ones.
        objects: those of the town.
        seed: of the mixture.
        epoch_size: number of samples of each of ``EPOCHS`` epochs.
    """
    banks = {OWN: ObjectBank.from_scans(labelled), TOWN: objects}
    pasted = [bank for name in arm.pasted if (bank := banks[name]) is not None]
    return MixedScans(
        None if arm.ratio == 1 else labelled,
        synthetic,
        arm.ratio,
        "boxes",
        seed=seed,
        balanced=True,
        epoch_size=epoch_size,
        augment=augment_boxes(pasted),
        augment_real=True,
        to_sample=sample,
        collate=collate,
        unboxed="keep",  # the town's objects have boxes
    )
