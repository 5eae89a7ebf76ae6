"""Access to the bytes of a bank: files on a disk, or URLs that fsspec supports. Only requested
ranges are read.

At most 3 redirects are followed, to any host, but
never from https to http. No answer may be longer than what was asked for.
"""

import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from lidar_synth.bank.retries import PATIENCE, keep_trying
from lidar_synth.errors import DataError, FileError, LibraryError
from lidar_synth.files.disk import reading, refuse_special

SCHEMES = frozenset("http https s3 gs gcs az abfs abfss hf file memory".split())
"""Kinds of URLs that are opened; others of fsspec's lead to further files or run what they name."""

LONGEST_INDEX = 64 << 20
"""Maximum size of a bank's index at a URL in bytes; that of a million scans takes about 1 MB."""

_REDIRECTS = 3

_SYSTEMS: dict[int, Any] = {}
"""The file systems of fsspec that were used. A forked process would otherwise free those of its
parent, and with them the parent's connections, while these are in use."""


class _Opened:
    """An open file, closed when nothing refers to it any more: a thread may still read it when
    another one closes its ``LocalFile``."""

    def __init__(self, path: Path) -> None:
        refuse_special(path)
        self.descriptor = os.open(path, os.O_RDONLY)
        found = os.fstat(self.descriptor)
        self.state = found.st_size, found.st_mtime_ns, found.st_ino

    def __del__(self) -> None:
        with suppress(OSError, AttributeError):
            os.close(self.descriptor)


class LocalFile:
    """A file on this machine, with random access to byte ranges. A closed one is opened for each
    ``read``.

    Attributes:
        size: size of the file in bytes.
        window: number of bytes that take about as long to read as a single one.

    Raises:
        FileError: if it cannot be opened.
    """

    window = 1 << 20

    def __init__(self, path: Path) -> None:
        self._path = path
        opened = self._open()
        self._opened: _Opened | None = opened
        self._state = opened.state
        self.size = self._state[0]

    def reopen(self) -> bool:
        """Open it again if it was closed. False if it is not the file that it was: what was read of
        it may be wrong.

        Raises:
            FileError: if it cannot be opened.
        """
        if self._opened is None and (opened := self._open()).state == self._state:
            self._opened = opened
        return self._opened is not None

    def read(self, offset: int, size: int) -> bytes:
        """``size`` bytes from ``offset``, at least 0.

        Raises:
            FileError: if they cannot be read.
            DataError: if the file ends earlier.
        """
        if offset + size > self.size:
            raise DataError(
                f"{self._path} ends before byte {offset + size}", "a complete file"
            )
        opened = self._opened or self._open()
        if opened.state != self._state:
            raise DataError(f"{self._path} has changed", "the file that was opened")
        with reading(self._path, "a file of a bank"):
            if hasattr(os, "pread"):
                content = os.pread(opened.descriptor, size, offset)
            else:  # on Windows, where no other file can take the place of an open one
                with self._path.open("rb") as file:
                    file.seek(offset)
                    content = file.read(size)
        if len(content) != size:
            raise DataError(
                f"{self._path} was truncated while it was read", "a complete file"
            )
        return content

    def close(self) -> None:
        self._opened = None

    def _open(self) -> _Opened:
        with reading(self._path, "a file of a bank"):
            return _Opened(self._path)


class RemoteFile:
    """A file at a URL that fsspec supports; see ``LocalFile``. Each ``read`` is one request;
    opening needs none.

    Args:
        url: URL of the file.
        size: size in bytes, from the bank's index.

    Raises:
        LibraryError: if fsspec, or its package for such a URL, is not installed.
        FileError: on a kind of URL that is not among ``SCHEMES``, or that fsspec does not support.
    """

    window = 12 << 10

    def __init__(self, url: str, size: int = 0) -> None:
        self.url = url
        self.size = size
        self._system, self._path = open_system(url)

    def read(self, offset: int, size: int) -> bytes:
        if offset + size > self.size:
            raise DataError(
                f"{self.url} ends before byte {offset + size}",
                "the size in the bank's index",
            )
        content = self._fetch(offset, offset + size) if size else b""
        if len(content) != size:
            raise FileError(
                f"{self.url} gave {len(content)} bytes for a range of {size}",
                "the file that the bank's index describes, on a server that serves ranges",
                "Copy the bank to a disk, or serve it by another server.",
            )
        return content

    def read_all(self, at_most: int = LONGEST_INDEX) -> bytes:
        """The complete file.

        Raises:
            FileError: if it cannot be read.
            DataError: if it is longer than ``at_most`` bytes.
        """
        content = self._fetch(0, None, at_most)
        if len(content) > at_most:
            raise DataError(
                f"{self.url} is longer than {at_most} bytes", "the index of a bank"
            )
        return content

    def close(self) -> None:
        pass

    def reopen(self) -> bool:
        return True

    def _fetch(self, start: int, end: int | None, at_most: int = 0) -> bytes:
        """The bytes of a request; a few more than asked for may come."""
        most = at_most if end is None else end - start
        return keep_trying(self.url, "read", lambda: self._request(start, end, most))

    def _request(self, start: int, end: int | None, at_most: int) -> bytes:
        if self.url.startswith("http"):
            from fsspec.asyn import sync

            content: bytes = sync(self._system.loop, self._get, start, end, at_most)
            return content
        # The hub's file system reads ahead by 5 MB otherwise.
        more = {"cache_type": "none"} if self.url.startswith("hf:") else {}
        end = end or at_most + 1
        return bytes(self._system.cat_file(self._path, start=start, end=end, **more))

    async def _get(self, start: int, end: int | None, at_most: int) -> bytes:
        """One byte more than ``at_most`` at most; fsspec itself would read an answer of any
        length."""
        from aiohttp import ClientTimeout

        session = await self._system.set_session()
        headers = {} if end is None else {"Range": f"bytes={start}-{end - 1}"}
        timeout = ClientTimeout(
            total=4 * PATIENCE, sock_connect=PATIENCE, sock_read=PATIENCE
        )
        asked = session.get(
            self.url, headers=headers, timeout=timeout, max_redirects=_REDIRECTS
        )
        async with asked as answer:
            if self.url.startswith("https") and any(
                r.url.scheme != "https" for r in (*answer.history, answer)
            ):
                raise PermissionError("it redirects from https to http")
            answer.raise_for_status()
            parts: list[bytes] = []
            left = at_most + 1
            while left and (part := await answer.content.read(left)):
                parts.append(part)
                left -= len(part)
        return b"".join(parts)


