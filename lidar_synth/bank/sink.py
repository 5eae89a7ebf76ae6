"""The file that HDF5 writes a shard to; HDF5 never sees an error of the disk.

HDF5 can end the process when it fails to write its metadata, for instance on closing a file on a full disk. Here the
first error is kept for the caller, and all later writes are dropped, so that HDF5 always closes cleanly.
"""

import io
import os
from contextlib import suppress
from pathlib import Path


class Sink(io.RawIOBase):
    """A new binary file for h5py's driver for Python file objects.

    Args:
        path: of the file; it is overwritten.

    Attributes:
        error: the first error of the disk; None = everything was written.

    Raises:
        OSError: if the file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
        self._place = self._size = 0

    def check(self) -> None:
        """Raise the first error of the disk."""
        if self.error is not None:
            raise self.error

    def sync(self) -> None:
        """Wait until the file is on the disk.

        Raises:
            OSError: the first error of the disk.
        """
        self.check()
        os.fsync(self._descriptor)

    def write(self, data: "memoryview | bytes") -> int:  # type: ignore[override]
        view = memoryview(data).cast("B")
        written = 0
        while written < len(view) and self.error is None:
            try:
                written += os.pwrite(self._descriptor, view[written:], self._place + written)
            except OSError as error:
                self.error = error
        self._place += len(view)
        self._size = max(self._size, self._place)
        return len(view)

    def readinto(self, buffer: "memoryview | bytearray") -> int:  # type: ignore[override]
        view = memoryview(buffer).cast("B")
        found = os.pread(self._descriptor, len(view), self._place)
        # After an error, dropped writes read as zeros.
        view[: len(found)] = found
        view[len(found) :] = bytes(len(view) - len(found))
        self._place += len(view)
        return len(view)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def truncate(self, size: int | None = None) -> int:
        self._size = self._place if size is None else size
        if self.error is None:
            try:
                os.ftruncate(self._descriptor, self._size)
            except OSError as error:
                self.error = error
        return self._size

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        """Close the file; h5py leaves that to its caller."""
        if not self.closed:
            with suppress(OSError):
                os.close(self._descriptor)
        super().close()
