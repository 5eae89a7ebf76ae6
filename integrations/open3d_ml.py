"""Open3D-ML: SemanticKITTI with synthetic scans in its training split::

    import open3d.ml.torch as ml3d
    from lidar_synth.integrations.open3d_ml import dataset_class
    dataset = dataset_class()(
        dataset_path="/data/SemanticKitti", mixture={"synthetic": "bank/", "ratio": 0.25}
    )
    pipeline = ml3d.pipelines.SemanticSegmentation(model, dataset=dataset, ...)

``use_cache`` is refused: the cache identifies samples by name, and would keep the synthetic scans
of one epoch forever.
"""

import sys
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lidar_synth.integrations.mixture import (
    EpochLoader,
    MixedEpoch,
    class_ids,
    id_table,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_ids,
)

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry import Scan

_IDS = id_table(1, 0, np.int32)


@cache
def dataset_class() -> Any:
    """The class ``MixedSemanticKITTI``, registered with Open3D-ML under that name.

    Open3D-ML's segmentation pipeline sets the epoch of its training split from then on. With
    ``OPEN3D_ML_ROOT`` set, Open3D takes its ML part from that checkout.

    Raises:
        LibraryError: if Open3D's ML part cannot be imported.
    """
    ml3d = _library()
    stock = sys.modules[ml3d.datasets.SemanticKITTI.__module__]
    pipeline = sys.modules[ml3d.pipelines.SemanticSegmentation.__module__]
    pipeline.DataLoader = _PipelineLoader  # type: ignore[attr-defined]
    mixed_split = _split_class(stock)

    class MixedSemanticKITTI(stock.SemanticKITTI):  # type: ignore[misc, name-defined]
        """Open3D-ML's ``SemanticKITTI`` with a mixed training split.

        Args:
            dataset_path: as there.
            mixture: settings (``lidar_synth.mixing.settings.OPTIONS``) or a YAML file of them.
            options: as there.

        Raises:
            ConfigError: with ``use_cache``, or settings that cannot be served.
        """

        def __init__(
            self, dataset_path: str, mixture: Any = None, **options: Any
        ) -> None:
            if options.get("use_cache"):
                raise ConfigError(
                    "use_cache=True for a mixture, whose scans change from epoch to epoch",
                    "False",
                )
            super().__init__(dataset_path, **options)
            self.mixture = read_settings(mixture)
            refuse_unlabelled(self.mixture, "Open3D-ML")
            require_ids(dict(enumerate(self.remap_lut_val.tolist())), _IDS)

        def get_split(self, split: str) -> Any:
            """A split; the training split is mixed."""
            if split in ("train", "training"):
                return mixed_split(self, split)
            return super().get_split(split)

    stock.DATASET._register_module(MixedSemanticKITTI)
    return MixedSemanticKITTI


def _split_class(stock: Any) -> Any:
    """Make the class of the training split from the module with Open3D-ML's own."""

    class MixedSplit(MixedEpoch, stock.SemanticKITTISplit):  # type: ignore[misc]
        """The training split: unchanged real scans, mixed with synthetic ones."""

        def __init__(self, dataset: Any, split: str = "training") -> None:
            # First, because the base class makes a sampler, which reads the length.
            real = len(dataset.get_split_list(split))
            self.mixed = mix_for_trainer(real, dataset.mixture)
            super().__init__(dataset, split=split)

        def get_data(self, idx: int) -> dict[str, Any]:
            """Points (N, 3), features (N, 1) float32 and labels (N,) int32, 0 = unlabelled."""
            data: dict[str, Any] = self._take(idx, super().get_data)
            return data

        def _synthetic(self, scan: Scan) -> dict[str, Any]:
            points = points_of(scan)
            return {
                "point": points[:, :3],
                "feat": points[:, 3:],
                "label": class_ids(scan, _IDS),
            }

        def get_attr(self, idx: int) -> dict[str, Any]:
            """Name and path; the name of a synthetic scan contains its number, and is therefore
            unique."""
            _, number = self.mixed.plan()[idx]
            if not self.mixed.domain(idx):
                attr: dict[str, Any] = super().get_attr(number)
                return attr | {"idx": idx}
            return {
                "idx": idx,
                "name": f"synthetic_{number}",
                "path": "",
                "split": self.split,
            }

    return MixedSplit


class _PipelineLoader(EpochLoader):
    """``EpochLoader`` with the pipeline's arguments; its ``worker_init_fn`` overflows 32 bits with
    numpy 2."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(
            *args,
            **options
            | ({"worker_init_fn": _seed} if options.get("worker_init_fn") else {}),
        )


def _seed(worker: int) -> None:
    """Seed numpy's global generator, from which Open3D-ML draws, differently in each worker and
    epoch."""
    np.random.seed(torch.initial_seed() % 2**32)  # noqa: NPY002


def _library() -> Any:
    """``open3d.ml.torch``, or an error that says which of its parts is missing."""
    try:
        ml3d = import_module("open3d.ml.torch")
        # Accessed here, because they are imported only when they are first used.
        return SimpleNamespace(datasets=ml3d.datasets, pipelines=ml3d.pipelines)
    except (ImportError, OSError, RuntimeError) as error:
        if isinstance(error, ImportError):
            hint = (
                "pip install 'open3d[ml]'; lidar-synth doctor lists the system libraries that it "
                "needs."
            )
        elif isinstance(error, RuntimeError):
            hint = (
                "Each release of Open3D has operators for one release of torch: install that "
                "one."
            )
        else:
            hint = (
                "Open3D's operators for CUDA do not load with a torch for CPUs: pip install "
                "'open3d-cpu[ml]'."
            )
        raise LibraryError(
            f"open3d.ml.torch cannot be imported with torch {torch.__version__} ({error})",
            "Open3D with its ML part, built for this torch",
            hint,
        ) from error
