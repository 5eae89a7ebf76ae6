"""What generated scans are conditioned on: the scans of a dataset, scan ``index`` by number ``index`` of them, and
round again."""

from collections.abc import Iterable
from functools import lru_cache

from lidar_synth.errors import ConfigError
from lidar_synth.formats import ScanFiles, open_scans
from lidar_synth.generator import Generator
from lidar_synth.scan import Scan


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


def check_condition(generator: Generator, path: str | None) -> None:
    """Refuse a conditional model without conditions, and the other way round.

    Raises:
        ConfigError: naming what is missing or too much.
    """
    if (generator.condition is None) != (path is None):
        needs = f"{generator.condition} conditions" if generator.condition else "no condition"
        raise ConfigError(
            f"condition {path} for model {generator.name!r}, which takes {needs}",
            "a dataset whose scans have them" if generator.condition else "none",
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
