"""Cylinder3D: a point dataset that mixes, and a launcher that runs its own training script::

    cd Cylinder3D
    LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.cylinder3d train_cylinder_asym.py \\
        --config_path config/mixed.yaml

with ``pc_dataset_type: "SemKITTI_mixed"`` in that configuration. Every sample is a copy, because
Cylinder3D rotates points in place. The launcher replaces its loader by one that calls
``set_epoch``, which Cylinder3D does not. It counts epochs from 0 even when it starts from saved
weights.
"""

from functools import cache
from typing import Any

import numpy as np
from lidar_synth.integrations.launcher import prepare_script, run
from lidar_synth.integrations.mixture import (
    EpochLoader,
    MixedEpoch,
    class_ids,
    id_table,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    take_classes,
    trainer_ids,
)

from lidar_synth.errors import LibraryError
from lidar_synth.geometry import Scan

NAME = "SemKITTI_mixed"
USAGE = (
    "LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.cylinder3d "
    "train_cylinder_asym.py ARGUMENTS"
)
_IDS = id_table(1, 0, np.uint8)


@cache
def register() -> Any:
    """Register ``SemKITTI_mixed`` with Cylinder3D and return the class.

    Raises:
        LibraryError: if Cylinder3D is not on the path.
    """
    try:
        from dataloader.pc_dataset import SemKITTI_sk, register_dataset
    except ImportError as error:
        raise LibraryError(
            f"Cylinder3D's dataloader cannot be imported ({error})",
            "its checkout on the path",
            "cd Cylinder3D",
        ) from error

    class MixedPointCloud(MixedEpoch, SemKITTI_sk):  # type: ignore[misc]
        """``SemKITTI_sk`` with synthetic scans in its training set: (xyz, label (N, 1) uint8,
        strength)."""

        def __init__(
            self, data_path: str, imageset: str = "train", **options: Any
        ) -> None:
            super().__init__(data_path, imageset, **options)
            if imageset == "train":
                settings = read_settings()
                refuse_unlabelled(settings, "Cylinder3D")
                self._ids = trainer_ids(self.learning_map, take_classes(settings), _IDS)
                self.mixed = mix_for_trainer(len(self.im_idx), settings)

        def __getitem__(self, index: int) -> Any:
            return self._take(index, super().__getitem__)

        def _synthetic(self, scan: Scan) -> Any:
            points = points_of(scan)
            label = class_ids(scan, self._ids)[:, None]
            if self.return_ref:
                return (points[:, :3], label, points[:, 3])
            return (points[:, :3], label)

    MixedPointCloud.__name__ = NAME
    return register_dataset(MixedPointCloud)


def main() -> None:
    """Run Cylinder3D's training script with the dataset registered."""
    import torch.utils.data

    script = prepare_script(USAGE, "numpy.int", "spconv")
    register()
    torch.utils.data.DataLoader = EpochLoader  # type: ignore[misc]
    run(script)


if __name__ == "__main__":
    main()
