"""The trainings of a detector that are compared, and their training sets.

All arms have the same network, iterations, batch, augmentation, optimiser and test. A training has
``PHASES`` equal parts, each with its own share of synthetic scans. To add an arm, enter it in
``ARMS``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.lab.proof.detection.network import collate, sample
from lidar_synth.lab.town.returns import CALIBRATED_ON
from lidar_synth.labels import ObjectBank
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.defaults import augment_boxes

PHASES = 4
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
        shares: of scans of the town in the ``PHASES`` parts of the training.
        budget: what it uses besides the labelled scans.
    """

    title: str
    pasted: tuple[str, ...] = ()
    shares: tuple[float, float, float, float] = (0, 0, 0, 0)
    budget: str = "none"


_TOWN = f"boxes of the town; {CALIBRATED_ON}"
ARMS = {
    "real": DetectionArm("real scans only"),
    "gt_sampling": DetectionArm("GT sampling", (OWN,)),
    "objects": DetectionArm(
        "objects of the town beside GT sampling", (OWN, TOWN), budget=_TOWN
    ),
    "half": DetectionArm(
        "the town in half of each batch, GT sampling", (OWN,), (0.5,) * 4, _TOWN
    ),
    "first": DetectionArm(
        "the town first, then half, GT sampling", (OWN,), (1, 1, 1, 0.5), _TOWN
    ),
    "quarter": DetectionArm(
        "the town for a quarter, then real scans alone, GT sampling",
        (OWN,),
        (1, 0, 0, 0),
        _TOWN,
    ),
    "recipe": DetectionArm(
        "the town first, then half, real scans last; objects of both",
        (OWN, TOWN),
        (1, 1, 0.5, 0),
        _TOWN,
    ),
    "town": DetectionArm("the town only (no real box)", (), (1, 1, 1, 1), _TOWN),
}
"""Arms by name."""


def make_mixture(
    arm: DetectionArm,
    labelled: Sequence[Scan],
    town: Source | None,
    objects: ObjectBank | None,
    seed: int,
    count: int,
) -> MixedScans:
    """The training set of an arm, as a user of the package makes it.

    Args:
        arm: the arm.
        labelled: real scans with boxes.
        town: scans of the town.
        objects: those of the town.
        seed: of the mixture.
        count: number of samples in the whole training; an epoch has ``PHASES`` parts of it.
    """
    banks = {OWN: ObjectBank.from_scans(labelled), TOWN: objects}
    pasted = [bank for name in arm.pasted if (bank := banks[name]) is not None]
    synthetic = any(arm.shares)
    return MixedScans(
        None if min(arm.shares) == 1 else labelled,
        town if synthetic else None,
        dict(enumerate(arm.shares)) if synthetic else 0,
        "boxes",
        seed=seed,
        balanced=True,
        epoch_size=count // PHASES,
        augment=augment_boxes(pasted),
        augment_real=True,
        to_sample=sample,
        collate=collate,
        unboxed="keep",  # the town's objects have boxes
    )
