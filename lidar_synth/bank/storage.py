"""Where the bytes of a bank come from: files on a disk, or URLs that fsspec knows. Only the asked ranges are read."""

import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from lidar_synth.errors import DataError, FileError, LibraryError

_WINDOW = 16 << 10  # bytes read around a place that the head of a file does not hold


class Storage(Protocol):
    """One file, of which ranges can be read.

    Attributes:
        size: bytes.
    """

    size: int

    def read(self, offset: int, size: int) -> bytes:
        """``size`` bytes from ``offset``, at least 0.

        Raises:
            FileError: where they cannot be read.
            DataError: where the file ends before.
        """
        ...

    def close(self) -> None: ...


class LocalFile:
    """A file on this machine; see ``Storage``.

    Raises:
        FileError: where it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._descriptor = path, -1
        try:
            self._descriptor = os.open(path, os.O_RDONLY)
            self.size = os.fstat(self._descriptor).st_size
        except OSError as error:
            raise self._unreadable(error) from error

    def read(self, offset: int, size: int) -> bytes:
        if offset + size > self.size:
            raise DataError(f"{self._path} ends before byte {offset + size}", "a whole file")
        try:
            content = os.pread(self._descriptor, size, offset)
        except OSError as error:
            raise self._unreadable(error) from error
        if len(content) != size:
            raise DataError(f"{self._path} was cut while it was read", "a whole file")
        return content

    def close(self) -> None:
        if self._descriptor >= 0:
            with suppress(OSError):
                os.close(self._descriptor)
        self._descriptor = -1

    __del__ = close

    def _unreadable(self, error: OSError) -> FileError:
        return FileError(f"{self._path} cannot be read ({error.strerror or error})", "a file of a bank")


class RemoteFile:
    """A file at a URL that fsspec knows; see ``Storage``. Each ``read`` is one request, and opening is none.

    Args:
        url: of the file.
        size: its bytes, which the bank's index tells.

    Raises:
        LibraryError: where fsspec, or what it needs for such a URL, is not installed.
        FileError: on a kind of URL that fsspec does not know.
    """

    def __init__(self, url: str, size: int = 0) -> None:
        self.url, self.size = url, size
        try:
            import fsspec

            self._system, self._path = fsspec.core.url_to_fs(url)
        except ImportError as error:
            raise LibraryError(
                f"{url} cannot be opened ({error})",
                "fsspec and its package for this kind of URL",
                "pip install 'lidar_synth[remote]' for http and https, s3fs for s3, gcsfs for gs.",
            ) from error
        except (OSError, ValueError) as error:
            raise FileError(f"{url} cannot be read ({error})", "a URL that fsspec knows") from error

    def read(self, offset: int, size: int) -> bytes:
        if offset + size > self.size:
            raise DataError(f"{self.url} ends before byte {offset + size}, by the bank's index", "a whole file")
        content = self._fetch(start=offset, end=offset + size)
        if len(content) != size:
            raise FileError(
                f"{self.url} gave {len(content)} bytes for a range of {size}",
                "the file that the bank's index describes, on a server that serves ranges",
                "Copy the bank to a disk, or serve it by another server.",
            )
        return content

    def read_all(self) -> bytes:
        """The whole file, whatever its size.

        Raises:
            FileError: where it cannot be read.
        """
        return self._fetch()

    def close(self) -> None:
        pass

    def _fetch(self, **span: int) -> bytes:
        try:
            return bytes(self._system.cat_file(self._path, **span))
        except Exception as error:  # every file system of fsspec has errors of its own
            reason = str(error) or type(error).__name__
            raise FileError(f"{self.url} cannot be read ({reason})", "a file of a bank") from error


class View(io.RawIOBase):
    """A stored file as HDF5 takes it: the head is read at once, other places with what stands around them.

    Args:
        file: to look at.
        head: bytes from its beginning that are expected to hold most of what will be asked for.
    """

    def __init__(self, file: Storage, head: int) -> None:
        self._file, self._head, self._position = file, min(head, file.size), 0
        self._spans: list[tuple[int, bytes]] = []

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._position = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._file.size}[whence]
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, as far as the file goes; raises as ``Storage.read``."""
        start, size = self._position, min(len(buffer), max(self._file.size - self._position, 0))
        buffer[:size] = self._bytes(start, size)
        self._position += size
        return size

    def _bytes(self, start: int, size: int) -> bytes:
        for first, content in self._spans:
            if first <= start and start + size <= first + len(content):
                return content[start - first : start - first + size]
        first, end = self._around(start, size)
        content = self._file.read(first, end - first)
        self._spans.append((first, content))
        return content[start - first : start - first + size]

    def _around(self, start: int, size: int) -> tuple[int, int]:
        """The range to read for one that is asked for."""
        if not self._spans:
            return 0, max(self._head, start + size)
        margin = max(_WINDOW - size, 0) // 2
        return max(start - margin, 0), min(start + size + margin, self._file.size)


def is_url(path: str | Path) -> bool:
    """Whether a path leads to another machine, by fsspec."""
    return isinstance(path, str) and "://" in path


def open_storage(root: str | Path, name: str, size: int) -> Storage:
    """A file in the folder of a bank, or at its URL.

    Args:
        root: the folder or the URL.
        name: of the file.
        size: its bytes, by the bank's index.

    Raises:
        FileError, LibraryError: where it cannot be opened.
    """
    return LocalFile(root / name) if isinstance(root, Path) else RemoteFile(f"{root.rstrip('/')}/{name}", size)
