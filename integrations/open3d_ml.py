"""Open3D-ML: SemanticKITTI with synthetic scans in its training split::

    from lidar_synth.integrations.open3d_ml import dataset_class, tell_epochs
    tell_epochs()
    dataset = dataset_class()(dataset_path="/data/SemanticKitti", mixture={"synthetic": "bank/", "ratio": 0.25})
    pipeline = ml3d.pipelines.SemanticSegmentation(model, dataset=dataset, ...)

Its cache identifies samples by name and would keep the synthetic scans of one epoch for ever: ``use_cache`` is refused.
"""

from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from lidar_synth.integrations.mixture import (
    EpochLoader,
    class_ids,
    id_table,
    mix,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_ids,
)

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry.scan import Scan

_IDS = id_table(1, 0, np.int32)


@cache
def dataset_class(package: str = "open3d.ml.datasets") -> Any:
    """The class ``MixedSemanticKITTI``, registered with Open3D-ML under that name.

    Args:
        package: the module of its datasets: that in Open3D, or ``"ml3d.datasets"`` in a checkout of Open3D-ML.

    Raises:
        LibraryError: if it cannot be imported.
    """
    try:
        stock = import_module(f"{package}.semantickitti")
    except ImportError as error:
        raise LibraryError(
            f"{package} cannot be imported ({error})", "Open3D with its ML part", "pip install open3d"
        ) from error

    mixed_split = _split_class(stock)

    class MixedSemanticKITTI(stock.SemanticKITTI):  # type: ignore[misc, name-defined]
        """Open3D-ML's ``SemanticKITTI`` with a mixed training split.

        Args:
            dataset_path: as there.
            mixture: settings (``lidar_synth.integrations.mixture.OPTIONS``) or a YAML file of them.
            options: as there.

        Raises:
            ConfigError: with ``use_cache``, or settings that cannot be served.
        """

        def __init__(self, dataset_path: str, mixture: Any = None, **options: Any) -> None:
            if options.get("use_cache"):
                raise ConfigError("use_cache=True for a mixture, whose scans change from epoch to epoch", "False")
            super().__init__(dataset_path, **options)
            self.mixture = read_settings(mixture)
            refuse_unlabelled(self.mixture, "Open3D-ML")
            require_ids(dict(enumerate(self.remap_lut_val.tolist())), _IDS)

        def get_split(self, split: str) -> Any:
            """A split; the training split is mixed."""
            return mixed_split(self, split) if split in ("train", "training") else super().get_split(split)

    stock.DATASET._register_module(MixedSemanticKITTI)
    return MixedSemanticKITTI


def _split_class(stock: Any) -> Any:
    """Make the class of the training split from the module with Open3D-ML's own."""

    class MixedSplit(stock.SemanticKITTISplit):  # type: ignore[misc]
        """The training split: unchanged real scans, mixed with synthetic ones."""

        def __init__(self, dataset: Any, split: str = "training") -> None:
            # First, because the base class makes a sampler, which reads the length.
            self.mixed = mix(len(dataset.get_split_list(split)), dataset.mixture, lambda scan, rng: scan)
            super().__init__(dataset, split=split)

        def set_epoch(self, epoch: int) -> None:
            """Set the epoch, also for workers."""
            self.mixed.set_epoch(epoch)

        def __len__(self) -> int:
            return len(self.mixed)

        def get_data(self, idx: int) -> dict[str, Any]:
            """Points (N, 3), features (N, 1) float32 and labels (N,) int32, 0 = unlabelled."""
            sample = self.mixed[idx]
            if not isinstance(sample, Scan):
                data: dict[str, Any] = super().get_data(sample)
                return data
            points = points_of(sample)
            return {"point": points[:, :3], "feat": points[:, 3:], "label": class_ids(sample, _IDS)}

        def get_attr(self, idx: int) -> dict[str, Any]:
            """Name and path; the name of a synthetic scan contains its number, and is therefore unique."""
            _, number = self.mixed.plan()[idx]
            if not self.mixed.domain(idx):
                attr: dict[str, Any] = super().get_attr(number)
                return attr | {"idx": idx}
            return {"idx": idx, "name": f"synthetic_{number}", "path": "", "split": self.split}

    return MixedSplit


def tell_epochs(pipeline: str = "open3d.ml.torch.pipelines") -> None:
    """Make Open3D-ML's segmentation pipeline set the epoch of its training split.

    Args:
        pipeline: the module of its pipelines; ``"ml3d.torch.pipelines"`` in a checkout.

    Raises:
        LibraryError: if they cannot be imported.
    """
    try:
        module = import_module(f"{pipeline}.semantic_segmentation")
    except ImportError as error:
        raise LibraryError(
            f"{pipeline} cannot be imported ({error})", "Open3D with its ML part", "pip install open3d"
        ) from error
    module.DataLoader = EpochLoader  # type: ignore[attr-defined]
