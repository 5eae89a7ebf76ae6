"""The other side of the generator process: who starts it, asks it, waits for it and ends it.

Every wait ends: with an answer, with the news of a death, which closes the connection, or with the time-out.
"""

import os
import threading
import weakref
from multiprocessing import connection, current_process, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import assert_spawning
from multiprocessing.process import BaseProcess
from typing import Any

from lidar_synth.errors import ConfigError, ProcessError
from lidar_synth.mixing.service.process import GET, GeneratorJob, receive, run, send
from lidar_synth.mixing.service.slots import Slots


class Client:
    """A generator process, as its parent and the parent's workers see it.

    Args:
        plan: what it does.
        slots: what it fills.
        timeout: seconds that a wait may last.

    Attributes:
        pid: the process's number.

    Raises:
        ConfigError: in a worker.
        ProcessError: where it does not start, with its reason.
    """

    def __init__(self, plan: GeneratorJob, slots: Slots, timeout: float) -> None:
        if current_process().daemon:
            raise ConfigError("a rolling bank made inside a worker process", "one that is made before the workers are")
        self.timeout = timeout
        self._slots, self._secret = slots, plan.secret
        self._connections: dict[tuple[int, int], Connection] = {}  # by process and thread
        context = get_context("spawn")
        started, end = context.Pipe(duplex=False)
        self._process = context.Process(target=run, args=(plan, slots, end), name="lidar-synth", daemon=True)
        self._process.start()
        end.close()
        self._owner, self.pid = os.getpid(), self._process.pid or 0
        self._end = weakref.finalize(self, _end, self._process, self._owner)
        try:
            if not connection.wait([started, self._process.sentinel], timeout):
                raise self._late("loaded the model")
            self._address = started.recv_bytes().decode()
        except EOFError as error:
            guard = "A script that starts processes begins with: if __name__ == '__main__':"
            raise self._died("" if slots.last_words else guard) from error
        except BaseException:
            self.close()
            raise

    def ask(self, *request: int) -> list[int]:
        """The answer to a request.

        Raises:
            ProcessError: where there is none.
        """
        answered = False
        try:
            self.tell(*request)
            line = self._line()
            if not line.poll(self.timeout):
                raise self._late(f"answered (scan {request[1]})" if request[0] == GET else "answered")
            answer = receive(line)
            answered = True
            return answer
        except (EOFError, OSError) as error:
            raise error if isinstance(error, ProcessError) else self._died() from error
        finally:
            if not answered:  # what comes late is not taken for the answer to another request
                self._connections.pop(_here(), None)

    def tell(self, *request: int) -> None:
        """A request without an answer; ``OSError`` where nobody hears it."""
        send(self._line(), *request)

    def close(self) -> None:
        """End the process, where it was started here."""
        self._connections.clear()
        if os.getpid() == self._owner:
            self._end()

    def __getstate__(self) -> dict[str, Any]:
        assert_spawning(self)  # elsewhere the pickle would hold a copy of the slots that nobody fills
        return {k: v for k, v in self.__dict__.items() if k not in ("_process", "_end")} | {"_connections": {}}

    def _line(self) -> Connection:
        """This thread's own connection; a fork inherits its parent's, but has to leave them alone."""
        if _here() not in self._connections:
            if os.getpid() == self._owner and not self._end.alive:
                raise ConfigError("a rolling bank that is closed", "one that is open")
            for inherited in [key for key in self._connections if key[0] != os.getpid()]:
                del self._connections[inherited]
            line = self._connections[_here()] = connection.Client(self._address)
            line.send_bytes(self._secret)
        return self._connections[_here()]

    def _died(self, hint: str = "") -> ProcessError:
        code = ""
        if os.getpid() == self._owner:
            self._process.join(1)
            code = f", exit code {self._process.exitcode}"
        words = self._slots.last_words or "it said nothing: killed, out of memory, or closed by the main process"
        return ProcessError(
            f"the generator process of the rolling bank died (process {self.pid}{code}; {words})",
            "one that lives as long as training",
            hint,
        )

    def _late(self, what: str) -> ProcessError:
        made = self._slots.counters[0]
        return ProcessError(
            f"the generator process of the rolling bank (process {self.pid}, {made} scans made so far) has not {what} "
            f"within {self.timeout:g} s",
            "a model that keeps up",
            "Give timeout= more seconds, use a faster device or fewer steps, or serve held scans: starved='reuse'.",
        )


def _here() -> tuple[int, int]:
    return os.getpid(), threading.get_ident()


def _end(process: BaseProcess, owner: int) -> None:
    if os.getpid() == owner:  # not in a fork
        process.kill()  # it holds nothing that it could save
        process.join()
