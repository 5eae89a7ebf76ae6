"""A lock on a file that the system gives back when its process ends, however it ends.

Processes that work in one folder hold it together (``shared``); what they leave behind is cleared away only by one that
has it ``alone``. The system keeps it (flock; over NFS, a lock on the server). On a file system without locks nobody is
known to be alone. On Windows everybody counts as alone: a file that is open cannot be removed there.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

if sys.platform == "win32":

    def _lock(file: BinaryIO, alone: bool) -> bool:
        return True

else:
    import fcntl

    def _lock(file: BinaryIO, alone: bool) -> bool:
        """Take the lock: with the others, after waiting, or alone, at once or not at all."""
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB if alone else fcntl.LOCK_SH)
            return True
        return False


@contextmanager
def shared(path: Path) -> Iterator[None]:
    """Hold the lock on a file together with others; wait while one has it alone.

    Raises:
        OSError: where the file cannot be opened.
    """
    with path.open("rb") as file:
        _lock(file, alone=False)
        yield


@contextmanager
def alone(path: Path) -> Iterator[bool]:
    """Whether nobody else holds the lock on a file; if so, nobody gets it until the block ends."""
    try:
        file = path.open("r+b")  # NFS gives a lock to one alone only where the file may be written
    except OSError:
        yield False
        return
    with file:
        yield _lock(file, alone=True)
