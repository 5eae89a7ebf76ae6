"""Pointcept: SemanticKITTI mixed with synthetic scans, registered when a configuration imports this module::

    custom_imports = dict(imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False)
    hooks = [dict(type="SynthEpoch"), ...]
    data["train"] |= dict(type="MixedSemanticKITTI", mixture=dict(synthetic="bank/", ratio=0.25))

A synthetic scan always brings its labels: Pointcept reads a missing ``.label`` as zeros, which mean "car".
"""

from typing import Any

import numpy as np
from lidar_synth.integrations.mixture import (
    class_ids,
    id_table,
    inner,
    mix,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_ids,
)

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry.scan import Scan

try:
    from pointcept.datasets.builder import DATASETS
    from pointcept.datasets.semantic_kitti import SemanticKITTIDataset
    from pointcept.engines.hooks.builder import HOOKS
    from pointcept.engines.hooks.default import HookBase
except ImportError as error:
    raise LibraryError(
        f"pointcept cannot be imported ({error})", "a checkout of Pointcept", "PYTHONPATH=/path/to/Pointcept"
    ) from error


@DATASETS.register_module()
class MixedSemanticKITTI(SemanticKITTIDataset):  # type: ignore[misc]
    """``SemanticKITTIDataset`` with synthetic samples, for training.

    Args:
        mixture: settings (``lidar_synth.integrations.mixture.OPTIONS``) or a YAML file of them.
        options: as for ``SemanticKITTIDataset``. ``cache`` is refused, because it identifies samples by name only.

    Raises:
        ConfigError: on settings that cannot be served, ``test_mode`` or ``cache``.
    """

    def __init__(self, mixture: Any = None, **options: Any) -> None:
        if options.get("test_mode") or options.get("cache"):
            raise ConfigError("MixedSemanticKITTI with test_mode or cache", "training without a cache")
        super().__init__(**options)
        settings = read_settings(mixture)
        refuse_unlabelled(settings, "Pointcept")
        self._ids = id_table(0, self.ignore_index, np.int32)
        require_ids(self.learning_map, self._ids)
        self.mixed = mix(len(self.data_list), settings, lambda scan, rng: scan)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, also for workers, persistent ones included."""
        self.mixed.set_epoch(epoch)

    def domain(self, index: int) -> int:
        """0 if the sample at ``index`` is real in this epoch, 1 if it is synthetic."""
        return int(self.mixed.domain(index % len(self.mixed)))

    def __len__(self) -> int:
        return int(len(self.mixed) * self.loop)

    def get_data(self, idx: int) -> dict[str, Any]:
        """Coordinates (N, 3), strength (N, 1) float32, segment (N,) int32 and a name, as Pointcept reads them."""
        sample = self.mixed[idx % len(self.mixed)]
        if not isinstance(sample, Scan):
            data: dict[str, Any] = super().get_data(sample)
            return data
        points = points_of(sample)
        return {
            "coord": points[:, :3],
            "strength": points[:, 3:],
            "segment": class_ids(sample, self._ids),
            "name": f"synthetic_{sample.id}",
        }


@HOOKS.register_module()
class SynthEpoch(HookBase):  # type: ignore[misc]
    """Sets the next epoch when one ends, because Pointcept's loader requests scans before it calls hooks."""

    def before_train(self) -> None:
        """Set the epoch in which training begins."""
        self._tell(self.trainer.start_epoch)

    def after_epoch(self) -> None:
        """Set the next epoch."""
        self._tell(self.trainer.epoch + 1)

    def _tell(self, epoch: int) -> None:
        for each in inner(self.trainer.train_loader.dataset):
            if isinstance(each, MixedSemanticKITTI):
                each.set_epoch(epoch)
