"""A process that reads case after case under a limit of memory and tells what came of each."""

import gc
import os
import resource
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from fuzzing.cases import Cases
from fuzzing.checks import fingerprint, flaws
from fuzzing.targets import Target
from lidar_synth.errors import LidarSynthError

EQUAL = "read equal"
SOUND = "read otherwise, sound"
REFUSED = "refused"
"""What may come of a case."""

UNSOUND = "unsound"
FOREIGN = "foreign error"
MEMORY = "too much memory"
DIED = "died"
SLOW = "too slow"
"""What may not."""


@dataclass(frozen=True)
class Limits:
    """What one case may take.

    Args:
        memory: bytes, beyond what the process held before it.
        seconds: by the clock.
    """

    memory: int = 500_000_000
    seconds: float = 5.0


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Args:
        number: of the case.
        verdict: one of the above.
        detail: the error, or what is wrong.
        seconds: for reading.
        peak: bytes by which the process's memory grew at most while it read.
    """

    number: int
    verdict: str
    detail: str = ""
    seconds: float = 0.0
    peak: int = 0


def work(
    name: str,
    target: Target,
    seed: int,
    numbers: range,
    limits: Limits,
    folder: Path,
    connection: Connection,
) -> None:
    """Read the cases ``numbers`` and send, for each, its number before and its ``Outcome`` behind.

    First the valid dataset is read: that imports and compiles all that reading needs, and tells
    what "equal" is. None is sent when that has been done.
    """
    quiet(folder / "output.txt")
    torch.set_num_threads(1)
    cases = Cases(name, target, seed, folder)
    valid = target.read(cases.root)
    if wrong := list(flaws(valid)):
        raise AssertionError(f"the valid dataset of {name} is unsound: {wrong}")
    expected = fingerprint(valid)
    del valid
    gc.collect()
    gc.freeze()
    connection.send(None)
    for number in numbers:
        root = cases.place(number)
        connection.send(number)
        connection.send(judge(number, target, root, expected, limits))
        cases.restore()


def judge(
    number: int, target: Target, root: Path, expected: str, limits: Limits
) -> Outcome:
    """Read a case."""
    gc.collect()
    before = reset_peak()
    data = memory("VmData")
    resource.setrlimit(
        resource.RLIMIT_DATA, (data + limits.memory, resource.RLIM_INFINITY)
    )
    start = time.perf_counter()
    try:
        verdict, detail = attempt(target, root, expected)
    finally:
        seconds = time.perf_counter() - start
        resource.setrlimit(
            resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        )
    peak = max(memory("VmHWM") - before, 0)
    if peak > limits.memory and verdict != MEMORY:
        verdict, detail = MEMORY, f"{verdict}: {detail}"
    return Outcome(number, verdict, detail, seconds, peak)


def attempt(target: Target, root: Path, expected: str) -> tuple[str, str]:
    """Verdict and detail."""
    try:
        found = target.read(root)
    except Exception as error:
        detail = f"{type(error).__name__}: {error}"[:500]
        if any(isinstance(cause, MemoryError) for cause in causes(error)):
            return MEMORY, detail
        return (REFUSED if isinstance(error, LidarSynthError) else FOREIGN), detail
    try:
        wrong = "; ".join(islice(flaws(found), 3))[:500]
    except Exception as error:
        wrong = f"{type(error).__name__} where it is used: {error}"[:500]
    if wrong:
        return UNSOUND, wrong
    return (EQUAL if fingerprint(found) == expected else SOUND), ""


def causes(error: BaseException | None) -> Any:
    """An error and those behind it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def quiet(path: Path) -> None:
    """Send what libraries print into a file, and no warnings at all."""
    warnings.simplefilter("ignore")
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
        os.dup2(
            file, stream.fileno() if stream in (sys.__stdout__, sys.__stderr__) else 2
        )


def memory(name: str) -> int:
    """Bytes, by a line of /proc/self/status."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    raise LookupError(name)


def reset_peak() -> int:
    """Set the peak of the process's memory to what it holds now; bytes. Where the system refuses,
    the old peak stays, and what lies below it is not seen."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return memory("VmHWM")
