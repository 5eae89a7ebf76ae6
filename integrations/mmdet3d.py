"""MMDetection3D 1.4: a file backend, datasets, a sampler and a hook, registered when a
configuration imports this module::

    custom_imports = dict(imports=["lidar_synth.integrations.mmdet3d"])
    custom_hooks = [dict(type="SynthEpochHook")]
    train_dataloader = dict(
        sampler=dict(_delete_=True, type="SynthSampler"), dataset=dict(ann_file=...)
    )

Segmentation uses the trainer's own datasets: the file backend serves points and labels of synthetic
entries. Detection needs ``SynthKittiDataset`` or ``SynthNuScenesDataset``, whose synthetic entries
get their boxes from the scan. ``mmdet3d_infos.write_infos`` writes the list,
``tools/install_mmdet3d.sh`` installs the trainer.
"""

import math
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.detection import ground_plane, require_boxes
from lidar_synth.integrations.mixture import id_table, inner, require_ids
from lidar_synth.integrations.mmdet3d_slots import (
    PREFIX,
    SlotFolder,
    draw_in_epoch,
    is_mixed,
    open_folder,
    read_url,
    scan_of,
    weight_of,
)
from lidar_synth.integrations.weights import KEY, weigh_mmdet3d
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.geometry import Scan

try:
    import mmdet3d
    from mmdet3d.datasets import (
        CBGSDataset,
        Det3DDataset,
        KittiDataset,
        NuScenesDataset,
        Seg3DDataset,
    )
    from mmdet3d.registry import DATA_SAMPLERS, DATASETS, HOOKS
    from mmdet3d.structures import LiDARInstance3DBoxes
    from mmengine.dataset import ClassBalancedDataset, DefaultSampler
    from mmengine.fileio.backends import BaseStorageBackend, register_backend
    from mmengine.hooks import Hook
    from mmengine.runner import EpochBasedTrainLoop
except ImportError as error:
    raise LibraryError(
        f"mmdet3d cannot be imported ({error})",
        "1.4.0",
        "bash tools/install_mmdet3d.sh",
    ) from error

if not mmdet3d.__version__.startswith("1.4."):
    raise LibraryError(
        f"mmdet3d {mmdet3d.__version__}", "1.4", "bash tools/install_mmdet3d.sh"
    )

# needs mmengine
from lidar_synth.integrations.mmdet3d_checkpoints import allow_checkpoints

allow_checkpoints()


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


class SynthBoxes:
    """A mixin for a ``Det3DDataset`` of a mixed list: a synthetic entry has the boxes of its scan
    in this epoch.

    Args:
        options: as for the dataset. ``filter_empty_gt`` must be False: replacing scans without
            boxes by others would change the ratio.

    Raises:
        ConfigError: on other boxes than LiDAR's, or ``filter_empty_gt``.
    """

    def __init__(self, **options: Any) -> None:
        name = type(self).__name__
        if options.get("filter_empty_gt", True) and not options.get("test_mode", False):
            raise ConfigError(
                f"{name} with filter_empty_gt=True, which replaces every scan without a box by a "
                "random one",
                "filter_empty_gt=False",
                "Give synthetic scans boxes by labels='paste'; ObjectSample adds more.",
            )
        if str(options.get("box_type_3d", "LiDAR")).lower() != "lidar":
            raise ConfigError(
                f"box_type_3d={options['box_type_3d']!r} of {name}", "'LiDAR'"
            )
        super().__init__(**options)

    def get_data_info(self, idx: int) -> dict[str, Any]:
        """The trainer's entry; a synthetic one gets the boxes of its scan, and a ground plane if
        real ones have one."""
        info: dict[str, Any] = super().get_data_info(idx)  # type: ignore[misc]
        path = info["lidar_points"]["lidar_path"]
        if path.startswith(PREFIX):
            scan = scan_of(path)
            info["ann_info"] = self._annotations(scan)
            if "plane" in info:
                info["plane"] = ground_plane(scan)
        return info

    def _annotations(self, scan: Scan) -> dict[str, Any]:
        """The boxes of a synthetic scan as the trainer's annotations; unused classes are left
        out."""
        known = self.METAINFO["classes"]  # type: ignore[attr-defined]
        required = require_boxes(scan, known)
        mapping = self.label_mapping  # type: ignore[attr-defined]
        labels = np.array([mapping[known.index(n)] for n in required.names], np.int64)
        values = required.values
        # nothing moves in the sweeps of a synthetic scan
        if getattr(self, "with_velocity", False):
            values = np.column_stack([values, np.zeros((len(values), 2), np.float32)])
        boxes = LiDARInstance3DBoxes(
            values[labels >= 0], box_dim=values.shape[1], origin=(0.5, 0.5, 0.5)
        )
        return {
            "gt_bboxes_3d": boxes,
            "gt_labels_3d": labels[labels >= 0],
            "instances": [],
        }


