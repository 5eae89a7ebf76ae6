"""MMDetection3D 1.4: a file backend, a dataset and a hook, registered when a configuration imports this module::

    custom_imports = dict(imports=["lidar_synth.integrations.mmdet3d"])
    custom_hooks = [dict(type="SynthEpochHook")]

Segmentation uses the trainer's own datasets: the file backend serves points and labels of synthetic entries. Detection
needs ``SynthKittiDataset``, whose synthetic entries get their boxes and ground plane from the scan.
``mmdet3d_infos.write_infos`` writes the list, ``tools/install_mmdet3d.sh`` installs the trainer.
"""

from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import check_names, ground_plane
from lidar_synth.integrations.mixture import id_table, inner, require_ids
from lidar_synth.integrations.mmdet3d_infos import (
    MIXTURE,
    PREFIX,
    Folder,
    open_folder,
    read_url,
    require_boxes,
    scan_of,
)

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.geometry.scan import Scan

try:
    import mmdet3d
    from mmdet3d.datasets import KittiDataset, Seg3DDataset
    from mmdet3d.registry import DATASETS, HOOKS
    from mmdet3d.structures import LiDARInstance3DBoxes
    from mmengine.fileio.backends import BaseStorageBackend, register_backend
    from mmengine.hooks import Hook
except ImportError as error:
    raise LibraryError(f"mmdet3d cannot be imported ({error})", "1.4.0", "bash tools/install_mmdet3d.sh") from error

if not mmdet3d.__version__.startswith("1.4."):
    raise LibraryError(f"mmdet3d {mmdet3d.__version__}", "1.4", "bash tools/install_mmdet3d.sh")


@register_backend("lsynth", prefixes="lsynth", force=True)
class SynthBackend(BaseStorageBackend):  # type: ignore[misc]
    """Serves ``lsynth://`` paths to everything that reads through ``mmengine.fileio``."""

    def get(self, filepath: str | Path) -> bytes:
        """The bytes of a synthetic scan's points or labels; see ``read_url``."""
        return read_url(str(filepath))

    def get_text(self, filepath: str | Path, encoding: str = "utf-8") -> str:
        """Refuse to read text, because these paths have none.

        Raises:
            DataError: always.
        """
        raise DataError(f"{filepath} read as text", "points (.bin) or labels (.label)")


@DATASETS.register_module(force=True)
class SynthKittiDataset(KittiDataset):  # type: ignore[misc]
    """``KittiDataset`` for a mixed list: the boxes of a synthetic entry are those of its scan in this epoch.

    Args:
        options: as for ``KittiDataset``. ``filter_empty_gt`` must be False: replacing scans without boxes by others
            would change the ratio.

    Raises:
        ConfigError: on other boxes than LiDAR's, or ``filter_empty_gt``.
    """

    def __init__(self, **options: Any) -> None:
        if options.get("filter_empty_gt", True) and not options.get("test_mode", False):
            raise ConfigError(
                "SynthKittiDataset with filter_empty_gt=True, which replaces every scan without a box by a random one",
                "filter_empty_gt=False",
                "Give synthetic scans boxes by labels='mix'; ObjectSample adds more.",
            )
        if str(options.get("box_type_3d", "LiDAR")).lower() != "lidar":
            raise ConfigError(f"box_type_3d={options['box_type_3d']!r} of SynthKittiDataset", "'LiDAR'")
        super().__init__(**options)

    def get_data_info(self, idx: int) -> dict[str, Any]:
        """The trainer's entry; a synthetic one gets its boxes (centre of the floor) and its ground plane."""
        info: dict[str, Any] = super().get_data_info(idx)
        path = info["lidar_points"]["lidar_path"]
        if path.startswith(PREFIX):
            folder, _, name = path.removeprefix(PREFIX).rpartition("/")
            scan = scan_of(folder, int(name.removesuffix(".bin")))
            info["ann_info"] = self._annotations(scan)
            info["plane"] = ground_plane(scan)
        return info

    def _annotations(self, scan: Scan) -> dict[str, Any]:
        given, known = require_boxes(scan), self.METAINFO["classes"]
        check_names(scan, known)
        ids = [self.label_mapping[known.index(n)] if n in known else -1 for n in given.names]
        labels = np.array(ids, np.int64).reshape(-1)
        boxes = LiDARInstance3DBoxes(given.values[labels >= 0], origin=(0.5, 0.5, 0.5))
        return {"gt_bboxes_3d": boxes, "gt_labels_3d": labels[labels >= 0], "instances": []}


@HOOKS.register_module(force=True)
class SynthEpochHook(Hook):  # type: ignore[misc]
    """Passes the epoch to every worker, and checks labels and classes before training starts."""

    def before_train(self, runner: Any) -> None:
        """Check the training data.

        Raises:
            ConfigError: if no dataset is a mixed list, or the classes are not SemanticKITTI's.
        """
        self._folders = [folder for _, folder in _mixed(runner.train_dataloader.dataset)]
        if not self._folders:
            raise ConfigError("SynthEpochHook without a mixed list", "an ann_file that write_infos wrote")
        for dataset, _ in _mixed(runner.train_dataloader.dataset):
            if isinstance(dataset, Seg3DDataset):
                ids = id_table(0, dataset.ignore_index, np.int64)
                require_ids(dict(enumerate(np.asarray(dataset.seg_label_mapping).tolist())), ids)
        self._tell(_epoch(runner))

    def before_train_epoch(self, runner: Any) -> None:
        """Set the new epoch, before the loader's workers request its first scans."""
        self._tell(_epoch(runner))

    def before_train_iter(self, runner: Any, batch_idx: int, data_batch: Any = None) -> None:
        """Set the epoch in loops by iterations: one epoch is a pass through the list, up to prefetched batches."""
        if _by_iterations(runner) and runner.iter % _steps(runner) == 0:
            self._tell(_epoch(runner))

    def _tell(self, epoch: int) -> None:
        for folder in self._folders:
            folder.epoch = epoch


def _by_iterations(runner: Any) -> bool:
    return type(runner.train_loop).__name__ == "IterBasedTrainLoop"


def _steps(runner: Any) -> int:
    """Iterations of a pass through the list."""
    loader = runner.train_dataloader
    return max(int(len(loader.dataset) // (loader.batch_size * runner.world_size)), 1)


def _epoch(runner: Any) -> int:
    return int(runner.iter // _steps(runner) if _by_iterations(runner) else runner.epoch)


def _mixed(dataset: Any) -> list[tuple[Any, Folder]]:
    """The datasets that hold a mixed list, with its folder."""
    held = [each for each in inner(dataset) if isinstance(getattr(each, "ann_file", None), str)]
    folders = [(each, Path(each.ann_file).resolve().parent) for each in held]
    return [(each, open_folder(folder)) for each, folder in folders if (folder / MIXTURE).is_file()]
