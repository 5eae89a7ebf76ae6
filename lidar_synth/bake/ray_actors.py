"""Engine ``ray``: actors on a Ray cluster, one accelerator each, all writing to a folder that every
node shares.

An actor gets a shard only when it is running, so that a pending actor blocks no shard. When an
actor or its node is lost, its shard returns to the queue and a new actor is requested: nodes may
join and leave during the bake.
"""

import os
from collections import deque
from collections.abc import Sequence
from typing import Any

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import ConfigError, FileError, LibraryError

# Lost actors per worker, without a finished shard in between, after which the bake fails.
_LOSSES = 5


class Baker:
    """The actor: it holds the plan and keeps the model loaded between shards."""

    def __init__(self, plan: BakePlan) -> None:
        self._plan = plan

    def ready(self) -> None:
        """Return as soon as the actor is running."""

    def bake(self, number: int) -> int:
        """Write one shard and return its number of scans."""
        return bake_shard(self._plan, number).scans


def bake_on_ray(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write the shards with ``resources.workers`` actors.

    Raises:
        LibraryError: if this package is not installed on a node.
        ConfigError: if no cluster is running at the address.
        FileError, DataError: as ``bake_shard``.
    """
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    started = not ray.is_initialized()
    if started:
        try:
            ray.init(address=resources.address, log_to_driver=False)
        except ConnectionError as error:
            raise ConfigError(
                f"Ray address {resources.address!r} ({error})", "a running cluster"
            ) from error
    share: dict[str, Any] = (
        {"num_gpus": 1} if plan.job.device == "cuda" else {"num_cpus": plan.job.threads}
    )
    actor = ray.remote(max_restarts=0, **share)(Baker)
    try:
        _work_off(
            ray,
            lambda: actor.remote(plan),
            deque(numbers),
            min(resources.workers, len(numbers)),
            progress,
        )
    finally:
        if started:
            ray.shutdown()


def _work_off(
    ray: Any, start: Any, waiting: deque[int], workers: int, progress: Progress
) -> None:
    """Assign shards to actors until all are written."""
    # pending result: (its actor, the shard it writes)
    running: dict[Any, tuple[Any, int | None]] = {}
    losses = 0  # since the last finished shard

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
                    f"a Ray actor cannot start ({error})",
                    "the same lidar_synth and versions on every node",
                ) from error
            losses += 1
            if losses > _LOSSES * workers:
                raise FileError(
                    f"{losses} Ray actors were lost without a finished shard ({error})",
                    "nodes with enough memory",
                    "Run the same command again, possibly with fewer workers: finished shards "
                    "are kept.",
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
