"""The generator process: it owns the model, fills the slots and answers the readers.

One thread makes scans, one thread answers each reader, and one ends the process when its parent has
ended in any way. A message is a few int64 numbers, so that nothing is ever unpickled, and a reader
that dies in the middle of a message leaves only a closed connection behind.
"""

import hmac
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import parent_process
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from secrets import token_bytes, token_hex
from threading import Thread
from typing import Any

import numpy as np
import torch

from lidar_synth.errors import LidarSynthError
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.mixing.service.ledger import Ledger, Slot, Starved
from lidar_synth.mixing.service.slots import Slots

GET, GIVE_BACK, SET_EPOCH, EXPECT = range(4)
"""The first number of a request. The others are the scan's number (``GET``), none (``GIVE_BACK``),
the epoch (``SET_EPOCH``), or whether this is the last part, followed by the numbers (``EXPECT``).

The answer to ``GET`` is (slot, number, checksum); ``GIVE_BACK`` has no answer; the others are
answered by 0.
"""

WATCH = 0.5
"""Seconds between two checks that the parent is alive."""


@dataclass(frozen=True)
class GeneratorJob:
    """The job of the generator process.

    Args:
        model: as for ``load_generator``.
        options: options of ``load_generator``.
        sampling: options of ``Generator.range_images``.
        seed: seed of the scans.
        starved, replaced: as for ``Ledger``.
        threads: number of torch threads; None = torch's default.
        secret: the first message of every reader, which authenticates it.
    """

    model: str | Path
    seed: int
    starved: Starved
    replaced: int
    threads: int | None
    options: dict[str, Any] = field(default_factory=dict)
    sampling: dict[str, Any] = field(default_factory=dict)
    secret: bytes = field(default_factory=lambda: token_bytes(32))


def send(connection: Connection, *values: int) -> None:
    """Send a message of int64 numbers."""
    connection.send_bytes(np.array(values, np.int64).tobytes())


def receive(connection: Connection) -> list[int]:
    """Receive a message; the inverse of ``send``."""
    values: list[int] = np.frombuffer(connection.recv_bytes(), np.int64).tolist()
    return values


def run(job: GeneratorJob, slots: Slots, started: Connection) -> None:
    """The main function of the process; it never returns.

    Args:
        job: what the process is to do.
        slots: the shared memory to fill.
        started: the pipe to which the address is sent once the model is loaded.
    """
    # Ctrl-C goes to all processes of a terminal; the parent ends us.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_watch_parent, daemon=True).start()
    try:
        if job.threads:
            torch.set_num_threads(job.threads)
        generator = load_generator(job.model, **job.options)
        ledger = Ledger(slots.count, slots.counters, job.starved, job.replaced)
        # Linux: an abstract socket name, which has no file and disappears with the process.
        name = f"\0lidar-synth-{token_hex(16)}" if sys.platform == "linux" else None
        listener = Listener(name, backlog=128)
        Thread(target=_accept, args=(listener, job.secret, ledger), daemon=True).start()
        started.send_bytes((name or str(listener.address)).encode())
        while True:
            _make(generator, job, ledger.claim(generator.batch), slots, ledger)
    except BaseException as error:
        slots.last_words = f"{type(error).__name__}: {error}"
        if not isinstance(error, LidarSynthError):
            traceback.print_exc()
        os._exit(1)  # at once, so that no reader waits for an answer


def _make(
    generator: Generator,
    job: GeneratorJob,
    claimed: Sequence[Slot],
    slots: Slots,
    ledger: Ledger,
) -> None:
    images = generator.range_images(
        job.seed, [slot.number for slot in claimed], **job.sampling
    )
    for slot, image in zip(claimed, images, strict=True):
        ledger.publish(slot, slots.write(slot.place, slot.number, image))


def _watch_parent() -> None:
    """End this process with its parent. Its pipe does not show this, because forked workers hold
    the other end too."""
    parent = parent_process()
    assert parent is not None, "a generator process without a parent"
    number = parent.pid if os.name == "posix" else os.getppid()
    while parent.is_alive() and os.getppid() == number:
        parent.join(WATCH)
    os._exit(0)


def _accept(listener: Listener, secret: bytes, ledger: Ledger) -> None:
    while True:
        with suppress(OSError, EOFError):
            Thread(
                target=_answer, args=(listener.accept(), secret, ledger), daemon=True
            ).start()


def _answer(connection: Connection, secret: bytes, ledger: Ledger) -> None:
    """Serve one reader until its connection is closed."""
    lent: Slot | None = None
    expected: list[int] = []
    with connection, suppress(OSError, EOFError):
        try:
            if not hmac.compare_digest(connection.recv_bytes(len(secret)), secret):
                return
            while True:
                request, *values = receive(connection)
                if lent and request in (GET, GIVE_BACK):
                    ledger.give_back(lent)
                    lent = None
                if request == GET:
                    lent = ledger.lend(*values)
                    send(connection, lent.place, lent.number, lent.checksum)
                elif request == SET_EPOCH:
                    ledger.set_epoch(*values)
                    send(connection, 0)
                elif request == EXPECT:
                    last, *numbers = values
                    expected += numbers
                    if last:
                        ledger.expect(expected)
                        expected = []
                    send(connection, 0)
        finally:
            if lent:
                ledger.give_back(lent)
