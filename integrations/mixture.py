"""Shared parts of the integrations: mixtures from plain settings, a loader that sets the epoch, and
class ids.

In a trainer's configuration, a mixture is a dict of settings::

    {"synthetic": "bank/", "ratio": 0.25, "labels": "generated", "seed": 0}
"""

from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from lidar_synth.datasets.classes import (
    FILE_CLASSES,
    IGNORE,
    NAMES,
    SEMANTIC_KITTI,
    TRAIN_ID,
    Taxonomy,
)
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan
from lidar_synth.labels.own import IgnoreLabels, RemoveLabels
from lidar_synth.labels.policies import read_policy
from lidar_synth.mixing import MixedScans, MixingPlan
from lidar_synth.mixing.schedules import constant_from
from lidar_synth.mixing.settings import mix_for_trainer, read_settings

__all__ = ["EpochLoader", "mix_for_trainer", "read_settings"]


def take_classes(settings: dict[str, Any]) -> Taxonomy:
    """Take the key ``classes`` out of settings: the class ids of the trainer's label files.

    Args:
        settings: ``classes`` is a name of ``FILE_CLASSES`` or {class name of SemanticKITTI: id in
            the files}; classes that it leaves out are unlabelled (0). By default SemanticKITTI's.

    Raises:
        ConfigError: on another name, class or id.
    """
    classes = settings.pop("classes", "semantic_kitti")
    if not isinstance(classes, Mapping):
        if not isinstance(classes, str) or classes not in FILE_CLASSES:
            raise ConfigError(
                f"classes: {classes}",
                f"one of {', '.join(FILE_CLASSES)}, or {{class name: id}}",
            )
        return FILE_CLASSES[classes]
    wrong = {
        name: number
        for name, number in classes.items()
        if name not in TRAIN_ID or type(number) is not int or not 0 < number < 1 << 16
    }
    if wrong or not classes:
        raise ConfigError(
            f"classes: {wrong}", f"ids from 1 to 65535 by some of {', '.join(NAMES)}"
        )
    return Taxonomy(
        "classes",
        {0: IGNORE} | {number: TRAIN_ID[name] for name, number in classes.items()},
        tuple(classes.get(name, 0) for name in NAMES),
    )


def synthetic_epoch(mixed: MixedScans, epoch: int = 0) -> int | None:
    """The nearest epoch with synthetic samples: this one, or the latest before it, or the next one
    after it; None if no epoch has any.

    Of a schedule that never becomes constant, only the first hundred epochs are searched.
    """
    last = constant_from(mixed.mixture.ratio)
    later = range(epoch + 1, 1 + (100 if last is None else last))
    tried = chain(range(epoch, -1, -1), later)
    return next((e for e in tried if MixingPlan(mixed.mixture, e).synthetics), None)


def first_synthetic(mixed: MixedScans, count: int) -> Iterator[Any]:
    """Up to ``count`` synthetic samples of the first epoch that has some, for checks before
    training."""
    if (epoch := synthetic_epoch(mixed)) is not None:
        for position in np.flatnonzero(mixed.plan(epoch).domain)[:count].tolist():
            yield mixed.sample(epoch, position)


def trainer_ids(
    learning_map: Mapping[int, int], taxonomy: Taxonomy, table: NDArray[Any]
) -> NDArray[Any]:
    """(256,) a trainer's id by train id, through its own map of the ids in its label files.

    Args:
        learning_map: the trainer's id by the file's class.
        taxonomy: the classes of the files, see ``take_classes``.
        table: (256,) the ids that SemanticKITTI's classes must have, see ``id_table``.

    Raises:
        ConfigError: if the map lacks a class of the files, or gives other ids to SemanticKITTI's.
    """
    if taxonomy is SEMANTIC_KITTI:
        require_ids(learning_map, table)
        return table
    classes = taxonomy.encode(np.arange(len(NAMES), dtype=np.uint8)).tolist()
    if missing := sorted({raw for raw in classes if raw} - set(learning_map)):
        raise ConfigError(
            f"a map of classes without {missing}",
            f"the ids of {taxonomy.name}",
            "Set classes.",
        )
    ids = np.full_like(table, table[IGNORE])
    ids[: len(NAMES)] = [learning_map[raw] if raw else table[IGNORE] for raw in classes]
    return ids


def labels_scans(settings: Mapping[str, Any]) -> bool:
    """Whether synthetic scans have labels by the policy of the settings."""
    policy = read_policy(settings.get("labels", "generated"))
    return not isinstance(policy, RemoveLabels | IgnoreLabels)


