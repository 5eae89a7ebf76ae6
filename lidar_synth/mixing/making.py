"""How a scan becomes a sample of a mixture: sensor, label policy, augmentation, trainer's form."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidar_synth.errors import ConfigError, choose
from lidar_synth.geometry import (
    POINT_FIELDS,
    REAL,
    SYNTHETIC,
    Scan,
    Sensor,
    load_sensor,
    require_finite,
)
from lidar_synth.labels.own import KeepBoxes, RemoveLabels
from lidar_synth.labels.policies import LabelPolicy, Labels, make_policy, read_policy
from lidar_synth.mixing.items import copy_scan
from lidar_synth.mixing.notices import Notices

if TYPE_CHECKING:
    from lidar_synth.geometry.transfer import Transfer

ToSample = Callable[[Scan, np.random.Generator], Any]
"""Makes a sample from a scan; the random generator is keyed by (seed, epoch, position)."""


class SampleMaker:
    """Makes the samples of a mixture from its scans.

    Args:
        sources: the synthetic sources.
        scans: the real scans that label policies and augmentations may draw from, or None.
        transfer: turns synthetic scans into scans of another sensor, or None.
        labels, unboxed, augment, augment_real, to_sample: as for ``MixedScans``.
        images: whether batches are range images.

    Attributes:
        removes_labels: whether synthetic scans have no labels.
        notices: the warnings about its scans.

    Raises:
        ConfigError: on a policy that a source cannot support.
    """

    def __init__(
        self,
        sources: Sequence[Any],
        scans: Any,
        transfer: "Transfer | None",
        labels: Labels,
        unboxed: str | Callable[[Scan], Scan],
        augment: Any,
        augment_real: bool,
        to_sample: ToSample,
        *,
        images: bool,
    ) -> None:
        rings = frozenset() if transfer is None else frozenset({"ring"})
        fields = [source.fields | rings for source in sources]
        self._transfer = transfer
        self._policies = [make_policy(labels, real=scans, fields=f) for f in fields]
        policy = read_policy(labels)
        self.removes_labels = isinstance(policy, RemoveLabels)
        boxes = isinstance(policy, KeepBoxes)
        # PasteObjects(clear="same") is for segmenters, which need no boxes.
        boxed = boxes or getattr(policy, "clear", "same") != "same"
        self.notices = Notices(images, boxes, boxed)
        if isinstance(unboxed, str):
            from lidar_synth.labels.edit.unboxed import HANDLING  # loads networks

            unboxed = choose("unboxed", unboxed, HANDLING)
        self._without_unboxed = unboxed
        common = frozenset({*POINT_FIELDS, "boxes"}).intersection(*fields)
        self._augment: LabelPolicy | None = None
        if augment is not None:
            # It loads the corruptions.
            from lidar_synth.labels.compose import make_augmentation

            self._augment = make_augmentation(augment, scans, common)
        self._augment_real = augment_real
        self._to_sample = to_sample

    def real(self, scan: Scan, rng: np.random.Generator) -> Any:
        """The sample of a real scan."""
        require_finite(scan)
        self.notices.real(scan)
        # Copied, as a source may keep its scans in memory. Scans of the town count as real here.
        scan = replace(copy_scan(scan), domain=REAL)
        if self._augment_real:
            # Pasting marks a scan as synthetic; here it is a real sample of the plan.
            scan = replace(self._augmented(scan, rng), domain=REAL)
        return self._to_sample(scan, rng)

    def synthetic(self, source: int, scan: Scan, rng: np.random.Generator) -> Any:
        """The sample of a scan of a synthetic source, given by its number."""
        require_finite(scan)
        scan = copy_scan(scan)
        if self._transfer is not None:
            scan = self._transfer(scan, rng)
        original = scan
        if scan.boxes is not None:  # before the policy ignores labels of low confidence
            scan = self._without_unboxed(scan)
        scan = self._policies[source](scan, rng)
        self.notices.synthetic(original, scan)
        if scan.boxes is not None:
            scan = self._without_unboxed(scan)
        scan = self._augmented(scan, rng)
        # A policy or an augmentation of the user's may make a new scan, which is real by default.
        return self._to_sample(replace(scan, domain=SYNTHETIC), rng)

    def _augmented(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if self._augment is None:
            return scan
        changed = self._augment(scan, rng)
        if not isinstance(changed, Scan):
            raise ConfigError(f"augment= returned {type(changed).__name__}", "a Scan")
        if scan.boxes is not None and changed.boxes is None:
            self.notices.lost_boxes(scan)
        return changed


def make_transfer(target: "Transfer | Sensor | str | Path | None") -> "Transfer | None":
    """The transfer to a sensor, which may be given as a transfer already; None for None."""
    if target is None:
        return None
    # imported only by mixtures that change the sensor of their scans
    from lidar_synth.geometry.transfer import Transfer

    return target if isinstance(target, Transfer) else Transfer(load_sensor(target))