@DATASETS.register_module(force=True)
class SynthKittiDataset(SynthBoxes, KittiDataset):  # type: ignore[misc]
    """``KittiDataset`` for a mixed list."""


@DATASETS.register_module(force=True)
class SynthNuScenesDataset(SynthBoxes, NuScenesDataset):  # type: ignore[misc]
    """``NuScenesDataset`` for a mixed list."""

    def parse_data_info(self, info: dict[str, Any]) -> Any:
        """The trainer's entry; its sweeps keep their paths, of which the trainer keeps the names
        only."""
        sweeps = info.get("lidar_sweeps", ())
        paths = [sweep["lidar_points"]["lidar_path"] for sweep in sweeps]
        parsed = super().parse_data_info(info)
        for sweep, path in zip(sweeps, paths, strict=True):
            sweep["lidar_points"]["lidar_path"] = path
        return parsed


@DATA_SAMPLERS.register_module(force=True)
class SynthSampler(DefaultSampler):  # type: ignore[misc]
    """The sampler of a mixed list, for loops by epochs and by iterations.

    Its order is a function of the mixture's seed and the epoch, so a resumed run sees the samples
    of an uninterrupted one. Each index carries its epoch to the worker process that reads the
    sample.

    Args:
        dataset: holds a mixed list.
        seed: not used: the runner draws another one if a run is resumed.
        options: ``shuffle`` and ``round_up`` of ``DefaultSampler``. Where an epoch has other
            entries than all of the list (a schedule, ``epoch_size``), they come in the plan's
            order, and steps such as LaserMix draw partners from them.

    Attributes:
        start: number of samples that the next pass leaves out.

    Raises:
        ConfigError: on a dataset without a mixed list, other classes than SemanticKITTI's, a
            detector's dataset without synthetic boxes, or one that repeats scans by class.
    """

    def __init__(self, dataset: Any, seed: int | None = None, **options: Any) -> None:
        self.folders = _checked(dataset)
        folders = self.folders
        super().__init__(dataset, seed=folders[0].mixed.seed, **options)
        dataset.__getitems__ = Fetch(dataset, [folder.path for folder in folders])
        self.start = 0
        self.planned = next((folder for folder in folders if not folder.whole), None)
        if self.planned is None:
            return
        listed = self.planned.real + self.planned.slots
        if len(folders) > 1 or len(dataset) != listed:
            raise ConfigError(
                f"a dataset of {len(dataset)} samples around a mixed list of {listed} with a "
                "schedule or epoch_size",
                "the list's own dataset, not repeated or joined with others",
                "Of a RepeatDataset: times=1.",
            )
        [mixed] = [each for each in inner(dataset) if hasattr(each, "ann_file")]
        mixed.pipeline.transforms.insert(0, partial(draw_in_epoch, self.planned.path))
        length = len(self.planned.mixed)
        self.num_samples = math.ceil(
            (length - (0 if self.round_up else self.rank)) / self.world_size
        )
        self.total_size = (
            self.num_samples * self.world_size if self.round_up else length
        )

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """The (epoch, index) of each sample."""
        start = self.start
        self.start = 0
        epoch = self.epoch
        order = (
            super().__iter__()
            if self.planned is None
            else self._planned(self.planned.entries(epoch))
        )
        return ((epoch, index) for index in islice(order, start, None))

    def _planned(self, entries: NDArray[np.int64]) -> Iterator[int]:
        """This process's entries; the first ones again where all processes need as many."""
        whole = np.resize(entries, self.total_size)
        return iter(whole[self.rank :: self.world_size].tolist())


