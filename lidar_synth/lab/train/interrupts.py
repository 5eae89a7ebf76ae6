"""Ctrl-C and SIGTERM during a training, which saves its state first."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def first_signal() -> Iterator[list[int]]:
    """A list that gets the first SIGINT or SIGTERM of the block; later ones are handled as usual.

    Signals that the process ignores, as ``nohup`` makes it do with Ctrl-C, are still ignored. In
    other threads than the main one, the list stays empty.
    """
    received: list[int] = []
    before: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        restore()

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if handler is not signal.SIG_IGN:
                before[number] = handler
                signal.signal(number, receive)
    try:
        yield received
    finally:
        restore()
