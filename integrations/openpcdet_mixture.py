"""What OpenPCDet's mixed datasets share: which sample is at a position, and what is refused before
training."""

from collections.abc import Collection
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import BOXES_HINT, LOOKED_AT, require_boxes
from lidar_synth.integrations.mixture import (
    MixedEpoch,
    first_synthetic,
    mix_for_trainer,
    read_settings,
    synthetic_epoch,
)
from lidar_synth.integrations.weights import KEY

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan


class MixedDetection(MixedEpoch):
    """A dataset of OpenPCDet mixed with synthetic scans; evaluation uses only real ones.

    Combine it with a dataset class of OpenPCDet, ``class MixedKitti(MixedDetection,
    KittiDataset)``, that calls ``_start`` at the end of its ``__init__`` and defines
    ``_synthetic``.

    OpenPCDet replaces a scan without boxes after augmentation by another random scan. To keep the
    ratio, a real scan is replaced by a real one here, and a synthetic one by a synthetic one; where
    many in a row have none, an error names ``labels: paste``, which gives them boxes.
    """

    known: Collection[str] = ()
    """The class names that a box of a synthetic scan may have."""
    _current: int | None = None  # the position whose sample is being made
    _replaced = 0  # number of synthetic scans without boxes that it replaced
    weighed = False
    """Whether samples have a weight in the loss."""
    dataset_cfg: Any
    class_names: Any

    def _start(self, known: Collection[str]) -> None:
        """Make the mixture and check its first synthetic scans; ``known`` are the class names that
        a box may have."""
        settings = read_settings(self.dataset_cfg.get("LIDAR_SYNTH", None))
        real: int = super().__len__()
        self.weighed = KEY in settings
        self.mixed = mix_for_trainer(real, settings, weighs=True)
        self.known = sorted({*self.class_names, *known})
        self._check_boxes()

    def merge_all_iters_to_one_epoch(
        self, merge: bool = True, epochs: int | None = None
    ) -> None:
        """Refuse to merge epochs of a mixture, which differ from one another.

        Raises:
            ConfigError: with ``merge`` for a mixture.
        """
        if merge and self.mixed is not None:
            raise ConfigError(
                f"merge_all_iters_to_one_epoch with {type(self).__name__}",
                "epochs one by one",
            )
        super().merge_all_iters_to_one_epoch(merge, epochs)  # type: ignore[misc]

    def domain(self, index: int) -> int:
        """0 if the sample at ``index`` is real in this epoch, 1 if it is synthetic."""
        return (
            0 if self.mixed is None else int(self.mixed.domain(index % len(self.mixed)))
        )

    def __len__(self) -> int:
        # OpenPCDet's own code, which runs while a sample is made, expects the number of real scans.
        if self.mixed is None or self._current is not None:
            return int(super(MixedEpoch, self).__len__())  # type: ignore[misc]
        return len(self.mixed)

    def __getitem__(self, index: int) -> Any:
        if self.mixed is None:
            return super().__getitem__(index)  # type: ignore[misc]
        if self._current is not None:
            return self._replacement(index)
        self._current = index % len(self.mixed)
        try:
            sample = self._take(self._current, super().__getitem__)  # type: ignore[misc]
            if self.weighed:
                sample[KEY] = np.float32(self.mixed.loss_weight(self._current))
            return sample
        finally:
            self._current = None
            self._replaced = 0

    def _replacement(self, index: int) -> Any:
        """The sample with which ``prepare_data`` replaces a scan without boxes after
        augmentation: for a synthetic one the next synthetic one of the epoch."""
        assert self._current is not None
        if not self.mixed.domain(self._current):
            return super().__getitem__(index)  # type: ignore[misc]
        scan = self.mixed[self._current]
        if self._replaced == LOOKED_AT:
            raise DataError(
                f"synthetic scan {scan.id!r} has no box of {list(self.class_names)} in range after "
                f"augmentation, nor have the {LOOKED_AT} before it",
                "at least one, because OpenPCDet replaces such a scan by another one",
                "Use labels: paste with a bank of objects, and gt_sampling.",
            )
        self._replaced += 1
        others = np.flatnonzero(self.mixed.plan().domain)
        later = np.searchsorted(others, self._current, side="right")
        self._current = int(others[later % len(others)])
        return self._take(self._current, super().__getitem__)  # type: ignore[misc]

    def _check_boxes(self) -> None:
        """Check that the first synthetic scans have boxes of known classes, and one that is
        trained on, if GT sampling adds none."""
        for scan in first_synthetic(self.mixed, LOOKED_AT):
            require_boxes(scan, self.known)
            if self._sampling() or self._trained_names(scan) & set(self.class_names):
                return
        if synthetic_epoch(self.mixed) is not None:
            raise DataError(
                f"the first synthetic scans have no box of {list(self.class_names)}, and there is "
                "no gt_sampling",
                "boxes, for a detector",
                BOXES_HINT,
            )

    def _trained_names(self, scan: Scan) -> set[str]:
        """The class names that a scan's boxes have for the trainer."""
        return set() if scan.boxes is None else set(scan.boxes.names)

    def _sampling(self) -> list[Any]:
        """The steps of GT sampling that are in use."""
        steps = self.dataset_cfg.DATA_AUGMENTOR
        unused = steps.get("DISABLE_AUG_LIST", [])
        return [
            s
            for s in steps.AUG_CONFIG_LIST
            if s.NAME == "gt_sampling" and s.NAME not in unused
        ]
