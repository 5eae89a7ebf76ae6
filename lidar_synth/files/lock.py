"""A lock on a file, which the system releases when its process ends or is killed.

Most commands write a folder alone (``one_writer``). Bakers that work in one folder hold
the lock together (``lock_shared``); only a process that holds it exclusively
(``try_lock``) removes leftover files. The lock is flock; over NFS, a lock on the
server. On a file system without locks nothing is ever removed. On Windows every process
counts as exclusive: an open file cannot be removed there.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

if sys.platform == "win32":

    def _lock(file: BinaryIO, alone: bool) -> bool:
        return True

    def _take(file: BinaryIO) -> bool:
        return True

    def _wait(file: BinaryIO, until_free: bool) -> None:
        pass

else:
    import fcntl

    def _lock(file: BinaryIO, alone: bool) -> bool:
        """Take the lock: shared after waiting, or exclusive (``try_lock``) without waiting; False
        if unavailable."""
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB if alone else fcntl.LOCK_SH)
            return True
        return False

    def _take(file: BinaryIO) -> bool:
        """Take the lock; False only if another process holds it, not where the file system has no
        locks."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            return not isinstance(error, BlockingIOError)
        return True

    def _wait(file: BinaryIO, until_free: bool) -> None:
        """Take the lock after waiting, or release it."""
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX if until_free else fcntl.LOCK_UN)


@contextmanager
def one_writer(path: Path) -> Iterator[bool]:
    """Make a file and lock it until the block ends; yields False if another process holds the lock.

    Raises:
        OSError: if the file cannot be made.
    """
    with path.open("ab") as file:
        yield _take(file)


@contextmanager
def lock_alone(path: Path) -> Iterator[None]:
    """Make a file and lock it until the block ends; wait while another process or thread holds the
    lock.

    Raises:
        OSError: if the file cannot be made.
    """
    with path.open("ab") as file:
        _wait(file, until_free=True)
        try:
            yield
        finally:  # not only by closing: a process that was forked meanwhile has the file open too
            _wait(file, until_free=False)


@contextmanager
def lock_shared(path: Path) -> Iterator[None]:
    """Hold a shared lock on a file; wait while another process holds it exclusively.

    Raises:
        OSError: if the file cannot be opened.
    """
    with path.open("rb") as file:
        _lock(file, alone=False)
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
        yield _lock(file, alone=True)