def refuse_unlabelled(settings: Mapping[str, Any], trainer: str) -> None:
    """Refuse label policies with which a batch may have no valid label, because its loss would be
    NaN.

    Raises:
        ConfigError: on the policies ``none`` and ``ignore``.
    """
    if not labels_scans(settings):
        raise ConfigError(
            f"labels={settings['labels']!r} for {trainer}",
            "labels for every synthetic scan, such as 'generated' or 'condition'",
            "The trainer makes its own batches; a batch of only synthetic scans would have no "
            "valid label, and its loss, a mean over no label, is NaN.",
        )


def require_labels(scan: Scan) -> None:
    """Check that a synthetic scan has a valid label.

    Raises:
        DataError: on a scan without any, because the loss of a batch of such scans would be NaN.
    """
    if scan.label is None or not (scan.label != IGNORE).any():
        raise DataError(
            f"synthetic scan {scan.id!r} has no valid label",
            "at least one, or the loss of a batch can be NaN",
            "Use a model or bank with labels.",
        )


def class_ids(scan: Scan, table: NDArray[Any]) -> NDArray[Any]:
    """Convert a scan's labels to a trainer's class ids, (N,).

    Args:
        scan: a scan with labels.
        table: (256,) the trainer's id by train id, see ``id_table``.

    Raises:
        DataError: as ``require_labels``.
    """
    require_labels(scan)
    ids: NDArray[Any] = table[scan.label]
    return ids


def id_table(first: int, ignore: int, dtype: Any) -> NDArray[Any]:
    """(256,) a trainer's id by train id: 19 consecutive ids from ``first`` on, and ``ignore`` for
    all other labels."""
    table = np.full(256, ignore, dtype)
    table[: len(NAMES)] = np.arange(first, first + len(NAMES))
    return table


def require_ids(learning_map: Mapping[int, int], table: NDArray[Any]) -> None:
    """Check that a trainer's own map of SemanticKITTI's classes gives the same ids as synthetic
    labels have.

    Args:
        learning_map: the trainer's id by the file's class.
        table: (256,) the trainer's id by train id, see ``id_table``.

    Raises:
        ConfigError: if the ids of a class, or of unlabelled points, differ.
    """
    classes = [*enumerate(SEMANTIC_KITTI.from_train or ()), (IGNORE, 0)]
    wrong = [
        (raw, learning_map.get(raw), int(table[i]))
        for i, raw in classes
        if learning_map.get(raw) != table[i]
    ]
    if wrong:
        raise ConfigError(
            f"a map of classes with {', '.join(f'{raw}: {given}' for raw, given, _ in wrong)}",
            ", ".join(f"{raw}: {wanted}" for raw, _, wanted in wrong),
            "Synthetic labels are SemanticKITTI's 19 classes: use the trainer's stock map of them.",
        )


def points_of(scan: Scan) -> NDArray[np.float32]:
    """(N, 4) float32 x, y, z, reflectance, as a copy, because trainers rotate points in place."""
    points = np.empty((len(scan), 4), np.float32)
    points[:, :3] = scan.points
    points[:, 3] = scan.reflectance
    return points


def inner(
    dataset: Any,
    names: tuple[str, ...] = ("dataset", "datasets", "point_cloud_dataset"),
) -> Iterator[Any]:
    """A dataset and all datasets that it wraps, recursively."""
    yield dataset
    for name in names:
        wrapped = vars(dataset).get(name) if hasattr(dataset, "__dict__") else None
        for each in wrapped if isinstance(wrapped, list | tuple) else [wrapped]:
            if each is not None:
                yield from inner(each, names)


class MixedEpoch:
    """A mixin that makes a trainer's dataset serve a mixture.

    Attributes:
        mixed: the mixture; None where the dataset has real scans only.
    """

    mixed: Any = None
    # Makes the trainer's sample of a synthetic scan.
    _synthetic: Callable[[Scan], Any]

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, also for workers."""
        if self.mixed is not None:
            self.mixed.set_epoch(epoch)
            self.mixed.plan()  # logs it

    def _take(self, index: int, real: Callable[[int], Any]) -> Any:
        """The sample at an index; ``real`` makes that of a real scan from its number."""
        sample = index if self.mixed is None else self.mixed[index]
        return self._synthetic(sample) if isinstance(sample, Scan) else real(sample)

    def __len__(self) -> int:
        if self.mixed is None:
            return int(super().__len__())  # type: ignore[misc]
        return len(self.mixed)


class EpochLoader(DataLoader[Any]):
    """A ``DataLoader`` that sets its dataset's epoch before each pass, for trainers that do not
    call ``set_epoch``."""

    passes = 0

    def __iter__(self) -> Any:
        for each in inner(self.dataset):
            # Looked up in the class: a dataset that forwards unknown attributes would set the epoch
            # twice.
            if hasattr(type(each), "set_epoch"):
                each.set_epoch(self.passes)
        self.passes += 1
        return super().__iter__()
