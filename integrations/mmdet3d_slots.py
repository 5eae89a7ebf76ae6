"""The synthetic scans behind a mixed list of MMDetection3D.

A list of ``mmdet3d_infos.write_infos`` has a *slot* for each synthetic sample of an epoch. Its
files are ``lsynth://<folder>/<slot>.bin`` and ``.label``. ``plan(seed, epoch)`` assigns a scan to
each slot, a new one in each epoch. The epoch comes to a worker process with each batch
(``mmdet3d.SynthSampler``), never by a file, so that several runs can share a list.
"""

import json
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lidar_synth.integrations.mixture import (
    mix_for_trainer,
    points_of,
    require_labels,
    synthetic_epoch,
)
from lidar_synth.integrations.mmdet3d_lists import CLASSES
from lidar_synth.integrations.nuscenes import (
    CLASSES as NUSCENES_CLASSES,
    as_nuscenes,
    five_values,
)
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_text
from lidar_synth.formats.calibration import Calibration, in_view
from lidar_synth.formats.point_labels import encode_labels
from lidar_synth.geometry import Scan
from lidar_synth.mixing.schedules import constant_from

PREFIX = "lsynth://"
MIXTURE = "mixture.json"
INFOS = "infos.json"
FORMAT = "lidar-synth-mmdet3d/2"
"""The format of ``mixture.json``."""

# number of scans in the cache of a process: points, labels and boxes of a scan are read one after
# another
_CACHED = 4


class SampleForm(NamedTuple):
    """The form of a dataset's points and boxes.

    Args:
        classes: the names of its boxes.
        features: number of values of a point.
        convert: gives a scan the dataset's frame and names.
        points: (N, features) float32 of a converted scan.
    """

    classes: tuple[str, ...]
    features: int
    convert: Callable[[Scan], Scan]
    points: Callable[[Scan], NDArray[np.float32]]


LAYOUTS = {
    "kitti": SampleForm(CLASSES, 4, lambda scan: scan, points_of),
    "nuscenes": SampleForm(NUSCENES_CLASSES, 5, as_nuscenes, five_values),
}


class SlotFolder:
    """The slots of a mixed list.

    Args:
        path: the folder.
        facts: the content of its ``mixture.json``.

    Attributes:
        mixed: the mixture; its real samples are the numbers of the list's real entries.
        slots: the largest number of synthetic samples in an epoch.
        real: number of real entries in the list.
        layout: the form of points and boxes.
    """

    def __init__(self, path: Path, facts: dict[str, Any]) -> None:
        self.path = path
        self.settings = {k: _by_epoch(v) for k, v in facts["settings"].items()}
        self.real = int(facts["real"])
        self.layout = LAYOUTS[facts["layout"]]
        self.mixed = mix_for_trainer(self.real, self.settings, weighs=True)
        mixes = synthetic_epoch(self.mixed) is not None
        self.slots = self.mixed.mixture.laps[0] if mixes else 0
        self._view = (
            None if facts.get("view") is None else Calibration(**_arrays(facts["view"]))
        )
        self._cached: OrderedDict[tuple[int, int], Scan] = OrderedDict()
        self._entries: tuple[int, NDArray[np.int64]] | None = None
        self._epoch: int | None = None

    @classmethod
    def open(cls, path: Path) -> "SlotFolder":
        """Open a folder of ``write_infos``.

        Raises:
            DataError: on another format, or if the synthetic scans, and thus the plan, have changed
                since.
        """
        facts = json.loads(read_text(path / MIXTURE))
        if facts.get("format") != FORMAT:
            raise DataError(
                f"{path / MIXTURE} has format {facts.get('format')!r}",
                FORMAT,
                "Write the list again.",
            )
        folder = cls(path, facts)
        if folder.mixed.plan(0).hash != facts["plan"]:
            raise DataError(
                f"{path}: the synthetic scans {folder.settings['synthetic']} are not those of "
                "the list",
                "the bank or model for which the list was written",
                "Write the list again.",
            )
        return folder

    @property
    def epoch(self) -> int:
        """The epoch of the samples that this process reads; 0 until it is set.

        Raises:
            ConfigError: in a worker process where it was never set: every epoch would have the same
                scans.
        """
        if self._epoch is None and get_worker_info() is not None:
            raise ConfigError(
                f"a DataLoader that reads {self.path} without its sampler",
                "train_dataloader = dict(sampler=dict(type='SynthSampler'))",
                "Without it, every epoch would have the synthetic scans of the first.",
            )
        return self._epoch or 0

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._epoch = epoch

    @property
    def whole(self) -> bool:
        """Whether every epoch has each entry of the list once: one ratio, and all real scans."""
        return (
            self.mixed.mixture.epoch_size == "add"
            and constant_from(self.mixed.mixture.ratio) == 0
        )

    def entries(self, epoch: int) -> NDArray[np.int64]:
        """(N,) the list's entries that an epoch has, in the order of its plan."""
        if self._entries is None or self._entries[0] != epoch:
            plan = self.mixed.plan(epoch)
            entries = plan.index
            entries[plan.domain] = self.real + np.arange(plan.synthetics)
            self._entries = (epoch, entries)
        return self._entries[1]

    def scan(self, slot: int) -> Scan:
        """The scan of a slot in the current epoch, in the form of the dataset, with its labels and
        boxes.

        Raises:
            DataError: on a slot that does not exist, or on boxes with names that the dataset cannot
                have.
        """
        key = (self.epoch, slot)
        if key not in self._cached:
            scan = self.mixed.sample(*self._position(*key))
            self._cached[key] = self.layout.convert(
                scan if self._view is None else in_view(scan, self._view)
            )
            if len(self._cached) > _CACHED:
                self._cached.popitem(last=False)
        return self._cached[key]

    def _position(self, epoch: int, slot: int) -> tuple[int, int]:
        """Epoch and position of a slot: in the nearest epoch that has synthetic scans."""
        nearest = synthetic_epoch(self.mixed, epoch)
        if nearest is None or not 0 <= slot < self.slots:
            raise DataError(f"slot {slot} of {self.path}", f"one of its {self.slots}")
        positions = np.flatnonzero(self.entries(nearest) >= self.real)
        return nearest, int(positions[slot % len(positions)])


