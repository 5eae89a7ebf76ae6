"""Pointcept: SemanticKITTI mixed with synthetic scans, registered when a configuration imports this
module::

    custom_imports = dict(
        imports=["lidar_synth.integrations.pointcept"], allow_failed_imports=False
    )
    hooks = [dict(type="SynthEpoch"), ...]
    data["train"] |= dict(type="MixedSemanticKITTI", mixture=dict(synthetic="bank/", ratio=0.25))

For segmentation, a synthetic scan always brings its labels: Pointcept reads a missing ``.label`` as
zeros, which mean "car". Self-supervised pretraining reads no labels, so that its mixture may have
``labels: none``.
"""

import copyreg
from collections.abc import Iterator
from typing import Any

import numpy as np
from lidar_synth.integrations.mixture import (
    MixedEpoch,
    class_ids,
    id_table,
    inner,
    labels_scans,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    take_classes,
    trainer_ids,
)

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry import Scan
from lidar_synth.mixing.epochs import Position

try:
    from pointcept.datasets.builder import DATASETS
    from pointcept.datasets.semantic_kitti import SemanticKITTIDataset
    from pointcept.engines.hooks.builder import HOOKS
    from pointcept.engines.hooks.default import HookBase
    from pointcept.utils.config import Config
except ImportError as error:
    raise LibraryError(
        f"pointcept cannot be imported ({error})",
        "a checkout of Pointcept",
        "PYTHONPATH=/path/to/Pointcept",
    ) from error


def read_config(state: Any) -> Config:
    """A configuration in a process that Pointcept starts for a GPU: to find this function, it
    imports this module, which Pointcept's own reading of a pickled configuration does not."""
    config = Config.__new__(Config)
    config.__setstate__(state)
    return config


copyreg.pickle(Config, lambda config: (read_config, (config.__getstate__(),)))


@DATASETS.register_module()
class MixedSemanticKITTI(MixedEpoch, SemanticKITTIDataset):  # type: ignore[misc]
    """``SemanticKITTIDataset`` with synthetic samples, for training.

    Args:
        mixture: settings (``lidar_synth.mixing.settings.OPTIONS``) or a YAML file of them.
            ``labels: none`` is refused if the transforms collect ``segment``.
        options: as for ``SemanticKITTIDataset``. ``cache`` is refused, because it identifies
            samples by name only.

    Raises:
        ConfigError: on settings that cannot be served, ``test_mode`` or ``cache``.
    """

    def __init__(self, mixture: Any = None, **options: Any) -> None:
        if options.get("test_mode") or options.get("cache"):
            raise ConfigError(
                "MixedSemanticKITTI with test_mode or cache", "training without a cache"
            )
        super().__init__(**options)
        settings = read_settings(mixture)
        self._labelled = labels_scans(settings)
        if collects_labels(options.get("transform")):
            refuse_unlabelled(settings, "Pointcept")
        taxonomy = take_classes(settings)
        self._ids = trainer_ids(
            self.learning_map, taxonomy, id_table(0, self.ignore_index, np.int32)
        )
        self.mixed = mix_for_trainer(len(self.data_list), settings)

    def domain(self, index: int) -> int:
        """0 if the sample at ``index`` is real in this epoch, 1 if it is synthetic."""
        return int(self.mixed.domain(self._place(index)))

    def __len__(self) -> int:
        return int(len(self.mixed) * self.loop)

    def get_data(self, idx: int) -> dict[str, Any]:
        """Coordinates (N, 3), strength (N, 1) float32, segment (N,) int32 and a name, as Pointcept
        reads them."""
        data: dict[str, Any] = self._take(self._place(idx), super().get_data)
        return data

    def _place(self, index: int) -> int:
        """The position of an index; each pass of Pointcept's ``loop`` has an epoch of its own."""
        later, position = divmod(index, len(self.mixed))
        return Position(position, self.mixed.epoch + later) if later else position

    def _synthetic(self, scan: Scan) -> dict[str, Any]:
        points = points_of(scan)
        return {
            "coord": points[:, :3],
            "strength": points[:, 3:],
            "segment": class_ids(scan, self._ids)
            if self._labelled
            else np.full(len(points), self._ids[IGNORE]),
            "name": f"synthetic_{scan.id}",
        }


def collects_labels(transform: Any) -> bool:
    """Whether a pipeline gives ``segment`` to the network; without a ``Collect`` step it gives
    everything."""
    keys = [step["keys"] for step in transform or [] if step["type"] == "Collect"]
    return not keys or any(
        "segment" in ([each] if isinstance(each, str) else each) for each in keys
    )


class EpochOf:
    """A trainer's loader that sets the epoch of its mixtures each time it begins to iterate.

    Pointcept requests scans before it calls a hook of an epoch, and any hook of ``before_train``
    may change the epoch in which training begins, as ``CheckpointLoader`` does. So the epoch is
    read when it is needed.

    Args:
        loader: any loader of Pointcept; its other attributes stay accessible.
        trainer: the trainer, whose ``epoch`` is read.
    """

    def __init__(self, loader: Any, trainer: Any) -> None:
        self._loader = loader
        self._trainer = trainer

    def __iter__(self) -> Iterator[Any]:
        for each in mixtures(self._loader):
            each.set_epoch(self._trainer.epoch * each.loop)
        return iter(self._loader)

    def __len__(self) -> int:
        return len(self._loader)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)


def mixtures(loader: Any) -> list[MixedSemanticKITTI]:
    """The mixtures that a loader reads, also within ``ConcatDataset`` and
    ``MultiDatasetDataloader``."""
    datasets = loader.datasets if hasattr(loader, "datasets") else [loader.dataset]
    return [
        each
        for dataset in datasets
        for each in inner(dataset)
        if isinstance(each, MixedSemanticKITTI)
    ]


@HOOKS.register_module()
class SynthEpoch(HookBase):  # type: ignore[misc]
    """Sets the epoch of the mixtures in the training data, at any place among the hooks.

    Raises:
        ConfigError: if the training data have none.
    """

    def before_train(self) -> None:
        """Set the epoch whenever the training loader begins to iterate."""
        loader = self.trainer.train_loader
        if not mixtures(loader):
            raise ConfigError(
                "the hook SynthEpoch without a mixture",
                "MixedSemanticKITTI in data.train",
            )
        self.trainer.train_loader = EpochOf(loader, self.trainer)
