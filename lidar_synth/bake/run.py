"""A whole bake: claim the folder, make the shards that are not there by an engine, write the index.

To add an engine: write a file with a function of ``Engine``'s kind and enter it in ``ENGINES``.
"""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from tqdm import tqdm

from lidar_synth.bake.folder import at_work, finish, finished, prepare
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.local import bake_local
from lidar_synth.bake.processes import bake_in_processes
from lidar_synth.bake.ray_actors import bake_on_ray
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress
from lidar_synth.bake.slurm import bake_on_slurm
from lidar_synth.bake.torchrun import bake_under_torchrun
from lidar_synth.bank import Index
from lidar_synth.errors import ConfigError
from lidar_synth.formats.source import choose

Engine = Callable[[BakePlan, Sequence[int], Resources, Progress], None]

ENGINES: dict[str, Engine] = {
    "local": bake_local,
    "processes": bake_in_processes,
    "ray": bake_on_ray,
    "slurm": bake_on_slurm,
    "torchrun": bake_under_torchrun,
}
"""How shards are made, by name; all of them run ``bake_shard``."""


@dataclass(frozen=True)
class Share:
    """Every n-th shard, for runs that know nothing of each other.

    Raises:
        ConfigError: on an index that is not one of the shares.
    """

    index: int = 0
    of: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.of:
            raise ConfigError(f"--shard-index {self.index} of --num-shards {self.of}", "0 <= index < number")


def bake(
    plan: BakePlan,
    engine: str = "local",
    resources: Resources | None = None,
    share: Share | None = None,
    progress: bool = True,
) -> Index | None:
    """Make a bank, or go on with it.

    Args:
        plan: what to make.
        engine: one of ``ENGINES``.
        resources: what it may use.
        share: the part of the shards that this run makes; by default all.
        progress: show a bar.

    Returns:
        The bank's index; None where shards of another run are still missing.

    Raises:
        ConfigError: on an unknown engine, fewer than one worker, or a folder that was filled with other settings.
        FileError: where the folder cannot be written or the disk is full; what is finished is kept.
        LibraryError: where the engine's library is not installed.
        KeyboardInterrupt: on SIGINT or SIGTERM; what is finished is kept.
    """
    run = choose("engine", engine, ENGINES)
    resources, share = resources or Resources(), share or Share()
    if resources.workers < 1:
        raise ConfigError(f"{resources.workers} workers", "at least 1")
    prepare(plan)
    with _terminated_as_interrupted():
        with at_work(plan):
            mine = range(len(plan.shards))[share.index :: share.of]
            looked_at = tqdm(mine, "looking at what is there", unit="shard", leave=False, disable=not progress, delay=2)
            missing = [number for number in looked_at if finished(plan, number) is None]
            scans = sum(plan.shards[number].scans for number in missing)
            if missing:
                with tqdm(total=scans, unit="scan", smoothing=0.05, disable=not progress) as bar:
                    run(plan, missing, resources, bar.update)
        return finish(plan)


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM stops a run as control-C does: the shard in hand is given up, its file removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