class Fetch:
    """Reads the samples of a batch in the epoch of their indices; torch's loaders call it.

    Args:
        dataset: the loader's dataset.
        paths: of the folders of its mixed lists.
    """

    def __init__(self, dataset: Any, paths: list[Path]) -> None:
        self.dataset = dataset
        self.paths = paths

    def __call__(self, indices: list[tuple[int, int]]) -> list[Any]:
        """The samples of (epoch, index) pairs."""
        samples = []
        for epoch, index in indices:
            for path in self.paths:
                open_folder(path).epoch = epoch
            samples.append(self.dataset[index])
        return samples


@HOOKS.register_module(force=True)
class SynthEpochHook(Hook):  # type: ignore[misc]
    """Checks that training uses ``SynthSampler``, and resumes in the middle of an epoch.

    The trainer's loop by epochs starts the epoch of a checkpoint again; the hook leaves out the
    samples that it has seen. Its loop by iterations reads and drops them itself.
    """

    def before_train(self, runner: Any) -> None:
        """Check the sampler.

        Raises:
            ConfigError: if it is another one.
        """
        if not isinstance(runner.train_dataloader.sampler, SynthSampler):
            raise ConfigError(
                f"SynthEpochHook with the sampler {type(runner.train_dataloader.sampler).__name__}",
                "train_dataloader = dict(sampler=dict(_delete_=True, type='SynthSampler'))",
            )
        sampler = runner.train_dataloader.sampler
        if any(KEY in folder.settings for folder in sampler.folders):
            weigh_mmdet3d(runner.model, lambda path: weight_of(path, sampler.epoch))
        self._resumes = True

    def before_train_epoch(self, runner: Any) -> None:
        """Set the epoch, and after a resumption the first sample."""
        loader = runner.train_dataloader
        if not isinstance(runner.train_loop, EpochBasedTrainLoop):
            return
        loader.sampler.set_epoch(runner.epoch)
        done = runner.iter - runner.epoch * len(loader)
        # otherwise at the start of an epoch
        if self._resumes and 0 < done <= len(loader):
            loader.sampler.start = done * loader.batch_size
        self._resumes = False


def _checked(dataset: Any) -> list[SlotFolder]:
    """The folders of a dataset's mixed lists.

    Raises:
        ConfigError: see ``SynthSampler``.
    """
    lists = [
        each
        for each in inner(dataset)
        if isinstance(getattr(each, "ann_file", None), str)
    ]
    mixed = [each for each in lists if is_mixed(Path(each.ann_file).resolve().parent)]
    if not mixed:
        raise ConfigError(
            f"SynthSampler with {[each.ann_file for each in lists]}",
            "a mixed list, an ann_file that write_infos wrote",
        )
    for each in mixed:
        _check_dataset(each)
    for each in inner(dataset):
        if isinstance(each, CBGSDataset | ClassBalancedDataset):
            raise ConfigError(
                f"{type(each).__name__} around a mixed list: it repeats scans by class, which "
                "changes the ratio",
                "the dataset without it",
                "Balance the real scans by write_infos(..., balance=True).",
            )
    folders = [open_folder(Path(each.ann_file).resolve().parent) for each in mixed]
    for each, folder in zip(mixed, folders, strict=True):
        if len(each) != (listed := folder.real + folder.slots):
            raise ConfigError(
                f"a dataset with {len(each)} of the {listed} entries of {each.ann_file}",
                "all of them",
                "Leave indices, scene_idxs and filters out; fewer real scans: a shorter list.",
            )
    return folders


def _check_dataset(dataset: Any) -> None:
    if isinstance(dataset, Seg3DDataset):
        ids = id_table(0, dataset.ignore_index, np.int64)
        require_ids(
            dict(enumerate(np.asarray(dataset.seg_label_mapping).tolist())), ids
        )
    elif isinstance(dataset, Det3DDataset) and not isinstance(dataset, SynthBoxes):
        raise ConfigError(
            f"{type(dataset).__name__} with a mixed list: its synthetic scans would have no boxes",
            "SynthKittiDataset or SynthNuScenesDataset",
            "For another dataset, register class Mine(SynthBoxes, TheDataset).",
        )
