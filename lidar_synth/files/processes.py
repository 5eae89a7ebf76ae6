"""Work in several processes, with results in order, which Ctrl-C stops without a traceback of a
worker."""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from math import ceil
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from lidar_synth.errors import ProcessError

Item = TypeVar("Item")
Result = TypeVar("Result")

GUARD = "In a script, put what starts processes below: if __name__ == '__main__':"
"""What to type where a process ended before its work: it runs a script again from the top."""

QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""What a container may use of the CPUs: their time in each period, and the period, microseconds."""

_work: Callable[[Any], Any] | None = None
_busy = _stopped = False


def _start(work: Callable[[Any], Any]) -> None:
    """Pass the function to a worker once, instead of with every item, and let Ctrl-C reach it from
    now on."""
    global _work
    _work = work
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupted)
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _interrupted(number: int, frame: Any) -> None:
    """End a worker's items at Ctrl-C, which a terminal sends to every process. While it waits for
    items, an exception would end it with a traceback; the main process ends it."""
    global _stopped
    _stopped = True
    if _busy:
        raise KeyboardInterrupt


def _next(item: Any) -> Any:
    global _busy
    assert _work is not None, "a worker that was not started by in_processes"
    _busy = True
    try:
        if _stopped:
            raise KeyboardInterrupt
        return _work(item)
    finally:
        _busy = False


def usable_cores() -> int:
    """Number of CPU cores that this process may use: a batch system or container may allow it
    fewer than the machine has, or a part of their time."""
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):  # not on Windows and macOS
        cores = len(os.sched_getaffinity(0))
    with suppress(OSError, ValueError):  # no such file; "max"
        quota, period = map(int, QUOTA.read_text().split())
        cores = min(cores, ceil(quota / period))
    return cores


@contextmanager
def defer_signals(*numbers: int) -> Iterator[None]:
    """Defer signals to the end of the block, in which processes start. These do not get Ctrl-C,
    which a terminal sends to every process of the group, before they ask for it.

    Args:
        numbers: the signals; Ctrl-C is SIGINT.
    """
    received: list[int] = []
    # A mask alone is not enough: any thread that takes the signal makes Python call the handler in
    # the main thread. Other threads get no exception from it.
    in_charge = threading.current_thread() is threading.main_thread()
    before = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in (numbers if in_charge else ())
    }
    masks = hasattr(signal, "pthread_sigmask")  # not on Windows
    if masks:
        resource_tracker.ensure_running()  # which lets signals through when it starts
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
    for late in received:
        signal.raise_signal(late)


@contextmanager
def map_in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, chunk: int = 1
) -> Iterator[Iterator[Result]]:
    """Map ``work`` over items in several processes, with results in order.

    Args:
        work: a function that can be pickled.
        items: its arguments.
        jobs: number of processes; 1 = this process.
        chunk: number of items that a worker takes at a time.

    Raises:
        ProcessError: if a worker ended before its work.
    """
    if jobs == 1 or len(items) < 2:
        yield map(work, items)
        return
    # Spawned, not forked: a fork would break threads of the parent (numba, torch). With one process
    # per core, threads inside numpy would only compete for the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(jobs, get_context("spawn"), _start, (work,)) as pool:
        try:
            with defer_signals(signal.SIGINT):  # map starts the workers
                results = pool.map(_next, items, chunksize=chunk)
            yield results
        except BrokenProcessPool as error:
            raise ProcessError(
                "a worker ended before its work", "enough memory for all workers", GUARD
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