Storage = LocalFile | RemoteFile


def open_system(url: str) -> tuple[Any, str]:
    """The file system of fsspec for a URL, and the path there; raises as ``RemoteFile``."""
    scheme = url.partition("://")[0]
    if scheme not in SCHEMES:  # a chain such as zip::http is not among them either
        raise FileError(
            f"{url} with scheme {scheme!r}", f"one of {', '.join(sorted(SCHEMES))}"
        )
    try:
        import fsspec

        options: dict[str, Any] = {}
        if scheme == "file":
            options["auto_mkdir"] = True
        if scheme in ("http", "https"):
            kind = fsspec.get_filesystem_class(scheme)
            configured = fsspec.config.apply_config(kind, {}).get("client_kwargs", {})
            # With the proxies that the environment names.
            options["client_kwargs"] = {"trust_env": True} | configured
        system, path = fsspec.core.url_to_fs(url, **options)
        _SYSTEMS[id(system)] = system
    except ImportError as error:
        raise LibraryError(
            f"{url} cannot be opened ({error})",
            "fsspec and its package for this kind of URL",
            "pip install 'lidar_synth[remote]' for http and https, s3fs for s3, gcsfs for gs.",
        ) from error
    except (OSError, ValueError) as error:
        raise FileError(
            f"{url} cannot be read ({error})", "a URL that fsspec supports"
        ) from error
    return system, path


class RangedFile(io.RawIOBase):
    """A file object for HDF5 over the parts of a file that have been read so far.

    HDF5 holds a lock while it reads. Fetching from a URL uses other threads, and one of them that
    happens to free an object of HDF5 would wait for that lock: a deadlock. So ``readinto`` never
    fetches: it records the missing range and fails; the caller of HDF5 then calls ``fetch_missing``
    and tries again.

    Args:
        file: the file to read from.
        head: number of bytes to read at once from its beginning.

    Attributes:
        missing: (offset, size) of the requested range that has not been read; None if there is
            none.

    Raises:
        FileError, DataError: as ``LocalFile.read``.
    """

    def __init__(self, file: Storage, head: int) -> None:
        self._file = file
        self._position = 0
        self._spans: list[tuple[int, bytes]] = []
        self.missing: tuple[int, int] | None = None
        self._fetch(0, head)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        # SEEK_SET, SEEK_CUR and SEEK_END are 0, 1 and 2.
        self._position = offset + (0, self._position, self._file.size)[whence]
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, up to the end of the file.

        Raises:
            OSError: if these bytes have not been read yet.
        """
        start = self._position
        size = min(len(buffer), max(self._file.size - start, 0))
        for first, content in self._spans:
            if first <= start and start + size <= first + len(content):
                offset = start - first
                buffer[:size] = memoryview(content)[offset : offset + size]
                break
        else:
            if size:
                self.missing = (start, size)
                raise OSError(f"bytes {start} to {start + size} have not been read yet")
        self._position += size
        return size

    def fetch_missing(self) -> None:
        """Read the missing range and its surroundings; raises as the class."""
        if self.missing is not None:
            start, size = self.missing
            margin = max(self._file.window - size, 0) // 2
            self._fetch(max(start - margin, 0), start + size + margin)
        self.missing = None

    def _fetch(self, start: int, end: int) -> None:
        self._spans.append(
            (start, self._file.read(start, min(end, self._file.size) - start))
        )


def is_url(path: str | Path) -> bool:
    """Whether a path is a URL, which fsspec opens."""
    return isinstance(path, str) and "://" in path


def settle_path(path: str | Path) -> str:
    """The path of a bank or a dataset from any folder, or its URL."""
    return str(path if is_url(path) else Path(path).resolve())


def bank_root(root: str | Path) -> str | Path:
    """The place of a bank: a URL without a slash at its end, or the path of a folder."""
    return str(root).rstrip("/") if is_url(root) else Path(root)


def open_storage(root: str | Path, name: str, size: int) -> Storage:
    """Open a file of a bank, in its folder or at its URL.

    Args:
        root: the folder or the URL.
        name: name of the file.
        size: size in bytes, from the bank's index.

    Raises:
        FileError, LibraryError: if it cannot be opened.
    """
    if isinstance(root, Path):
        return LocalFile(root / name)
    return RemoteFile(f"{root}/{name}", size)
