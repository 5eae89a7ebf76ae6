"""Engine ``ray``: actors on a Ray cluster, one accelerator each, all writing to a folder that every node sees.

An actor gets a shard when it is up, so that one which waits for a node holds nothing back. When an actor or its node
is lost, its shard goes back to the others and a new actor waits for room: nodes may come and go while the bake runs.
"""

import os
from collections import deque
from collections.abc import Sequence
from typing import Any

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import ConfigError, FileError, LibraryError

_LOSSES = 5  # actors that may be lost, for each worker, while no shard is made


class Baker:
    """What an actor holds: the plan; the model stays loaded between shards."""

    def __init__(self, plan: BakePlan) -> None:
        self._plan = plan

    def ready(self) -> None:
        """Return when the actor is up."""

    def bake(self, number: int) -> int:
        """Make one shard; the number of its scans."""
        return bake_shard(self._plan, number).scans


def bake_on_ray(plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress) -> None:
    """Make the shards by ``resources.workers`` actors.

    Raises:
        LibraryError: where Ray is not installed, here or on a node, or the package is not.
        ConfigError: where there is no cluster at the address.
        FileError, DataError: as ``bake_shard``.
    """
    ray = _import_ray()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    started = not ray.is_initialized()
    if started:
        try:
            ray.init(address=resources.address, log_to_driver=False)
        except ConnectionError as error:
            raise ConfigError(f"Ray address {resources.address!r} ({error})", "a cluster that is up") from error
    share: dict[str, Any] = {"num_gpus": 1} if plan.job.device == "cuda" else {"num_cpus": plan.job.threads}
    actor = ray.remote(max_restarts=0, **share)(Baker)
    try:
        _work_off(ray, lambda: actor.remote(plan), deque(numbers), min(resources.workers, len(numbers)), progress)
    finally:
        if started:
            ray.shutdown()


def _work_off(ray: Any, start: Any, waiting: deque[int], workers: int, progress: Progress) -> None:
    """Give shards to actors until all are made."""
    running: dict[Any, tuple[Any, int | None]] = {}  # what is awaited: (its actor, the shard it makes)
    losses = 0  # since the last shard that was made

    def begin() -> None:
        actor = start()
        running[actor.ready.remote()] = actor, None

    for _ in range(workers):
        begin()
    while waiting or any(number is not None for _, number in running.values()):
        [done], _ = ray.wait(list(running), num_returns=1)
        actor, number = running.pop(done)
        try:
            made = ray.get(done)
        except ray.exceptions.RayActorError as error:
            if error.actor_init_failed:
                raise LibraryError(
                    f"a Ray actor cannot start ({error})", "the same lidar_synth and versions on every node"
                ) from error
            losses += 1
            if losses > _LOSSES * workers:
                raise FileError(
                    f"{losses} Ray actors were lost and no shard was made ({error})",
                    "nodes with enough memory",
                    "Run the same again, perhaps with fewer workers: finished shards are kept.",
                ) from error
            if number is not None:
                waiting.append(number)
            begin()
            continue
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        if number is not None:
            progress(made)
            losses = 0
        if waiting:
            next_number = waiting.popleft()
            running[actor.bake.remote(next_number)] = actor, next_number


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise LibraryError(
            f"engine 'ray', but ray cannot be imported ({error})", "the extra ray", "pip install 'lidar_synth[ray]'"
        ) from error
    return ray
