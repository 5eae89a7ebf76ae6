"""One shard of a plan, made once, whoever asks: what every engine runs."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

import torch

from lidar_synth.bake.conditions import condition_names, conditions, open_conditions
from lidar_synth.bake.folder import at_work, finished, publish
from lidar_synth.bake.job import DTYPES, BakePlan
from lidar_synth.bake.options import BakeJob
from lidar_synth.bank import Entry, Facts, ShardWriter
from lidar_synth.errors import ConfigError, FileError
from lidar_synth.files.disk import part_of
from lidar_synth.formats import ScanFiles
from lidar_synth.generate.generator import BATCH, Generator, load_generator
from lidar_synth.geometry.scan import RangeImage

_PACKED = 0.6  # size of a compressed scan over that of a plain one, at most, for what models make

Progress = Callable[[int], object]
"""Called with the number of scans that were just made; what it raises stops the shard."""


def bake_shard(plan: BakePlan, number: int, progress: Progress = lambda scans: None) -> Entry:
    """Make one shard, unless it is there.

    Args:
        plan: of a folder that ``prepare`` claimed.
        number: which shard.
        progress: told of the scans as they are made.

    Returns:
        The shard, with size and hash.

    Raises:
        FileError: where the folder has vanished or cannot be written, or the disk is or would become full.
        ConfigError: where the checkpoint is not the plan's any more, or the device is not there.
    """
    there = finished(plan, number)
    if there is not None:
        progress(there.scans)
        return there
    entry = plan.shards[number]
    part = part_of(plan.out / entry.file)
    with at_work(plan):
        _check_space(plan, entry)
        generator = load_checked(plan.job, plan.facts)
        try:
            write_shard(generator, part, plan.job, plan.facts, entry, progress)
            return publish(plan, number, part)
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)


def write_shard(generator: Generator, path: Path, job: BakeJob, facts: Facts, entry: Entry, progress: Progress) -> None:
    """Generate the scans of a shard and write them; the same settings give the same bytes.

    Raises:
        FileError: where the file cannot be written or the disk is full.
    """
    names = condition_names(_source(job), range(entry.first, entry.first + entry.scans))
    # One thread packs 250 scans a second, more than a CPU makes; how many there are changes no byte.
    packers = job.threads if job.device == "cpu" else min(16, os.cpu_count() or 1)
    writer = ShardWriter(path, facts, entry, conditions=names, threads=packers)
    with one_computer(job.threads), writer:
        for image in images(generator, job, entry):
            writer.append(image)
            progress(1)


def images(generator: Generator, job: BakeJob, entry: Entry) -> Iterator[RangeImage]:
    """The range images of a shard, in micro-batches that start with it."""
    size = job.batch or generator.batch
    stop = entry.first + entry.scans
    for first in range(entry.first, stop, size):
        indices = range(first, min(first + size, stop))
        yield from generate(generator, job, indices)


def generate(generator: Generator, job: BakeJob, indices: Sequence[int]) -> list[RangeImage]:
    """The range images of some indices, as the job has them made.

    Raises:
        FileError, DataError: where a condition cannot be read.
    """
    given = conditions(_source(job), indices)
    return generator.range_images(job.seed, indices, given, steps=job.steps, solver=job.solver, guidance=job.guidance)


def _source(job: BakeJob) -> ScanFiles | None:
    return open_conditions(job.condition, job.condition_layout, job.condition_split)


@contextmanager
def one_computer(threads: int) -> Iterator[None]:
    """The conditions under which all engines compute the same bits: as many torch threads as the settings say."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=1)
def _load(model: str, device: str, dtype: str, batch: int) -> Generator:
    return load_generator(model, device=device, dtype=DTYPES[dtype], batch=batch)


def load_checked(job: BakeJob, facts: Facts) -> Generator:
    """The model behind a bank, once per process.

    Raises:
        ConfigError: where it is another checkpoint, or the device is not there.
        FileError, DataError: where it cannot be read.
    """
    generator = _load(job.model, job.device, job.dtype, job.batch or BATCH[job.device])
    if generator.hash != facts.checkpoint:
        raise ConfigError(
            f"model {job.model!r}, checkpoint {generator.hash[:12]}",
            f"the checkpoint that made the bank's scans, {facts.model} {facts.checkpoint[:12]}",
            "Name its file with --model.",
        )
    return generator


def _check_space(plan: BakePlan, entry: Entry) -> None:
    need = int(entry.scans * plan.scan_bytes * _PACKED)
    free = shutil.disk_usage(plan.out).free
    if free < need:
        raise FileError(
            f"{plan.out} has {free / 1e6:.0f} MB free",
            f"about {need / 1e6:.0f} MB for the next shard",
            "Free some space and run the same again: finished shards are kept.",
        )
