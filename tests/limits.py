"""Run a call in a process of its own, within limits of memory and time, as input that could end a
process needs."""

import re
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from fuzzing.server import forkserver

_STATUS = Path("/proc/self/status")

needs_limits = pytest.mark.skipif(
    not _STATUS.exists(), reason="limits of a process are set as Linux has them"
)


def in_limits(
    call: Callable[..., object],
    *arguments: Any,
    megabytes: int = 500,
    seconds: float = 60,
) -> str:
    """What becomes of ``call(*arguments)``.

    Args:
        call: a function of a module; it and the arguments are pickled.
        arguments: what it is called with.
        megabytes: memory that the call may take beside what its modules take.
        seconds: how long it may last.

    Returns:
        ``""`` where it returned, ``"DataError: its message"`` where it raised, or how its process
        ended.
    """
    context = forkserver()
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(
        target=_limited, args=(sender, megabytes, call, arguments), daemon=True
    )
    process.start()
    sender.close()
    try:
        if not receiver.poll(seconds):
            return f"still running after {seconds:g} s"
        return str(receiver.recv())
    except EOFError:
        process.join()
        return f"its process ended with {process.exitcode}"
    finally:
        process.kill()
        process.join()


def _limited(
    sender: Connection,
    megabytes: int,
    call: Callable[..., object],
    arguments: tuple[Any, ...],
) -> None:
    import resource

    [taken] = re.findall(r"VmData:\s*(\d+) kB", _STATUS.read_text())
    resource.setrlimit(
        resource.RLIMIT_DATA, ((int(taken) << 10) + (megabytes << 20),) * 2
    )
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        call(*arguments)
    except BaseException as error:
        sender.send(f"{type(error).__name__}: {error}")
    else:
        sender.send("")
