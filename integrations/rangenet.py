"""RangeNet++ (lidar-bonnetal), SalsaNext and CENet: a launcher that runs their own training script
on a mixture::

    cd train/tasks/semantic    # CENet: its root
    LIDAR_SYNTH_MIX=/data/mix.yaml python -m lidar_synth.integrations.rangenet train.py \\
        -d DATASET -ac ARCH.yaml ...

The trainer's own parser reads every scan: a synthetic one is passed through a temporary file in
memory (``/dev/shm`` on Linux). Validation, and scripts that do not train, see only real scans.
CENet's script for SemanticPOSS is refused.
"""

import sys
import tempfile
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from lidar_synth.integrations.launcher import plain_errors, prepare_script, run
from lidar_synth.integrations.mixture import (
    MixedEpoch,
    first_synthetic,
    mix_for_trainer,
    points_of,
    read_settings,
    refuse_unlabelled,
    require_labels,
    take_classes,
)
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from lidar_synth.datasets.classes import Taxonomy
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.formats.point_labels import encode_labels
from lidar_synth.geometry import Scan

USAGE = (
    "LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.rangenet train.py ARGUMENTS, in "
    "train/tasks/semantic or CENet"
)
FAMILY = "lidar-bonnetal, SalsaNext or CENet"
TRAINERS = {
    "tasks.semantic.modules.trainer": None,
    "modules.trainer": "dataset.kitti.parser",
}
"""{module of the trainer: module from which it imports its parser, or None where it loads the
parser by its path}."""
STRIPES = 0.25
"""Largest difference of ``gaps`` between real and synthetic images; below it, both look equally
dense."""

_MEMORY = next((str(folder) for folder in (Path("/dev/shm"),) if folder.is_dir()), None)


def filled(mask: NDArray[Any]) -> float:
    """Share of an image's cells that have a return; ``mask`` (H, W) bool."""
    return float(mask.mean())


def gaps(mask: NDArray[Any]) -> float:
    """Share of the filled cells whose right neighbour is empty: near 1 for vertical stripes;
    ``mask`` (H, W) bool."""
    return float((mask & ~np.roll(mask, -1, 1)).sum() / max(mask.sum(), 1))


@cache
def dataset_class(stock: Any) -> Any:
    """Make a subclass of the trainer's ``SemanticKitti`` that mixes real and synthetic scans.

    Args:
        stock: the module of the trainer's parser.
    """

    class MixedRangeImages(MixedEpoch, stock.SemanticKitti):  # type: ignore[misc]
        """The trainer's dataset, mixed with synthetic scans."""

        scan_files: Any
        label_files: Any

        def __init__(
            self, settings: dict[str, Any], *args: Any, **options: Any
        ) -> None:
            super().__init__(*args, **options)
            refuse_unlabelled(settings, "a range-view trainer")
            if not self.gt:
                raise ConfigError(
                    "a mixture without labels (gt=False)", "gt=True, for training"
                )
            settings = dict(settings)
            self.taxonomy = take_classes(settings)
            _check_classes(self.learning_map, self.learning_map_inv, self.taxonomy)
            self.mixed = mix_for_trainer(len(self.scan_files), settings)
            check_stripes(self)

        def __getitem__(self, index: int) -> Any:
            return self._take(index, super().__getitem__)

        def _synthetic(self, scan: Scan) -> Any:
            if len(scan) > self.max_points:
                raise ConfigError(
                    f"max_points: {self.max_points} for a synthetic scan of {len(scan)} points",
                    "room for all of them",
                    "Raise dataset.max_points in the architecture's YAML.",
                )
            with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
                files = self.scan_files, self.label_files
                self.scan_files, self.label_files = (
                    [path] for path in _write(Path(folder), scan, self.taxonomy)
                )
                try:
                    return super().__getitem__(0)
                finally:
                    self.scan_files, self.label_files = files

        def image(self, source: Scan | str, width: int) -> NDArray[Any]:
            """(H, width) bool, the filled cells of the trainer's own projection of a scan or
            file."""
            scan = stock.LaserScan(
                True, self.sensor_img_H, width, self.sensor_fov_up, self.sensor_fov_down
            )
            if isinstance(source, Scan):
                scan.set_points(source.points, source.reflectance)
            else:
                scan.open_scan(source)
            mask: NDArray[Any] = scan.proj_range >= 0
            return mask

    return MixedRangeImages


