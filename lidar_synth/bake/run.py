"""A complete bake: claim the folder, write the missing shards with an engine, write the index.

To add an engine, write a function with the signature of ``Engine`` in a file of its own and add it
to ``ENGINES``.
"""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module

from tqdm import tqdm

from lidar_synth.bake.folder import at_work, find_missing, finish, prepare, release
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.processes import bake_in_processes
from lidar_synth.bake.ray_actors import bake_on_ray
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.bake.share import Share
from lidar_synth.bake.slurm import bake_on_slurm
from lidar_synth.bake.torchrun import take_part
from lidar_synth.bank import Index
from lidar_synth.errors import choose, needs
from lidar_synth.generate.devices import check_device

Engine = Callable[[BakePlan, Sequence[int], Resources, Progress], None]


def bake_local(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write the shards one after the other, in this process."""
    for number in numbers:
        bake_shard(plan, number, progress)


ENGINES: dict[str, Engine] = {
    "local": bake_local,
    "processes": bake_in_processes,
    "ray": bake_on_ray,
    "slurm": bake_on_slurm,
    "torchrun": bake_local,  # its part of the shards
}
"""Engines by name; each of them runs ``bake_shard``."""

LIBRARIES = {"ray": "ray", "slurm": "submitit"}
"""The libraries of engines, whose devices are in other machines."""


def check_engine(engine: str, plan: BakePlan) -> None:
    """Check that an engine can start on this machine.

    Raises:
        ConfigError: on an unknown engine, a device that is not available, or ``torchrun`` in a
            process that torchrun did not start.
        LibraryError: if the engine's library is not installed.
    """
    choose("engine", engine, ENGINES)
    if library := LIBRARIES.get(engine):
        with needs(engine, f"engine {engine!r}, but {library}"):
            import_module(library)
    else:
        check_device(plan.job.device)
    if engine == "torchrun":
        take_part(plan, range(0))


def bake(
    plan: BakePlan,
    engine: str = "local",
    resources: Resources | None = None,
    share: Share | None = None,
    progress: bool = True,
) -> Index | None:
    """Bake a bank, or resume an interrupted bake.

    Args:
        plan: the plan of the bank.
        engine: one of ``ENGINES``.
        resources: resources of the engine.
        share: the shards that this run writes; by default all.
        progress: show a bar.

    Returns:
        The bank's index; None if shards of another run are still missing.

    Raises:
        ConfigError: on an unknown engine, a device that is not available, or a folder of a bake
            with other settings.
        FileError: if the folder cannot be written or the disk is full; finished shards are kept.
        LibraryError: if the engine's library is not installed.
        KeyboardInterrupt: on SIGINT or SIGTERM; finished shards are kept.
    """
    check_engine(engine, plan)
    resources = resources or Resources()
    share = share or Share()
    plan = prepare(plan)
    with _terminated_as_interrupted(), _releasing(plan):
        with at_work(plan):
            mine = range(len(plan.shards))[share.index :: share.of]
            if engine == "torchrun":
                mine = take_part(plan, mine)
            checked = tqdm(
                mine,
                "checking existing shards",
                unit="shard",
                leave=False,
                disable=not progress,
                delay=2,
            )
            missing = find_missing(plan, checked)
            if missing:
                with tqdm(
                    total=sum(plan.shards[number].scans for number in missing),
                    unit="scan",
                    smoothing=0.05,
                    disable=not progress,
                ) as bar:
                    ENGINES[engine](plan, missing, resources, bar.update)
        return finish(plan)


@contextmanager
def _releasing(plan: BakePlan) -> Iterator[None]:
    """Take back the claim of the folder after an error before the first shard."""
    try:
        yield
    except BaseException:
        release(plan)
        raise


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C: abort the current shard and remove its temporary file."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
