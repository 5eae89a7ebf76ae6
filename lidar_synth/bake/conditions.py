"""Conditions of generated scans: scan ``index`` is conditioned on entry ``index`` of a dataset,
modulo its length.

The dataset of a layout model may be a YAML file of a layout, or a folder of them.
"""

import hashlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError, DataError, LibraryError, choose
from lidar_synth.files.disk import hash_of_names, read_file
from lidar_synth.formats import ScanFiles, open_scans
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.layout import Layout
from lidar_synth.geometry.layout.files import load_layout
from lidar_synth.labels.bank import ObjectBank

FOCAL_TOLERANCE = 0.02
"""Relative difference that is allowed between a camera's focal length and that of the training
data."""

OBJECTS: dict[str, Callable[[Sensor], Any]] = {
    "town": ObjectBank.from_town_shapes,
    "drawn": lambda sensor: None,
}
"""What stands in the boxes of layouts, by name: objects of the town that are cast there, or what
the model draws."""


class LayoutFiles:
    """Layouts in YAML files.

    Args:
        path: a file, or a folder of them.

    Attributes:
        ids: names of the layouts: those of their files, without suffix.
        others: the file, or visible entries of the folder, that are no YAML files.
    """

    def __init__(self, path: Path) -> None:
        given = [path] if path.is_file() else sorted(path.glob("[!.]*"))
        self._files = [file for file in given if file.suffix in (".yaml", ".yml")]
        self.others = [file for file in given if file.suffix not in (".yaml", ".yml")]
        self.ids = [file.stem for file in self._files]

    def __len__(self) -> int:
        return len(self.ids)

    def contents(self) -> list[bytes]:
        """The bytes of the files.

        Raises:
            FileError: if one cannot be read.
        """
        return [read_file(file) for file in self._files]

    def read(self, index: int) -> Layout:
        """The layout of one file; raises as ``load_layout``."""
        return load_layout(self._files[index])


ConditionSource = LayoutFiles | ScanFiles


@lru_cache(maxsize=1)
def open_conditions(
    path: str | None, layout: str | None, split: str | None
) -> ConditionSource | None:
    """The dataset of the conditions, opened once per process; None without a path.

    Raises:
        ConfigError: on a layout or a split without a path, and as ``open_scans``.
        FileError, DataError: as ``open_scans``.
    """
    if path:
        layouts = LayoutFiles(Path(path))
        if len(layouts) and not (layout or split or layouts.others):
            return layouts
        try:
            return open_scans(path, layout=layout, split=split)
        except DataError as error:
            if not (layouts.others and len(layouts)):
                raise
            raise DataError(
                f"{path} holds layouts and {layouts.others[0].name}",
                "layouts only, or a dataset",
            ) from error
    if layout or split:
        raise ConfigError(
            f"conditions of layout {layout} and split {split}, but no dataset",
            "--condition PATH",
        )
    return None


def conditions_for(
    generator: Generator,
    path: str | None,
    layout: str | None = None,
    split: str | None = None,
) -> ConditionSource | None:
    """The dataset of a model's conditions as it is now, after a check that it fits the model.

    Raises:
        ConfigError: if a conditional model gets no conditions or an unconditional one gets some,
            and as ``open_conditions``.
        DataError: if the dataset's camera is unknown or differs from that of the training, a
            layout is invalid or does not fit the model, and as ``open_conditions``.
        FileError: as ``open_conditions``.
    """
    if (generator.condition is None) != (path is None):
        needs = (
            f"{generator.condition} conditions"
            if generator.condition
            else "no condition"
        )
        raise ConfigError(
            f"condition {path} for model {generator.name!r}, which takes {needs}",
            "a dataset whose scans have them" if generator.condition else "none",
            "--condition ROOT (condition=...)" if generator.condition else "",
        )
    open_conditions.cache_clear()  # there may be more by now
    source = open_conditions(path, layout, split)
    if isinstance(source, LayoutFiles):
        if generator.condition != "layout":
            raise ConfigError(
                f"layouts for model {generator.name!r}",
                f"a dataset whose scans have {generator.condition}",
            )
        for index in range(len(source)):  # before a folder is claimed for them
            generator.condition_tensor(source.read(index), 1)
    if isinstance(source, ScanFiles) and generator.condition:
        check_camera(
            source, generator.header.conditioning[generator.condition].get("focal")
        )
    return source


def check_camera(source: ScanFiles, focal: float | None) -> None:
    """Refuse a camera of another focal length: its images have another field of view than those of
    the training.

    Args:
        source: of the images.
        focal: pixels, as the model's header says it; None = any.

    Raises:
        DataError: on a camera without calibration, or of another focal length.
    """
    if focal is None:
        return
    camera = source.calibration(0)
    actual = None if camera is None else float(camera.projection[0, 0])
    if actual is None or abs(actual / focal - 1) > FOCAL_TOLERANCE:
        given = (
            "no calibration"
            if actual is None
            else f"a focal length of {actual:.1f} pixels"
        )
        raise DataError(
            f"{source.root}: a camera with {given}",
            f"{focal:.1f} pixels, the focal length of the model's training (condition.focal)",
            "Crop and resize the images to that field of view, and change the dataset's "
            "calibration files accordingly.",
        )


def settle_objects(generator: Generator, name: str | None) -> str | None:
    """How the objects in the boxes of layouts are made: "town", the default, or "drawn"; None for a
    model that takes no layouts.

    Raises:
        ConfigError: on a name for such a model, or an unknown one.
        LibraryError: if objects are to be cast and embreex is missing.
    """
    if generator.condition != "layout":
        if name is not None:
            raise ConfigError(
                f"objects {name} for model {generator.name!r}",
                "a model of layouts, such as town-layout",
            )
        return None
    chosen = name or "town"
    choose("objects", chosen, OBJECTS)
    if chosen == "town":
        _check_embree()
    return chosen


def _check_embree() -> None:
    """Refuse at once what would fail in each worker."""
    # By name: only the town imports it.
    try:
        import_module("lidar_synth.lab.town.solid").load_embree()
    except LibraryError as error:
        raise LibraryError(
            f"objects that are cast into the boxes of layouts, but {error}",
            hint="Or type --objects drawn (objects='drawn'): the model draws them, less well.",
        ) from error


@lru_cache(maxsize=1)
def open_objects(name: str | None, sensor: Sensor) -> Any:
    """The objects of this name, which are cast into the scans of layouts; None where the model
    draws them.

    Raises:
        ConfigError: on an unknown name.
        LibraryError: if embreex is missing.
    """
    return None if name is None else choose("objects", name, OBJECTS)(sensor)


def fingerprint(source: ConditionSource | None) -> str | None:
    """Hash of the layouts, or of the names of a dataset's scans; None for an unconditional model.

    Raises:
        FileError: if a layout cannot be read.
    """
    if source is None:
        return None
    if isinstance(source, LayoutFiles):
        return hashlib.sha256(b"\n".join(source.contents())).hexdigest()
    return hash_of_names(source.ids)


def conditions(
    source: ConditionSource | None, indices: Iterable[int]
) -> list[Scan | Layout] | None:
    """The entries that condition the scans with these indices; None for an unconditional model.

    Raises:
        FileError, DataError: if one cannot be read.
    """
    if source is None:
        return None
    return [source.read(index % len(source)) for index in indices]


def condition_names(
    source: ConditionSource | None, indices: Iterable[int]
) -> list[str]:
    """The names of these conditions; an empty list for an unconditional model."""
    return (
        [] if source is None else [source.ids[index % len(source)] for index in indices]
    )
