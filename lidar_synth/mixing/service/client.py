"""The client of the generator process: it starts the process, sends requests, waits for answers and
ends it.

Every wait ends: with an answer, with a closed connection because the process died, or with the
timeout.
"""

import os
import signal
import threading
import weakref
from multiprocessing import connection, current_process, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import assert_spawning
from multiprocessing.process import BaseProcess
from typing import Any

from lidar_synth.errors import ConfigError, ProcessError
from lidar_synth.files.processes import GUARD, defer_signals
from lidar_synth.mixing.service.process import GET, GeneratorJob, receive, run, send
from lidar_synth.mixing.service.slots import Slots


class Client:
    """A generator process, as used by its parent process and the parent's workers.

    Args:
        job: what the process is to do.
        slots: the shared memory that it fills.
        timeout: maximum seconds of a wait.

    Attributes:
        pid: the process id.

    Raises:
        ConfigError: if it is made in a worker process.
        ProcessError: if the process does not start; the message names the reason.
    """

    def __init__(self, job: GeneratorJob, slots: Slots, timeout: float) -> None:
        if current_process().daemon:
            raise ConfigError(
                "a rolling bank made inside a worker process",
                "one that is made before the workers are",
            )
        self.timeout = timeout
        self._slots = slots
        self._secret = job.secret
        # by process and thread
        self._connections: dict[tuple[int, int], Connection] = {}
        context = get_context("spawn")
        started, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=run, args=(job, slots, sender), name="lidar-synth", daemon=True
        )
        with defer_signals(signal.SIGINT):
            self._process.start()
        sender.close()
        self._owner = os.getpid()
        self.pid = self._process.pid or 0
        self._end = weakref.finalize(self, _end, self._process, self._owner)
        self._address = self._await_address(started)

    def _await_address(self, started: Connection) -> str:
        """The address of the process, which it sends when it has loaded the model."""
        try:
            if not connection.wait([started, self._process.sentinel], self.timeout):
                raise self._late("loaded the model")
            return started.recv_bytes().decode()
        except EOFError as error:
            raise self._died("" if self._slots.last_words else GUARD) from error
        except BaseException:
            self.close()
            raise

    def ask(self, *request: int) -> list[int]:
        """Send a request and return the answer.

        Raises:
            ProcessError: if the process has died, or does not answer in time.
        """
        try:
            self.tell(*request)
            line = self._line()
            if not line.poll(self.timeout):
                raise self._late(
                    f"answered (scan {request[1]})" if request[0] == GET else "answered"
                )
            return receive(line)
        except BaseException as error:
            # a late answer must not be taken for that of another request
            self._connections.pop(_thread_key(), None)
            ended = isinstance(error, EOFError | OSError)
            if ended and not isinstance(error, ProcessError):
                raise self._died() from error
            raise

    def tell(self, *request: int) -> None:
        """Send a request that has no answer; raises ``OSError`` if the process has died."""
        send(self._line(), *request)

    def close(self) -> None:
        """End the process, if this process started it."""
        self._connections.clear()
        if os.getpid() == self._owner:
            self._end()

    def __getstate__(self) -> dict[str, Any]:
        # in any other pickle the slots would be a copy that no process fills
        assert_spawning(self)
        return {
            k: v for k, v in self.__dict__.items() if k not in ("_process", "_end")
        } | {"_connections": {}}

    def _line(self) -> Connection:
        """This thread's own connection; a forked process must not use the ones inherited from its
        parent."""
        if _thread_key() not in self._connections:
            if os.getpid() == self._owner and not self._end.alive:
                raise ConfigError("a rolling bank that is closed", "an open one")
            for inherited in [
                key for key in self._connections if key[0] != os.getpid()
            ]:
                del self._connections[inherited]
            line = self._connections[_thread_key()] = connection.Client(self._address)
            line.send_bytes(self._secret)
        return self._connections[_thread_key()]

    def _died(self, hint: str = "") -> ProcessError:
        code = ""
        if os.getpid() == self._owner:
            self._process.join(1)
            code = f", exit code {self._process.exitcode}"
        words = (
            self._slots.last_words
            or "no message: killed, out of memory, or closed by the main process"
        )
        return ProcessError(
            f"the generator process of the rolling bank died (process {self.pid}{code}; {words})",
            "a process that lives as long as training",
            hint,
        )

    def _late(self, what: str) -> ProcessError:
        made = self._slots.counters[0]
        return ProcessError(
            f"the generator process of the rolling bank (process {self.pid}, {made} scans made so "
            f"far) has not {what} within {self.timeout:g} s",
            "a model that is fast enough",
            "Increase timeout=, use a faster device or fewer steps, or reuse scans in memory: "
            "starved='reuse'.",
        )


def _thread_key() -> tuple[int, int]:
    return os.getpid(), threading.get_ident()


def _end(process: BaseProcess, owner: int) -> None:
    if os.getpid() == owner:  # not in a fork
        process.kill()  # it has nothing to save
        process.join()
