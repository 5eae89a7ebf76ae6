"""WaffleIron: SemanticKITTI mixed with synthetic scans, and a launcher that runs its own training
script::

    cd WaffleIron
    LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.waffleiron launch_train.py \\
        --dataset semantic_kitti_mixed --path_dataset KITTI --log_path LOG --config CONFIG.yaml

Its instances for CutMix are extracted from the real scans only; PolarMix then takes partners of
both kinds.
"""

import os
from copy import copy
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.launcher import CPU, plain_errors, prepare_script
from lidar_synth.integrations.mixture import (
    MixedEpoch,
    class_ids,
    id_table,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_ids,
)
from lidar_synth.integrations.removed import provide

from lidar_synth.errors import LibraryError
from lidar_synth.geometry import Scan

NAME = "semantic_kitti_mixed"
USAGE = (
    "LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.waffleiron launch_train.py "
    "ARGUMENTS"
)
_FILE_IDS = id_table(1, 0, np.int32)
_IDS = id_table(0, 255, np.int32)


def dataset_class(stock: Any) -> Any:
    """Make a subclass of WaffleIron's ``SemanticKITTI`` (``stock``) that mixes real and synthetic
    scans."""

    class MixedWaffleIron(MixedEpoch, stock):  # type: ignore[misc]
        """WaffleIron's ``SemanticKITTI`` with synthetic scans in its training set; while the stock
        class extracts instances, it has only real scans."""

        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            if self.phase in ("train", "trainval"):
                settings = read_settings()
                refuse_unlabelled(settings, "WaffleIron")
                require_ids(self.learning_map, _FILE_IDS)
                self.real = copy(self)
                self.mixed = mix_for_trainer(len(self.real), settings)
                self.set_epoch(0)

        def set_epoch(self, epoch: int) -> None:
            """Set the epoch, also for workers."""
            super().set_epoch(epoch)
            self.im_idx = range(len(self.mixed))  # the stock class looks up a name here

        def __load_pc_internal__(self, index: int) -> Any:
            """Points (N, 4) float32, labels (N,) int32 0..18 or 255, and instances (N,) uint32, 0 =
            none."""
            real: Any = super() if self.mixed is None else self.real
            return self._take(int(index), real.__load_pc_internal__)

        def _synthetic(self, scan: Scan) -> Any:
            return (
                points_of(scan),
                class_ids(scan, _IDS),
                np.zeros(len(scan), np.uint32),
            )

        def load_pc(self, index: int) -> Any:
            """Points (N, 4), labels (N,), augmented by WaffleIron, and a name."""
            points, labels, name = super().load_pc(index)
            if self.mixed is not None:
                synthetic, number = self.mixed.plan()[int(index)]
                name = f"synthetic/{number}" if synthetic else self.real.im_idx[number]
            return points, labels, name

    return MixedWaffleIron


@cache
def register() -> Any:
    """Register the dataset ``semantic_kitti_mixed`` with WaffleIron, and set its epoch, also when
    training resumes.

    Returns:
        The class.

    Raises:
        LibraryError: if WaffleIron is not on the path, or not the version that is known here.
    """
    try:
        datasets = import_module("datasets")
        manager = import_module("utils.trainer").TrainingManager
        stock = datasets.LIST_DATASETS["semantic_kitti"]
    except (ImportError, AttributeError, KeyError) as error:
        raise LibraryError(
            f"WaffleIron's datasets cannot be imported ({error!r})",
            "a clone of WaffleIron 0.3",
            "cd WaffleIron",
        ) from error
    missing = [n for n in ("load_pc", "__load_pc_internal__") if not hasattr(stock, n)]
    if missing or not hasattr(manager, "one_epoch"):
        raise LibraryError(
            f"WaffleIron without {missing or 'TrainingManager.one_epoch'}",
            "WaffleIron 0.3",
        )

    mixed = dataset_class(stock)
    train = manager.one_epoch

    @wraps(train)
    def one_epoch(self: Any, training: bool = True) -> Any:
        dataset = self.loader_train.dataset
        if training and isinstance(dataset, mixed):
            dataset.set_epoch(self.current_epoch)
        return train(self, training)

    load = manager.load_state

    @wraps(load)
    def load_state(self: Any, *args: Any, **options: Any) -> None:
        try:
            load(self, *args, **options)
        # Its last line, when all is loaded, names a GPU; a CPU has none.
        except RuntimeError as error:
            if os.environ.get(CPU) != "1" or "accelerator device" not in str(error):
                raise

    datasets.LIST_DATASETS[NAME] = mixed
    manager.one_epoch = one_epoch
    manager.load_state = load_state
    return mixed


def main() -> None:
    """Run WaffleIron's training script with the dataset registered.

    The script is imported, not run as a file, so that the processes of
    ``--multiprocessing-distributed`` import this module and register the dataset as well.
    """
    script = prepare_script(USAGE, "torch.load")
    with plain_errors():
        register()
        training = import_module(Path(script).stem)
        arguments = training.get_default_parser().parse_args()
        training.main(arguments, training.load_model_config(arguments.config))


if __name__ == "__main__":
    main()
elif __name__ == "__mp_main__":
    provide("torch.load")
    register()
