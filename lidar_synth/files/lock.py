"""A lock on a file, which the system releases when its process ends or is killed.

Most commands write a folder alone (``one_writer``). Bakers that work in one folder hold
the lock together (``lock_shared``); only a process that holds it exclusively
(``try_lock``) removes leftover files. The lock is flock; over NFS, a lock on the
server. On a file system without locks nothing is ever removed. On Windows every process
counts as exclusive: an open file cannot be removed there.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

if sys.platform == "win32":
    LOCK_SH = LOCK_EX = LOCK_NB = LOCK_UN = 0

    def flock(file: BinaryIO, how: int) -> None:
        """Windows has no flock."""

else:
    from fcntl import LOCK_EX, LOCK_NB, LOCK_SH, LOCK_UN, flock


def _flock(file: BinaryIO, how: int, unsupported: bool = False) -> bool:
    """Take or release the lock; False if it is not available, ``unsupported`` where the file
    system has no locks."""
    try:
        flock(file, how)
    except OSError as error:
        return unsupported and not isinstance(error, BlockingIOError)
    return True


@contextmanager
def one_writer(path: Path) -> Iterator[bool]:
    """Make a file and lock it until the block ends; yields False if another process holds the lock.

    Raises:
        OSError: if the file cannot be made.
    """
    with path.open("ab") as file:
        yield _flock(file, LOCK_EX | LOCK_NB, unsupported=True)


@contextmanager
def lock_alone(path: Path) -> Iterator[None]:
    """Make a file and lock it until the block ends; wait while another process or thread holds the
    lock.

    Raises:
        OSError: if the file cannot be made.
    """
    with path.open("ab") as file:
        _flock(file, LOCK_EX)
        try:
            yield
        finally:  # not only by closing: a process that was forked meanwhile has the file open too
            _flock(file, LOCK_UN)


@contextmanager
def lock_shared(path: Path) -> Iterator[None]:
    """Hold a shared lock on a file; wait while another process holds it exclusively.

    Raises:
        OSError: if the file cannot be opened.
    """
    with path.open("rb") as file:
        _flock(file, LOCK_SH)
        yield


@contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """Try to hold an exclusive lock on a file until the block ends; yields whether it was
    available."""
    try:
        file = path.open("r+b")  # NFS grants exclusive locks only on writable files
    except OSError:
        yield False
        return
    with file:
        yield _flock(file, LOCK_EX | LOCK_NB)
