"""What the adapters share: a mixture from plain settings, a loader that tells the epoch, labels in a trainer's ids.

A trainer's configuration is text, so a mixture is a dict of settings there::

    {"synthetic": "bank/", "ratio": 0.25, "labels": "generated", "seed": 0}
"""

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from lidar_synth.bank import Bank, is_bank
from lidar_synth.datasets.classes import IGNORE, NAMES, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_text
from lidar_synth.formats import open_scans
from lidar_synth.generate.generator import load_generator
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans

VARIABLE = "LIDAR_SYNTH_MIX"
"""Environment variable with the YAML file of settings, for trainers whose configuration takes no other keys."""

OPTIONS = ("synthetic", "ratio", "labels", "seed", "reuse", "epoch_size", "label_options")
"""Keys of the settings: where the synthetic scans come from, and arguments of ``MixedScans``."""


def open_synthetic(where: Any) -> Any:
    """A source of synthetic scans from what a configuration names.

    Args:
        where: a bank's folder or URL, a checkpoint (``.safetensors``) or the name of a shipped model, a folder of scans
            in any layout that ``open_scans`` reads; or a source as it is.

    Raises:
        ConfigError, FileError, DataError: if there is none.
    """
    if not isinstance(where, str | Path):
        return where
    if is_bank(where):
        return Bank(where)
    if not Path(where).is_dir():
        return load_generator(where)
    scans = open_scans(where)
    own = scans[0].sensor  # files may tell it themselves, which the folder does not know
    return scans if scans.sensor.shape == own.shape else open_scans(where, sensor=own)


def read_settings(given: Any = None) -> dict[str, Any]:
    """The settings of a mixture, with keys in small letters.

    Args:
        given: them, or a YAML file; without, the file that the environment's ``LIDAR_SYNTH_MIX`` names.

    Raises:
        ConfigError: if there are none.
        FileError, DataError: if the file cannot be read.
    """
    source = given if given is not None else os.environ.get(VARIABLE)
    if isinstance(source, str | Path):
        given = yaml.safe_load(read_text(Path(source)))
    if not isinstance(given, Mapping):
        raise ConfigError(
            f"{source!r} as the settings of a mixture",
            f"a dict of {', '.join(OPTIONS)}, or a YAML file of them",
            f"Name the file in the trainer's configuration or by {VARIABLE}=mix.yaml.",
        )
    settings = {str(key).lower(): value for key, value in given.items()}
    if isinstance(options := settings.get("label_options"), Mapping):
        settings["label_options"] = {str(key).lower(): value for key, value in options.items()}
    return settings


def mix(real: int, settings: Mapping[str, Any], to_sample: Callable[[Scan, np.random.Generator], Any]) -> MixedScans:
    """The mixture that settings describe, for a trainer whose real samples are counted only.

    Args:
        real: how many real samples the trainer has.
        settings: keys of ``OPTIONS``; ``synthetic`` is required.
        to_sample: what a synthetic scan becomes.

    Returns:
        A dataset whose real samples are their numbers, 0 <= n < real: the trainer loads them as it always does.

    Raises:
        ConfigError: on an unknown key, or settings that ``MixedScans`` refuses.
    """
    if unknown := sorted(set(settings) - set(OPTIONS)):
        raise ConfigError(f"settings {unknown} of a mixture", f"some of {', '.join(OPTIONS)}")
    if settings.get("synthetic") is None:
        raise ConfigError("a mixture without synthetic scans", "synthetic: a bank's folder, a checkpoint or a folder")
    options = {key: value for key, value in settings.items() if key != "synthetic"}
    synthetic = open_synthetic(settings["synthetic"])
    return MixedScans.wrap(range(real), synthetic, to_sample=to_sample, compare=False, **options)  # numbers, no samples


def refuse_unlabelled(settings: Mapping[str, Any], trainer: str) -> None:
    """Settings under which a batch can be without one valid label, which makes the loss NaN.

    Raises:
        ConfigError: for the policies ``none`` and ``ignore``.
    """
    if settings.get("labels", "generated") in ("none", "ignore"):
        raise ConfigError(
            f"labels={settings['labels']!r} for {trainer}",
            "labels for every synthetic scan: 'generated', 'condition', 'pseudo' or 'mix'",
            "It makes its batches itself; one of synthetic scans alone would have no valid label, and its loss, a mean "
            "over none, is NaN.",
        )


def class_ids(scan: Scan, table: NDArray[Any]) -> NDArray[Any]:
    """(N,) labels in a trainer's ids.

    Args:
        scan: with labels.
        table: (256,) a trainer's id by train id, see ``id_table``.

    Raises:
        DataError: on a scan without one valid label: a batch of such scans would make the loss NaN.
    """
    if scan.label is None or not (scan.label != IGNORE).any():
        raise DataError(
            f"synthetic scan {scan.id!r} has no valid label",
            "at least one, or the loss of a batch can be NaN",
            "Use a model or bank with labels, or labels='mix' with real scans.",
        )
    ids: NDArray[Any] = table[scan.label]
    return ids


def id_table(first: int, ignore: int, dtype: Any) -> NDArray[Any]:
    """(256,) a trainer's id by train id: 19 in a row from ``first`` on, and ``ignore`` for everything else."""
    table = np.full(256, ignore, dtype)
    table[: len(NAMES)] = np.arange(first, first + len(NAMES))
    return table


def require_ids(learning_map: Mapping[int, int], table: NDArray[Any]) -> None:
    """A trainer's own map of SemanticKITTI's classes has to give the ids that synthetic labels get.

    Args:
        learning_map: the trainer's id by the file's class.
        table: (256,) a trainer's id by train id, see ``id_table``.

    Raises:
        ConfigError: if a class, or what is unlabelled, becomes another one.
    """
    classes = [*enumerate(SEMANTIC_KITTI.from_train or ()), (IGNORE, 0)]
    wrong = [(raw, learning_map.get(raw), int(table[i])) for i, raw in classes if learning_map.get(raw) != table[i]]
    if wrong:
        raise ConfigError(
            f"a map of classes with {', '.join(f'{raw}: {given}' for raw, given, _ in wrong)}",
            ", ".join(f"{raw}: {wanted}" for raw, _, wanted in wrong),
            "Synthetic labels are SemanticKITTI's 19 classes: use the trainer's stock map of them.",
        )


def points_of(scan: Scan) -> NDArray[np.float32]:
    """(N, 4) float32 x, y, z, reflectance, in memory of its own: trainers turn points in place."""
    points = np.empty((len(scan), 4), np.float32)
    points[:, :3], points[:, 3] = scan.points, scan.reflectance
    return points


def inner(dataset: Any, names: tuple[str, ...] = ("dataset", "datasets", "point_cloud_dataset")) -> Iterator[Any]:
    """A dataset and all that it wraps."""
    yield dataset
    for name in names:
        held = vars(dataset).get(name) if hasattr(dataset, "__dict__") else None
        for each in held if isinstance(held, list | tuple) else [held]:
            if each is not None:
                yield from inner(each, names)


class EpochLoader(DataLoader[Any]):
    """A ``DataLoader`` that tells its dataset, before each pass, which epoch begins: for trainers that tell nobody."""

    passes = 0

    def __iter__(self) -> Any:
        for each in inner(self.dataset):
            # Looked up in the class: a dataset that passes unknown names on to another would be told twice.
            if hasattr(type(each), "set_epoch"):
                each.set_epoch(self.passes)
        self.passes += 1
        return super().__iter__()
