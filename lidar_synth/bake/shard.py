"""Writes one shard of a plan; every engine runs this."""

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import torch

from lidar_synth.bake.conditions import (
    ConditionSource,
    condition_names,
    conditions,
    fingerprint,
    open_conditions,
    open_objects,
)
from lidar_synth.bake.folder import at_work, find_finished, publish
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.options import BakeJob
from lidar_synth.bank import Entry, Facts, ShardWriter
from lidar_synth.bank.folder import open_folder
from lidar_synth.errors import ConfigError, FileError, LidarSynthError
from lidar_synth.files.processes import usable_cores
from lidar_synth.generate.devices import DTYPES
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import RangeImage

_PACKED = (
    0.6  # highest ratio of compressed to plain size, for scans that models generate
)

Progress = Callable[[int], object]
"""Called with the number of newly generated scans; an exception in it aborts the shard."""


def bake_shard(
    plan: BakePlan, number: int, progress: Progress = lambda scans: None
) -> Entry:
    """Write one shard, unless it exists.

    Args:
        plan: a plan whose folder ``prepare`` has claimed.
        number: number of the shard.
        progress: called with the number of scans as they are generated.

    Returns:
        The shard, with size and hash.

    Raises:
        FileError: if the folder has vanished or cannot be written, or the disk is or would become
            full.
        ConfigError: if the checkpoint has changed since the plan was made, or the device is not
            available.
    """
    there = find_finished(plan, number)
    if there is not None:
        progress(there.scans)
        return there
    entry = plan.shards[number]
    with at_work(plan), open_folder(plan.out).making(entry.file) as part:
        _check_space(plan, part.parent, entry)
        generator = load_checked(plan.job, plan.facts)
        write_shard(generator, part, plan.job, plan.facts, entry, progress)
        return publish(plan, number, part)


def write_shard(
    generator: Generator,
    path: Path,
    job: BakeJob,
    facts: Facts,
    entry: Entry,
    progress: Progress,
) -> None:
    """Generate the scans of a shard and write them; the same settings give the same bytes.

    Raises:
        FileError: if the file cannot be written or the disk is full.
    """
    names = condition_names(_source(job), range(entry.first, entry.first + entry.scans))
    # One thread compresses 250 scans/s, more than a CPU generates; the number of threads changes no
    # byte.
    compressors = job.threads if job.device == "cpu" else min(16, usable_cores())
    writer = ShardWriter(path, facts, entry, conditions=names, threads=compressors)
    with torch_threads(job.threads), writer:
        for image in images(generator, job, entry):
            writer.append(image)
            progress(1)


def images(generator: Generator, job: BakeJob, entry: Entry) -> Iterator[RangeImage]:
    """The range images of a shard, generated in batches; the first batch starts with the shard."""
    size = job.batch or generator.batch
    stop = entry.first + entry.scans
    for first in range(entry.first, stop, size):
        indices = range(first, min(first + size, stop))
        yield from generate(generator, job, indices)


def generate(
    generator: Generator, job: BakeJob, indices: Sequence[int]
) -> list[RangeImage]:
    """The range images of some indices, with the settings of the job.

    Raises:
        FileError, DataError: if a condition cannot be read.
    """
    given = conditions(_source(job), indices)
    return generator.range_images(
        job.seed,
        indices,
        given,
        open_objects(job.objects, generator.sensor),
        steps=job.steps,
        solver=job.solver,
        guidance=job.guidance,
    )


def _source(job: BakeJob) -> ConditionSource | None:
    return open_conditions(job.condition, job.condition_layout, job.condition_split)


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set torch's number of threads, on which the computed bits depend, so that all engines compute
    the same."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=1)
def _load(
    model: str, device: str, dtype: str, batch: int | None, columns: int | None
) -> Generator:
    return load_generator(
        model, device=device, dtype=DTYPES[dtype], batch=batch, columns=columns
    )


def load_checked(job: BakeJob, facts: Facts) -> Generator:
    """Load the model of a bank, once per process.

    Raises:
        ConfigError: if it is another checkpoint, or the device is not available.
        FileError, DataError: if it cannot be read.
    """
    settings = (
        job.model,
        job.device,
        job.dtype,
        job.batch,
        job.columns,
    )
    generator = _load(*settings)
    # maybe the file was replaced since it was loaded
    if generator.hash != facts.checkpoint:
        _load.cache_clear()
        generator = _load(*settings)
    if generator.hash != facts.checkpoint:
        raise ConfigError(
            f"model {job.model!r}, checkpoint {generator.hash[:12]}",
            f"the checkpoint that made the bank's scans, {facts.model} {facts.checkpoint[:12]}",
            "Give its file with --model.",
        )
    wanted = (facts.condition or {}).get("content")
    why = ""
    try:
        found = fingerprint(_source(job))
    except LidarSynthError as error:
        found = None
        why = f" ({error})"
    if wanted not in (None, found):
        open_conditions.cache_clear()  # they may be restored
        raise ConfigError(
            f"conditions {job.condition}{why}, which have moved or changed since the bank was "
            "begun",
            "the files, or the names of scans, of its first shard",
            "Restore them, name their dataset with --condition, or bake into another folder.",
        )
    return generator


def _check_space(plan: BakePlan, folder: Path, entry: Entry) -> None:
    need = int(entry.scans * plan.scan_bytes * _PACKED)
    free = shutil.disk_usage(folder).free
    if free < need:
        raise FileError(
            f"{folder} has {free / 1e6:.1f} MB free",
            f"{math.ceil(need / 1e5) / 10:.1f} MB for the next shard",
            "Free some space and run the same command again: finished shards are kept.",
        )
