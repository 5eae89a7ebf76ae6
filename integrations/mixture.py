"""Shared parts of the integrations: mixtures from plain settings, a loader that sets the epoch, and class ids.

In a trainer's configuration, a mixture is a dict of settings::

    {"synthetic": "bank/", "ratio": 0.25, "labels": "generated", "seed": 0}
"""

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from lidar_synth.bank import Bank, is_bank
from lidar_synth.bank.storage import is_url
from lidar_synth.datasets.classes import FILE_CLASSES, IGNORE, NAMES, SEMANTIC_KITTI, TRAIN_ID, Taxonomy
from lidar_synth.errors import ConfigError, DataError, shorten
from lidar_synth.files.parsing import read_yaml
from lidar_synth.formats import open_scans
from lidar_synth.formats.as_sensor import read_transfer
from lidar_synth.generate.generator import load_generator
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans

VARIABLE = "LIDAR_SYNTH_MIX"
"""Environment variable with the YAML file of settings, for trainers whose configuration allows no further keys."""

OPTIONS = (
    "synthetic",
    "ratio",
    "labels",
    "seed",
    "reuse",
    "epoch_size",
    "label_options",
    "unboxed",
    "as_sensor",
    "classes",
)
"""Keys of the settings: the source of synthetic scans, and arguments of ``MixedScans``."""


def open_synthetic(where: Any) -> Any:
    """Open the source of synthetic scans that a configuration names.

    Args:
        where: a bank's folder or URL, a checkpoint (``.safetensors``), the name of a shipped model, or a folder of
            scans in any layout that ``open_scans`` reads. Any other object is returned unchanged.

    Raises:
        ConfigError, FileError, DataError: if there is no such source.
    """
    if not isinstance(where, str | Path):
        return where
    if is_url(where):
        return Bank(where)
    if not os.path.isdir(where):  # noqa: PTH112 - Path.is_dir raises on a name that is too long
        return load_generator(where)
    if is_bank(where):
        return Bank(where)
    scans = open_scans(where)
    own = scans[0].sensor  # files may store their own sensor
    return scans if scans.sensor.shape == own.shape else open_scans(where, sensor=own)


def read_settings(given: Any = None) -> dict[str, Any]:
    """Read the settings of a mixture, with keys in lower case.

    Args:
        given: the settings or a YAML file; by default the file in the environment variable ``LIDAR_SYNTH_MIX``.

    Raises:
        ConfigError: if there are no settings.
        FileError, DataError: if the file cannot be read.
    """
    source = given if given is not None else os.environ.get(VARIABLE)
    if isinstance(source, str | Path):
        given = read_yaml(Path(source), "the settings of a mixture")
    if not isinstance(given, Mapping):
        raise ConfigError(
            f"{source!r} as the settings of a mixture",
            f"a dict of {', '.join(OPTIONS)}, or a YAML file of them",
            f"Set the file in the trainer's configuration or by {VARIABLE}=mix.yaml.",
        )
    settings = {str(key).lower(): value for key, value in given.items()}
    options = settings.get("label_options")
    if isinstance(options, Mapping):
        settings["label_options"] = {str(key).lower(): value for key, value in options.items()}
    elif options is not None:
        raise ConfigError(f"label_options: {shorten(str(options), 40)}", "options by name, such as threshold: 0.5")
    return settings


def mix(real: int, settings: Mapping[str, Any], to_sample: Callable[[Scan, np.random.Generator], Any]) -> MixedScans:
    """Make a mixture from settings, for a trainer that loads real samples itself.

    Args:
        real: number of the trainer's real samples.
        settings: keys of ``OPTIONS``; ``synthetic`` is required.
        to_sample: ``(scan, rng) -> sample`` for synthetic scans.

    Returns:
        A dataset whose real samples are only their numbers, 0 <= n < real, by which the trainer loads them.

    Raises:
        ConfigError: on an unknown key, or settings that ``MixedScans`` refuses.
    """
    if unknown := sorted(set(settings) - set(OPTIONS)):
        raise ConfigError(f"settings {unknown} of a mixture", f"some of {', '.join(OPTIONS)}")
    if "classes" in settings:
        raise ConfigError(
            f"classes: {settings['classes']} for this trainer",
            "no key classes: SemanticKITTI's",
            "The adapters of lidar-bonnetal's family, Cylinder3D and Pointcept take others.",
        )
    if settings.get("synthetic") is None:
        raise ConfigError("a mixture without synthetic scans", "synthetic: a bank's folder, a checkpoint or a folder")
    options = {key: value for key, value in settings.items() if key != "synthetic"}
    synthetic = open_synthetic(settings["synthetic"])
    options["as_sensor"] = read_transfer(settings.get("as_sensor"), synthetic)
    return MixedScans.wrap(range(real), synthetic, to_sample=to_sample, compare=False, **options)  # numbers, no samples


