"""What the scans of a bake are conditioned on: the scans of a dataset, scan ``index`` by number ``index`` of them, and
round again."""

from collections.abc import Iterable
from functools import lru_cache

from lidar_synth.bake.job import Job
from lidar_synth.formats import ScanFiles, open_scans
from lidar_synth.scan import Scan


def conditions(job: Job, indices: Iterable[int]) -> list[Scan] | None:
    """The scans that condition those of these indices; None for an unconditional bake.

    Raises:
        FileError, DataError: where one cannot be read.
    """
    source = _source(job)
    return None if source is None else [source.read(index % len(source)) for index in indices]


def condition_names(job: Job, indices: Iterable[int]) -> list[str]:
    """Their names; none for an unconditional bake."""
    source = _source(job)
    return [] if source is None else [source.ids[index % len(source)] for index in indices]


def _source(job: Job) -> ScanFiles | None:
    return None if job.condition is None else _open(job.condition, job.condition_layout, job.condition_split)


@lru_cache(maxsize=1)
def _open(path: str, layout: str | None, split: str | None) -> ScanFiles:
    """Once per process."""
    return open_scans(path, layout=layout, split=split)
