"""Engine ``processes``: several processes on this machine; each takes the next unassigned shard.

Each process uses one GPU, assigned in turn. A killed worker stops the run with an error message;
the next run writes its unfinished shard.
"""

import signal
from collections.abc import Sequence
from multiprocessing import get_context, parent_process
from operator import attrgetter
from typing import Any

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import FileError
from lidar_synth.files.processes import GUARD, defer_signals

_POLL = 0.2  # seconds between two checks of the workers
_PATIENCE = 60  # seconds for a worker to abort its shard


def bake_in_processes(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write the shards in ``resources.workers`` processes.

    Raises:
        FileError: if a worker was killed, or failed without an error to pass on.
    """
    context = get_context("spawn")  # a fork would share torch's threads
    count = min(resources.workers, len(numbers))
    taken = context.Value("q", 0)
    errors = context.SimpleQueue()
    # This process reads only values without a lock: a worker killed while holding a lock would
    # block it forever.
    scans = context.RawArray("q", count)
    stop = context.RawValue("b", 0)
    workers = [
        context.Process(
            target=_work,
            args=(plan, numbers, taken, scans, stop, errors, rank),
            daemon=True,
        )
        for rank in range(count)
    ]
    reported = 0
    try:
        # They ignore Ctrl-C: this process tells them when to stop.
        with defer_signals(signal.SIGINT, signal.SIGTERM):
            for worker in workers:
                worker.start()
        while any(worker.is_alive() for worker in workers):
            for worker in workers:
                worker.join(_POLL / len(workers))
            made = sum(scans)
            progress(made - reported)
            reported = made
            if not errors.empty():
                raise errors.get()
            if codes := [worker.exitcode for worker in workers if worker.exitcode]:
                raise _ended(codes[0])
        if not errors.empty():
            raise errors.get()
        progress(sum(scans) - reported)
    finally:
        stop.value = 1
        # skips workers that were not started
        for worker in filter(attrgetter("pid"), workers):
            worker.join(_PATIENCE)
            worker.kill()  # it may wait for a lock that a killed worker held
            worker.join()


def _ended(code: int) -> FileError:
    """The error of a worker's exit status; a negative one is that of a signal."""
    if code > 0:
        return FileError(
            f"a worker failed (exit status {code}), as its output says", hint=GUARD
        )
    return FileError(
        f"a worker was killed (exit status {code})",
        "enough memory for all workers",
        "Run the same command again, possibly with fewer workers: finished shards are kept.",
    )


def _work(
    plan: BakePlan,
    numbers: Sequence[int],
    taken: Any,
    scans: Any,
    stop: Any,
    errors: Any,
    rank: int,
) -> None:
    """One worker: writes shards until none is left or the run is stopped."""
    # On Windows, where the parent cannot block it before the start.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if plan.job.device == "cuda":
        import torch

        torch.cuda.set_device(rank % torch.cuda.device_count())
    parent = parent_process()

    def progress(made: int) -> None:
        if stop.value or parent is None or not parent.is_alive():
            raise KeyboardInterrupt
        scans[rank] += made

    try:
        while not stop.value:
            with taken.get_lock():
                position = taken.value
                taken.value += 1
            if position >= len(numbers):
                return
            bake_shard(plan, numbers[position], progress)
    except KeyboardInterrupt:
        return
    except Exception as error:
        errors.put(error)