def take_classes(settings: dict[str, Any]) -> Taxonomy:
    """Take the key ``classes`` out of settings: the class ids of the trainer's label files.

    Args:
        settings: ``classes`` is a name of ``FILE_CLASSES`` or {class name of SemanticKITTI: id in the files}; classes
            that it leaves out are unlabelled (0). By default SemanticKITTI's.

    Raises:
        ConfigError: on another name, class or id.
    """
    given = settings.pop("classes", "semantic_kitti")
    if not isinstance(given, Mapping):
        if given not in FILE_CLASSES:
            raise ConfigError(f"classes: {given}", f"one of {', '.join(FILE_CLASSES)}, or {{class name: id}}")
        return FILE_CLASSES[given]
    wrong = {n: i for n, i in given.items() if n not in TRAIN_ID or type(i) is not int or not 0 < i < 1 << 16}
    if wrong or not given:
        raise ConfigError(f"classes: {wrong}", f"ids from 1 to 65535 by some of {', '.join(NAMES)}")
    return Taxonomy(
        "classes", {0: IGNORE} | {i: TRAIN_ID[n] for n, i in given.items()}, tuple(given.get(n, 0) for n in NAMES)
    )


def trainer_ids(learning_map: Mapping[int, int], taxonomy: Taxonomy, table: NDArray[Any]) -> NDArray[Any]:
    """(256,) a trainer's id by train id, through its own map of the ids in its label files.

    Args:
        learning_map: the trainer's id by the file's class.
        taxonomy: of the files, see ``take_classes``.
        table: (256,) what SemanticKITTI's classes must get, see ``id_table``.

    Raises:
        ConfigError: if the map has not the file's classes, or gives SemanticKITTI's other ids.
    """
    if taxonomy is SEMANTIC_KITTI:
        require_ids(learning_map, table)
        return table
    classes = taxonomy.encode(np.arange(len(NAMES), dtype=np.uint8)).tolist()
    if missing := sorted({raw for raw in classes if raw} - set(learning_map)):
        raise ConfigError(f"a map of classes without {missing}", f"the ids of {taxonomy.name}", "Set classes.")
    ids = np.full_like(table, table[IGNORE])
    ids[: len(NAMES)] = [learning_map[raw] if raw else table[IGNORE] for raw in classes]
    return ids


def refuse_unlabelled(settings: Mapping[str, Any], trainer: str) -> None:
    """Refuse label policies with which a batch may have no valid label, because its loss would be NaN.

    Raises:
        ConfigError: on the policies ``none`` and ``ignore``.
    """
    if settings.get("labels", "generated") in ("none", "ignore"):
        raise ConfigError(
            f"labels={settings['labels']!r} for {trainer}",
            "labels for every synthetic scan: 'generated', 'condition', 'pseudo' or 'mix'",
            "The trainer makes its own batches; a batch of only synthetic scans would have no valid label, and its "
            "loss, a mean over no label, is NaN.",
        )


def class_ids(scan: Scan, table: NDArray[Any]) -> NDArray[Any]:
    """Convert a scan's labels to a trainer's class ids, (N,).

    Args:
        scan: a scan with labels.
        table: (256,) the trainer's id by train id, see ``id_table``.

    Raises:
        DataError: on a scan without any valid label, because the loss of a batch of such scans would be NaN.
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
    """(256,) a trainer's id by train id: 19 consecutive ids from ``first`` on, and ``ignore`` for all other labels."""
    table = np.full(256, ignore, dtype)
    table[: len(NAMES)] = np.arange(first, first + len(NAMES))
    return table


def require_ids(learning_map: Mapping[int, int], table: NDArray[Any]) -> None:
    """Check that a trainer's own map of SemanticKITTI's classes gives the same ids as synthetic labels have.

    Args:
        learning_map: the trainer's id by the file's class.
        table: (256,) the trainer's id by train id, see ``id_table``.

    Raises:
        ConfigError: if the ids of a class, or of unlabelled points, differ.
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
    """(N, 4) float32 x, y, z, reflectance, as a copy, because trainers rotate points in place."""
    points = np.empty((len(scan), 4), np.float32)
    points[:, :3], points[:, 3] = scan.points, scan.reflectance
    return points


def inner(dataset: Any, names: tuple[str, ...] = ("dataset", "datasets", "point_cloud_dataset")) -> Iterator[Any]:
    """A dataset and all datasets that it wraps, recursively."""
    yield dataset
    for name in names:
        wrapped = vars(dataset).get(name) if hasattr(dataset, "__dict__") else None
        for each in wrapped if isinstance(wrapped, list | tuple) else [wrapped]:
            if each is not None:
                yield from inner(each, names)


class EpochLoader(DataLoader[Any]):
    """A ``DataLoader`` that sets its dataset's epoch before each pass, for trainers that do not call ``set_epoch``."""

    passes = 0

    def __iter__(self) -> Any:
        for each in inner(self.dataset):
            # Looked up in the class: a dataset that forwards unknown attributes would set the epoch twice.
            if hasattr(type(each), "set_epoch"):
                each.set_epoch(self.passes)
        self.passes += 1
        return super().__iter__()
