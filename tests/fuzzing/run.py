"""Watch the workers: count what came of the cases, and notice those that die, hang or take too
much."""

import signal
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory

from fuzzing.server import forkserver
from fuzzing.targets import Target
from fuzzing.worker import DIED, FOREIGN, MEMORY, SLOW, UNSOUND, Limits, Outcome, work

START = 300.0
"""Seconds that a worker may take for the valid dataset, or the harness for making a case."""

FLAWS = (UNSOUND, FOREIGN, MEMORY, DIED, SLOW)

_starting = threading.Lock()


@dataclass
class Report:
    """What came of the cases of one reader.

    Args:
        counts: {verdict: cases}.
        flaws: of the cases that have one.
        peak: the most memory that a case took, bytes.
        slowest: the longest that a case took, seconds.
    """

    counts: Counter[str] = field(default_factory=Counter)
    flaws: list[Outcome] = field(default_factory=list)
    peak: int = 0
    slowest: float = 0.0

    @property
    def cases(self) -> int:
        return self.counts.total()

    def add(self, outcome: Outcome) -> None:
        """Count a case."""
        self.counts[outcome.verdict] += 1
        self.peak = max(self.peak, outcome.peak)
        self.slowest = max(self.slowest, outcome.seconds)
        if outcome.verdict in FLAWS:
            self.flaws.append(outcome)

    def merge(self, other: "Report") -> None:
        """Count the cases of another report."""
        self.counts += other.counts
        self.flaws = sorted(self.flaws + other.flaws, key=lambda flaw: flaw.number)
        self.peak, self.slowest = (
            max(self.peak, other.peak),
            max(self.slowest, other.slowest),
        )


def fuzz(
    name: str,
    target: Target,
    numbers: range,
    seed: int = 0,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    progress: Callable[[Outcome], object] = lambda outcome: None,
) -> Report:
    """Read the cases ``numbers`` of a reader, in a process that is started again wherever a case
    ends it.

    Raises:
        RuntimeError: where the valid dataset cannot be read, or the harness itself fails.
    """
    report = Report()
    with TemporaryDirectory(prefix="fuzz-") as folder:
        while len(numbers):
            for outcome in _until_the_end(
                name, target, numbers, seed, limits, Path(folder)
            ):
                report.add(outcome)
                progress(outcome)
                numbers = range(outcome.number + 1, numbers.stop)
    return report


def _until_the_end(
    name: str, target: Target, numbers: range, seed: int, limits: Limits, folder: Path
) -> list[Outcome]:
    """The outcomes of one worker's life; at least one."""
    process, connection = _start(name, target, numbers, seed, limits, folder)
    found: list[Outcome] = []
    current: int | None = None
    try:
        while len(found) < len(numbers):
            limit = START if current is None else limits.seconds
            if not connection.poll(limit):
                if current is None:
                    raise RuntimeError(
                        f"{name}: the harness did not answer within {limit:g} s"
                    )
                found.append(Outcome(current, SLOW, f"more than {limit:g} s", limit))
                break
            message = connection.recv()
            if isinstance(message, Outcome):
                found.append(message)
                current = None
            else:
                current = message
    except EOFError:
        process.join()
        if current is None:
            text = (
                (folder / "output.txt").read_text(errors="replace")
                if (folder / "output.txt").is_file()
                else ""
            )
            raise RuntimeError(
                f"{name}: the harness failed ({_ending(process)})\n{text[-3000:]}"
            ) from None
        found.append(Outcome(current, DIED, _ending(process)))
    finally:
        process.kill()
        process.join()
        connection.close()
    return found


def _start(
    name: str, target: Target, numbers: range, seed: int, limits: Limits, folder: Path
) -> tuple[BaseProcess, Connection]:
    """A worker and the end of the pipe on which it tells what it does."""
    context = forkserver()
    with _starting:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=work,
            args=(name, target, seed, numbers, limits, folder, theirs),
            daemon=True,
        )
        process.start()
        theirs.close()
    return process, ours


def _ending(process: BaseProcess) -> str:
    code = process.exitcode or 0
    return signal.Signals(-code).name if code < 0 else f"exit status {code}"