def check_stripes(dataset: Any) -> None:
    """Refuse a width at which synthetic images have stripes of empty columns and real ones do not.

    Args:
        dataset: of ``dataset_class``.

    Raises:
        ConfigError: at such a width; the error names one that fits.
    """
    synthetic = list(first_synthetic(dataset.mixed, 3))
    real = list(dataset.scan_files[:3])
    if not (synthetic and real):
        return

    def measure(width: int) -> list[tuple[float, float]]:
        """Mean shares of filled cells and of gaps: of real images, then of synthetic ones."""
        shares = []
        for sources in (real, synthetic):
            images = [dataset.image(source, width) for source in sources]
            fill = float(np.mean([*map(filled, images)]))
            shares.append((fill, float(np.mean([*map(gaps, images)]))))
        return shares

    width = dataset.sensor_img_W
    (real_fill, real_gaps), (fill, holes) = measure(width)
    if holes - real_gaps <= STRIPES:
        return
    fitting = "the columns of the synthetic scans"
    for narrower in (width // 2, width // 4, width // 8):
        (_, real_share), (_, share) = measure(narrower)
        if share - real_share <= STRIPES:
            fitting = str(narrower)
            break
    raise ConfigError(
        f"synthetic scans in images of {dataset.sensor_img_H} x {width}: {fill:.0%} of the cells "
        f"are filled, and {holes:.0%} of these have an empty cell to the right; in real scans "
        f"{real_fill:.0%} and {real_gaps:.0%}",
        "images of one density: a network tells these apart by the stripes",
        f"Set dataset.sensor.img_prop.width: {fitting} in the architecture's YAML. Real and "
        "synthetic scans are then projected to that width, in training, validation and inference.",
    )


def make_parser(stock: Any, settings: Any = None) -> Any:
    """Make the class ``Parser`` of a trainer with a mixed training set.

    Args:
        stock: the module of the trainer's own parser.
        settings: settings of the mixture, or a YAML file of them; by default the file in
            ``LIDAR_SYNTH_MIX``.

    Raises:
        LibraryError: if the module is not a parser of these trainers.
    """
    missing = [
        name
        for name in ("Parser", "SemanticKitti", "LaserScan")
        if not hasattr(stock, name)
    ]
    if missing:
        raise LibraryError(f"a parser.py without {missing}", f"the parser of {FAMILY}")
    settings = read_settings(settings)

    class Parser(stock.Parser):  # type: ignore[misc]
        """The trainer's parser; validation and test are its own."""

        train_dataset: Any
        trainloader: Any

        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            self.trainiter = None  # its workers would read the stock training set
            unmixed = self.train_dataset
            loader = self.trainloader
            arguments = {
                name: getattr(unmixed, name)
                for name in (
                    "labels",
                    "color_map",
                    "learning_map",
                    "learning_map_inv",
                    "sensor",
                    "max_points",
                    "gt",
                )
            }
            if hasattr(unmixed, "transform"):  # SalsaNext's
                arguments["transform"] = unmixed.transform
            self.train_dataset = dataset_class(stock)(
                settings, self.root, self.train_sequences, **arguments
            )
            self.trainloader = DataLoader(
                self.train_dataset,
                batch_size=self.batch_size,
                shuffle=self.shuffle_train,
                num_workers=self.workers,
                pin_memory=loader.pin_memory,
                drop_last=True,
                collate_fn=loader.collate_fn,
                worker_init_fn=loader.worker_init_fn,
                generator=loader.generator,
            )

    return Parser


def register() -> None:
    """Make the trainer use a mixed parser and set the epoch of its training set, also when it
    resumes.

    Raises:
        LibraryError: if the trainer's code cannot be imported, or is not of this family.
    """
    module, parser = _trainer()
    if not (
        (parser or hasattr(module, "imp")) and hasattr(module.Trainer, "train_epoch")
    ):
        raise LibraryError(
            f"{module.__file__} without imp or Trainer.train_epoch", FAMILY
        )
    train = module.Trainer.train_epoch

    @wraps(train)
    def train_epoch(
        self: Any, train_loader: Any, *args: Any, epoch: int, **options: Any
    ) -> Any:
        train_loader.dataset.set_epoch(epoch)
        return train(self, train_loader, *args, epoch=epoch, **options)

    if parser:
        # A class of this name beside the trainer's own would end up in its super(Parser, self).
        replacement = SimpleNamespace(Parser=make_parser(parser))
        sys.modules[parser.__name__] = replacement  # type: ignore[assignment]
    else:
        module.imp = _loader(module.imp.load_source)
    module.Trainer.train_epoch = train_epoch
    _plain_state(module.warmupLR)


def _trainer() -> tuple[Any, Any]:
    """The module of the trainer, and that of its parser where the trainer imports it."""
    for name, parser in TRAINERS.items():
        try:
            return import_module(name), parser and import_module(parser)
        except ImportError as error:
            # it is this trainer, without something that it imports
            if error.name != "tasks":
                raise LibraryError(
                    f"{name} cannot be imported ({error})",
                    f"{FAMILY} with all that it imports",
                    f"Start: {USAGE}",
                ) from error
    raise AssertionError("the last trainer is not in a package of this name")


def _loader(load: Any) -> SimpleNamespace:
    """``imp`` for a trainer that loads its parser by path."""

    def load_source(name: str, path: str) -> Any:
        loaded = load(name, path)
        if name == "parserModule":
            return SimpleNamespace(Parser=make_parser(loaded))
        return loaded

    return SimpleNamespace(load_source=load_source)


def _plain_state(scheduler: Any) -> None:
    """Make checkpoints hold the state of the inner scheduler instead of the object, which
    ``torch.load`` refuses since 2.6."""
    state_dict = scheduler.state_dict
    load_state_dict = scheduler.load_state_dict

    def plain(self: Any) -> dict[str, Any]:
        state: dict[str, Any] = state_dict(self)
        return state | {"initial_scheduler": self.initial_scheduler.state_dict()}

    def load(self: Any, state: dict[str, Any]) -> None:
        self.initial_scheduler.load_state_dict(state["initial_scheduler"])
        load_state_dict(self, state | {"initial_scheduler": self.initial_scheduler})

    scheduler.state_dict = plain
    scheduler.load_state_dict = load


def main() -> None:
    """Run one of the trainer's scripts; ``train.py`` trains on the mixture."""
    script = prepare_script(
        USAGE, "numpy.float", "imp", "tensorflow.summary", "torchvision", "torch.load"
    )
    if Path(script).with_name("__init__.py").is_file():
        # The trainer's own, which its scripts import first: it puts ../.. on the path.
        import_module("__init__")
    with plain_errors():
        name = Path(script).name
        if name == "train_poss.py":  # CENet's, for SemanticPOSS
            raise ConfigError(
                f"{name}, whose trainer would see real scans only",
                "train.py",
                "For another dataset: train.py with its -dc, and classes in the mixture's YAML.",
            )
        register()
    run(script)


def _write(folder: Path, scan: Scan, taxonomy: Taxonomy) -> tuple[str, str]:
    """Write the scan as the two files of sequence ``synthetic``; the trainer reads names from the
    path."""
    name = "".join(letter if letter.isalnum() else "_" for letter in scan.id)
    require_labels(scan)
    paths = [
        folder / "synthetic" / kind / f"{name}.{ext}"
        for kind, ext in (("velodyne", "bin"), ("labels", "label"))
    ]
    for path, values in zip(
        paths, (points_of(scan), encode_labels(scan, taxonomy)), strict=True
    ):
        path.parent.mkdir(parents=True)
        path.write_bytes(values.astype(values.dtype.newbyteorder("<")).tobytes())
    return str(paths[0]), str(paths[1])


def _check_classes(
    learning_map: dict[int, int], inverse: dict[int, int], taxonomy: Taxonomy
) -> None:
    """Check that the trainer's classes distinguish ours: mapping each class and back must not
    change it."""
    raw = sorted(set(taxonomy.from_train or ()) - {0})
    lost = [c for c in raw if inverse.get(learning_map.get(c, -1)) != c]
    if lost or learning_map.get(0) != 0:
        raise ConfigError(
            f"a learning_map in which {taxonomy.name}'s classes {lost or [0]} do not come back",
            "its classes, and 0 = unlabelled",
            "Use the stock config/labels/semantic-kitti.yaml, or set classes in the mixture's "
            "YAML.",
        )


if __name__ == "__main__":
    main()
