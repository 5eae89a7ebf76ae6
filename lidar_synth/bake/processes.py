"""Engine ``processes``: several processes on this machine, each taking the next shard that nobody has.

On GPUs every process has one of its own, in turn. A worker that is killed stops the run with a message; what it was
making is made by the next one.
"""

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from operator import attrgetter
from typing import Any

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import FileError

_LOOK = 0.2  # seconds between two looks at the workers
_PATIENCE = 60  # seconds for a worker to give up its shard


def bake_in_processes(plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress) -> None:
    """Make the shards in ``resources.workers`` processes.

    Raises:
        FileError: where a worker was killed.
    """
    context = get_context("spawn")  # a fork would share torch's threads
    count = min(resources.workers, len(numbers))
    taken, errors = context.Value("q", 0), context.SimpleQueue()
    # What this process looks at has no lock: a worker that is killed while it holds one would stop it for good.
    scans, stop = context.RawArray("q", count), context.RawValue("b", 0)
    workers = [
        context.Process(target=_work, args=(plan, numbers, taken, scans, stop, errors, rank), daemon=True)
        for rank in range(count)
    ]
    told = 0
    try:
        with _signals_wait():
            for worker in workers:
                worker.start()
        while any(worker.is_alive() for worker in workers):
            for worker in workers:
                worker.join(_LOOK / len(workers))
            told += _tell(progress, sum(scans) - told)
            if not errors.empty():
                raise errors.get()
            if killed := [worker for worker in workers if worker.exitcode not in (None, 0)]:
                raise FileError(
                    f"a worker was killed (exit status {killed[0].exitcode})",
                    "enough memory for all workers",
                    "Run the same again, perhaps with fewer workers: finished shards are kept.",
                )
        if not errors.empty():
            raise errors.get()
        _tell(progress, sum(scans) - told)
    finally:
        stop.value = 1
        for worker in filter(attrgetter("pid"), workers):  # those that were started
            worker.join(_PATIENCE)
            worker.kill()  # one that a killed worker left waiting for a lock
            worker.join()


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Signals are heard when all processes that start within are started; these never hear control-C, which a terminal
    sends to all: this one says when to stop."""
    heard: list[int] = []
    in_charge = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if in_charge else ()
    before = {number: signal.signal(number, lambda found, frame: heard.append(found)) for number in numbers}
    masks = hasattr(signal, "pthread_sigmask")  # not on Windows
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
    for late in heard:
        signal.raise_signal(late)


def _tell(progress: Progress, scans: int) -> int:
    if scans:
        progress(scans)
    return scans


def _work(plan: BakePlan, numbers: Sequence[int], taken: Any, scans: Any, stop: Any, errors: Any, rank: int) -> None:
    """One worker: until there is no shard left, or the run is stopped."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Windows, where none can be deaf from the start
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
