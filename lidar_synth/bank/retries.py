"""Requests to a server, repeated while their failure may pass.

A failed request is repeated three times with growing waits, but not once 30 seconds are over; a
server that is silent for 30 seconds has failed.
"""

import time
from collections.abc import Callable
from typing import TypeVar

from lidar_synth.errors import FileError

T = TypeVar("T")

WAITS = (0.1, 0.5, 2.0)
"""Seconds before a failed request is repeated."""

PATIENCE = 30.0
"""Seconds in which a server has to connect, and to send the next bytes."""

_TEMPORARY = frozenset((408, 425, 429, 500, 502, 503, 504))
"""HTTP's statuses of failures that may pass."""


def keep_trying(url: str, what: str, request: Callable[[], T]) -> T:
    """The result of a request, which is repeated while its failure may pass.

    Args:
        url: URL of the file.
        what: "read", "written" or "listed", for the error.
        request: makes the request.

    Raises:
        FileError: if it fails in the end.
    """
    began = time.monotonic()
    for wait in (*WAITS, None):
        try:
            return request()
        except Exception as error:  # each file system of fsspec raises its own classes
            late = time.monotonic() - began > PATIENCE
            if wait is None or late or not _may_pass(error):
                reason = str(error) or type(error).__name__
                raise FileError(
                    f"{url} cannot be {what} ({reason})", f"a URL that can be {what}"
                ) from error
        time.sleep(wait)
    raise AssertionError


def _may_pass(error: Exception) -> bool:
    """Whether a request may succeed when it is repeated."""
    status = getattr(error, "status", None)
    if isinstance(status, int) and status:
        return status in _TEMPORARY
    final = FileNotFoundError, FileExistsError, PermissionError, ValueError
    return not isinstance(error, (*final, NotImplementedError))
