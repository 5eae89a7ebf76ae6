"""The runner of hostile cases sees every way in which a process can fail."""

import os
import time

from limits import in_limits, needs_limits


def fine() -> None:
    bytearray(100 << 20)


def greedy() -> None:
    bytearray(700 << 20)


def endless() -> None:
    time.sleep(600)


def ended() -> None:
    os.abort()


@needs_limits
def test_every_end_of_a_process_is_told() -> None:
    assert in_limits(fine) == ""
    assert in_limits(greedy) == "MemoryError: "
    assert in_limits(ended) == "its process ended with -6"
    assert (
        in_limits(int, "x") == "ValueError: invalid literal for int() with base 10: 'x'"
    )
    assert in_limits(endless, seconds=0.1) == "still running after 0.1 s"
