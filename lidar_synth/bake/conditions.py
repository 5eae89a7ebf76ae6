"""What generated scans are conditioned on: the scans of a dataset, scan ``index`` by number ``index`` of them, and
round again."""

from collections.abc import Iterable
from functools import lru_cache

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import ScanFiles, open_scans
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry.scan import Scan

FOCAL_TOLERANCE = 0.02
"""By which share a camera's focal length may differ from that of the training."""


@lru_cache(maxsize=1)
def open_conditions(path: str | None, layout: str | None = None, split: str | None = None) -> ScanFiles | None:
    """The dataset that conditions come from, once per process; None without a path.

    Raises:
        ConfigError: on a layout or a split without a path, and as ``open_scans``.
        FileError, DataError: as ``open_scans``.
    """
    if path is not None:
        return open_scans(path, layout=layout, split=split)
    if layout is not None or split is not None:
        raise ConfigError(f"conditions of layout {layout} and split {split}, but no dataset", "--condition PATH, too")
    return None


def conditions_for(
    generator: Generator, path: str | None, layout: str | None = None, split: str | None = None
) -> ScanFiles | None:
    """The dataset that a model's conditions come from, if it is one that the model understands.

    Raises:
        ConfigError: where a conditional model gets none, or the other way round, and as ``open_conditions``.
        DataError: where the dataset's camera is another than that of the training, or not known, and as
            ``open_conditions``.
        FileError: as ``open_conditions``.
    """
    if (generator.condition is None) != (path is None):
        needs = f"{generator.condition} conditions" if generator.condition else "no condition"
        raise ConfigError(
            f"condition {path} for model {generator.name!r}, which takes {needs}",
            "a dataset whose scans have them" if generator.condition else "none",
        )
    source = open_conditions(path, layout, split)
    if source is not None and generator.condition:
        _check_camera(source, generator.header.conditioning[generator.condition].get("focal"))
    return source


def _check_camera(source: ScanFiles, focal: float | None) -> None:
    """Refuse a camera of another focal length: its images show more or less than those of the training."""
    if focal is None:
        return
    camera = source.calibration(0)
    found = None if camera is None else float(camera.projection[0, 0])
    if found is None or abs(found / focal - 1) > FOCAL_TOLERANCE:
        given = "no calibration" if found is None else f"a focal length of {found:.1f} pixels"
        raise DataError(
            f"{source.root}: a camera with {given}",
            f"{focal:.1f} pixels, those of the camera that the model was trained on",
            "Crop and resize the images to what that camera sees, and say so in the dataset's calibration files.",
        )


def conditions(source: ScanFiles | None, indices: Iterable[int]) -> list[Scan] | None:
    """The scans that condition those of these indices; None for an unconditional model.

    Raises:
        FileError, DataError: where one cannot be read.
    """
    return None if source is None else [source.read(index % len(source)) for index in indices]


def condition_names(source: ScanFiles | None, indices: Iterable[int]) -> list[str]:
    """Their names; none for an unconditional model."""
    return [] if source is None else [source.ids[index % len(source)] for index in indices]
