"""RangeNet++ (lidar-bonnetal) and SalsaNext: a ``parser.py`` that they load by the name in their data configuration::

    python -m lidar_synth.integrations.rangenet mix.yaml train/tasks/semantic/dataset/mixed

writes that folder with two lines that name the settings; ``name: "mixed"`` in the data YAML selects it. The trainer's
own parser reads every scan: a synthetic one is passed through a temporary file in memory (``/dev/shm`` on Linux).
"""

import sys
import tempfile
from functools import cache
from importlib import import_module
from pathlib import Path
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
)

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.files.disk import write_file
from lidar_synth.formats.point_labels import encode_labels
from lidar_synth.geometry.scan import Scan

STOCK = "tasks.semantic.dataset.kitti.parser"
_TRAIN_IDS = id_table(0, 255, np.uint8)
_MEMORY = next((str(folder) for folder in (Path("/dev/shm"),) if folder.is_dir()), None)


@cache
def dataset_class() -> Any:
    """Make a subclass of the trainer's ``SemanticKitti`` that mixes real and synthetic scans.

    Raises:
        LibraryError: if the trainer's own parser cannot be imported.
    """
    try:
        stock = import_module(STOCK)
    except ImportError as error:
        raise LibraryError(
            f"{STOCK} cannot be imported ({error})", "the trainer's train folder on the path", "cd train/tasks/semantic"
        ) from error

    class Mixed(stock.SemanticKitti):  # type: ignore[misc, name-defined]
        """The trainer's dataset, mixed with synthetic scans."""

        scan_files: Any
        label_files: Any

        def __init__(self, settings: dict[str, Any], *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            refuse_unlabelled(settings, "a range-view trainer")
            if not self.gt:
                raise ConfigError("a mixture without labels (gt=False)", "gt=True, for training")
            _check_classes(self.learning_map, self.learning_map_inv)
            self.mixed = mix(len(self.scan_files), settings, lambda scan, rng: scan)

        def set_epoch(self, epoch: int) -> None:
            """Set the epoch, also for workers."""
            self.mixed.set_epoch(epoch)

        def __len__(self) -> int:
            return len(self.mixed)

        def __getitem__(self, index: int) -> Any:
            sample = self.mixed[index]
            if not isinstance(sample, Scan):
                return super().__getitem__(sample)
            if len(sample) > self.max_points:
                raise ConfigError(
                    f"max_points: {self.max_points} for a synthetic scan of {len(sample)} points",
                    "room for all of them",
                    "Raise dataset.max_points in the architecture's YAML.",
                )
            with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
                files = self.scan_files, self.label_files
                self.scan_files, self.label_files = ([path] for path in _write(Path(folder), sample))
                try:
                    return super().__getitem__(0)
                finally:
                    self.scan_files, self.label_files = files

    return Mixed


def make_parser(settings: Any) -> Any:
    """Make the class ``Parser`` for a ``parser.py``: the trainer's own, with a mixed training set.

    Args:
        settings: settings of the mixture, or a YAML file of them.
    """
    settings = read_settings(settings)
    stock = import_module(STOCK)

    class Parser(stock.Parser):  # type: ignore[misc, name-defined]
        """The trainer's parser; validation and test are its own."""

        train_dataset: Any
        trainloader: Any

        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            self.trainiter = None  # its workers would read the stock training set
            own, loader = self.train_dataset, self.trainloader
            arguments = {
                name: getattr(own, name)
                for name in ("labels", "color_map", "learning_map", "learning_map_inv", "sensor", "max_points", "gt")
            }
            if hasattr(own, "transform"):  # SalsaNext's
                arguments["transform"] = own.transform
            self.train_dataset = dataset_class()(settings, self.root, self.train_sequences, **arguments)
            self.trainloader = EpochLoader(
                self.train_dataset, batch_size=self.batch_size, shuffle=self.shuffle_train, num_workers=self.workers,
                pin_memory=loader.pin_memory, drop_last=True, collate_fn=loader.collate_fn,
            )  # fmt: skip

    return Parser


def _write(folder: Path, scan: Scan) -> tuple[str, str]:
    """Write the scan as the two files of sequence ``synthetic``; the trainer reads names from the path."""
    name = "".join(letter if letter.isalnum() else "_" for letter in scan.id)
    class_ids(scan, _TRAIN_IDS)  # refuses a scan without a valid label
    paths = [folder / "synthetic" / kind / f"{name}.{ext}" for kind, ext in (("velodyne", "bin"), ("labels", "label"))]
    for path, values in zip(paths, (points_of(scan), encode_labels(scan, SEMANTIC_KITTI)), strict=True):
        path.parent.mkdir(parents=True)
        path.write_bytes(values.astype(values.dtype.newbyteorder("<")).tobytes())
    return str(paths[0]), str(paths[1])


def _check_classes(learning_map: dict[int, int], inverse: dict[int, int]) -> None:
    """Check that the trainer's classes distinguish our 19: mapping each class and back must not change it."""
    raw = SEMANTIC_KITTI.from_train or ()
    lost = [c for c in raw if inverse.get(learning_map.get(c, -1)) != c]
    if lost or learning_map.get(0) != 0:
        raise ConfigError(
            f"a learning_map in which SemanticKITTI's classes {lost or [0]} do not come back",
            "its 19 classes, and 0 = unlabelled",
            "Use the stock config/labels/semantic-kitti.yaml.",
        )


def write_parser(settings: str | Path, folder: str | Path) -> Path:
    """Write a folder with the ``parser.py`` that the trainers load by name.

    Raises:
        ConfigError, FileError: if the settings cannot be read, or the folder not be written.
    """
    read_settings(settings)
    path = Path(folder) / "parser.py"
    text = "from lidar_synth.integrations.rangenet import make_parser\n\n"
    write_file(path, f"{text}Parser = make_parser({str(Path(settings).resolve())!r})\n".encode())
    return path


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python -m lidar_synth.integrations.rangenet MIX.yaml FOLDER")
    print(write_parser(sys.argv[1], sys.argv[2]))