def _by_epoch(value: Any) -> Any:
    """A setting by epoch, with its epochs as numbers, which JSON stores as text."""
    if not isinstance(value, dict):
        return value
    return {int(k) if str(k).isdigit() else k: v for k, v in value.items()}


open_folder = cache(SlotFolder.open)
"""``SlotFolder.open``, once per process and folder."""


class EpochEntries:
    """The entries of the current epoch as the dataset of a pipeline's steps, which draw partners
    from it, as LaserMix does.

    Args:
        dataset: of the whole list.
        folder: of the list.
    """

    def __init__(self, dataset: Any, folder: SlotFolder) -> None:
        self.dataset = dataset
        self.folder = folder

    def __len__(self) -> int:
        return len(self.folder.mixed)

    def get_data_info(self, index: int) -> dict[str, Any]:
        """The trainer's entry at a position of the epoch, 0 <= index < length."""
        entries = self.folder.entries(self.folder.epoch)
        info: dict[str, Any] = self.dataset.get_data_info(int(entries[index]))
        return info


def draw_in_epoch(path: Path, results: dict[str, Any]) -> dict[str, Any]:
    """The first step of the pipeline of a list in the folder ``path``: those after it draw partners
    from the epoch's entries only. A detector's samples have no dataset, so that it draws none."""
    if "dataset" in results:
        results["dataset"] = EpochEntries(results["dataset"], open_folder(path))
    return results


def read_url(url: str) -> bytes:
    """The bytes of ``lsynth://<source>/<number>.bin`` (float32 points) or ``.label``
    (SemanticKITTI's).

    Args:
        url: the URL; its source is the folder of a mixed list, whose layout the points have.

    Raises:
        DataError: on any other URL, or on labels of a scan without labels.
        FileError: if there is no such list.
    """
    folder, number, kind = split_url(url)
    scan = folder.scan(number)
    if kind == "bin":
        return folder.layout.points(scan).astype("<f4").tobytes()
    require_labels(scan)
    return encode_labels(scan, SEMANTIC_KITTI).astype("<u4").tobytes()


def split_url(url: str) -> tuple[SlotFolder, int, str]:
    """Folder, number and ending (``bin`` or ``label``) of a URL; raises as ``read_url``."""
    source, _, name = url.removeprefix(PREFIX).rpartition("/")
    number, _, kind = name.partition(".")
    if not (
        url.startswith(PREFIX)
        and source
        and number.isdigit()
        and kind in ("bin", "label")
    ):
        raise DataError(f"{url!r}", f"{PREFIX}<folder>/<number>.bin or .label")
    return open_folder(Path(source)), int(number), kind


def is_mixed(folder: Path) -> bool:
    """Whether a folder is that of a mixed list."""
    return (folder / MIXTURE).is_file()


def scan_of(url: str) -> Scan:
    """The scan that a URL names."""
    folder, number, _ = split_url(url)
    return folder.scan(number)


def weight_of(path: str, epoch: int) -> float:
    """The weight in the loss of a sample in an epoch by the path of its points: that of its list,
    or 1 of a real one."""
    if not path.startswith(PREFIX):
        return 1.0
    return float(split_url(path)[0].mixed.synthetic_weight(epoch))


def _arrays(camera: dict[str, Any]) -> dict[str, Any]:
    return camera | {"image_size": tuple(camera["image_size"])}
