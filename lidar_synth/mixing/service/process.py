"""The generator process: it owns the model, fills the slots and answers the readers.

One thread makes scans; one for each reader answers it; one ends the process when its parent is gone, however that
ended. A message is a few int64, so that nothing is ever unpickled and a reader that dies in mid-message leaves
nothing behind but a closed connection.
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
from lidar_synth.generate.generator import Generator, load_generator
from lidar_synth.mixing.service.ledger import Ledger, Slot, Starved
from lidar_synth.mixing.service.slots import Slots

GET, GIVE_BACK, SET_EPOCH, EXPECT = range(4)
"""First number of a request; then a scan's number, nothing, an epoch, and (whether it is the last part, numbers...).

``GET`` is answered by (slot, number, checksum), ``GIVE_BACK`` not at all, the others by 0.
"""

WATCH = 0.5
"""Seconds between two looks at the parent."""


@dataclass(frozen=True)
class GeneratorJob:
    """What the process does.

    Args:
        model: as ``load_generator`` takes it.
        options: for ``load_generator``.
        sampling: for ``Generator.range_images``.
        seed: of the scans.
        starved, replaced: as ``Ledger`` takes them.
        threads: of torch; None = torch's own choice.
        secret: the first message of a reader.
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
    """A message of int64."""
    connection.send_bytes(np.array(values, np.int64).tobytes())


def receive(connection: Connection) -> list[int]:
    """The inverse of ``send``."""
    values: list[int] = np.frombuffer(connection.recv_bytes(), np.int64).tolist()
    return values


def run(plan: GeneratorJob, slots: Slots, started: Connection) -> None:
    """The process; returns never.

    Args:
        plan: what to do.
        slots: what to fill.
        started: where to send the address once the model is loaded.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of a terminal; the parent ends us
    Thread(target=_watch_parent, daemon=True).start()
    try:
        if plan.threads:
            torch.set_num_threads(plan.threads)
        generator = load_generator(plan.model, **plan.options)
        ledger = Ledger(slots.count, slots.counters, plan.starved, plan.replaced)
        # Linux: a name that no file stands for and that ends with the process.
        name = f"\0lidar-synth-{token_hex(16)}" if sys.platform == "linux" else None
        listener = Listener(name, backlog=128)
        Thread(target=_accept, args=(listener, plan.secret, ledger), daemon=True).start()
        started.send_bytes((name or str(listener.address)).encode())
        while True:
            _make(generator, plan, ledger.claim(generator.batch), slots, ledger)
    except BaseException as error:
        slots.last_words = f"{type(error).__name__}: {error}"
        if not isinstance(error, LidarSynthError):
            traceback.print_exc()
        os._exit(1)  # at once, so that no reader waits for an answer


def _make(generator: Generator, plan: GeneratorJob, claimed: Sequence[Slot], slots: Slots, ledger: Ledger) -> None:
    images = generator.range_images(plan.seed, [slot.number for slot in claimed], **plan.sampling)
    for slot, image in zip(claimed, images, strict=True):
        ledger.publish(slot, slots.write(slot.place, slot.number, image))


def _watch_parent() -> None:
    """End with the parent. Its pipe alone does not tell: forked workers hold the other end, too."""
    parent = parent_process()
    assert parent is not None, "a generator process that nobody started"
    number = parent.pid if os.name == "posix" else os.getppid()
    while parent.is_alive() and os.getppid() == number:
        parent.join(WATCH)
    os._exit(0)


def _accept(listener: Listener, secret: bytes, ledger: Ledger) -> None:
    while True:
        with suppress(OSError, EOFError):
            Thread(target=_answer, args=(listener.accept(), secret, ledger), daemon=True).start()


def _answer(connection: Connection, secret: bytes, ledger: Ledger) -> None:
    """Serve one reader as long as it lives."""
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
