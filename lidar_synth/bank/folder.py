"""The files of a bank that are written or read as a whole, in a folder or at a URL.

A file at a URL is made in the system's folder for temporary files (TMPDIR), then uploaded
with one request, so that it is there completely or not at all. Its size is then compared; S3
compares its SHA-256 as well.
"""

import base64
import hashlib
import tempfile
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from lidar_synth.bank.facts import REPAIR
from lidar_synth.bank.index import Entry
from lidar_synth.bank.retries import keep_trying
from lidar_synth.bank.storage import (
    RemoteFile,
    bank_root,
    open_system,
)
from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import (
    part_of,
    read_file,
    reading,
    sha256,
    sync_folder,
    write_file,
    writing,
)

BLOCK = 4 << 20
"""Bytes of a request for a part of a file that is copied."""

_AT_ONCE = 8  # requests at a time

_LARGEST = 4 << 30  # bytes that S3 takes with one request, with room for its 5 GB


class LocalFolder:
    """A bank's files in a folder on a disk; names are relative, with / as separator.

    Raises:
        FileError: by every method, if a file cannot be read or written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def sizes(self) -> dict[str, int]:
        """The sizes of the files, by name; hidden files are left out."""
        with reading(self.root, "the folder of a bank"):
            files = [path for path in self.root.glob("[!.]*") if path.is_file()]
            return {path.name: path.stat().st_size for path in files}

    def read(self, name: str) -> bytes:
        return read_file(self.root / name, "a file of a bank")

    def write(self, name: str, content: bytes, overwrite: bool = True) -> None:
        """Write a file. Without ``overwrite``, the first of several processes wins, where the
        store can tell."""
        write_file(self.root / name, content, durable=True, overwrite=overwrite)
        sync_folder(self.root)

    def put(self, path: Path, name: str) -> None:
        """Move a file that ``making`` gave to its final name."""
        with writing(self.root / name):
            path.replace(self.root / name)
        sync_folder(self.root)

    @contextmanager
    def making(self, name: str) -> Iterator[Path]:
        """A path for a file that is being made; removed after the block."""
        part = part_of(self.root / name)
        try:
            yield part
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)

    @contextmanager
    def local(self, name: str, size: int) -> Iterator[Path]:
        """A path on this machine with a file's bytes; a copy of one at a URL is removed after
        the block."""
        yield self.root / name


class RemoteFolder:
    """A bank's files below a URL; see ``LocalFolder``. Raises as ``RemoteFile``."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._system, self._path = open_system(url)

    def sizes(self) -> dict[str, int]:
        def find() -> dict[str, Any]:
            self._system.invalidate_cache()
            with suppress(FileNotFoundError):
                return dict(self._system.find(self._path, detail=True))
            return {}

        start = len(self._path.rstrip("/")) + 1
        found = keep_trying(self.url, "listed", find)
        return {name[start:]: of["size"] for name, of in found.items()}

    def read(self, name: str) -> bytes:
        return RemoteFile(f"{self.url}/{name}").read_all()

    def write(self, name: str, content: bytes, overwrite: bool = True) -> None:
        path = f"{self._path}/{name}"
        mode = "overwrite" if overwrite else "create"

        def send() -> None:
            with suppress(FileExistsError):
                self._system.pipe_file(path, content, mode=mode)

        keep_trying(f"{self.url}/{name}", "written", send)

    def put(self, path: Path, name: str) -> None:
        size = path.stat().st_size
        options: dict[str, Any] = {}
        if self.url.startswith("s3://") and size < _LARGEST:
            digest = base64.b64encode(bytes.fromhex(sha256(path))).decode()
            options = {
                "chunksize": _LARGEST,
                "ChecksumAlgorithm": "SHA256",
                "ChecksumSHA256": digest,
            }

        def send() -> None:
            self._system.put_file(str(path), f"{self._path}/{name}", **options)

        keep_trying(f"{self.url}/{name}", "written", send)
        found = self._size(name)
        if found != size:
            raise FileError(
                f"{self.url}/{name} has {found} bytes after {size} were uploaded",
                "a store that keeps what it is given",
                "Run the same command again.",
            )
        path.unlink()

    @contextmanager
    def making(self, name: str) -> Iterator[Path]:
        with (
            writing(Path(tempfile.gettempdir())),
            tempfile.TemporaryDirectory(prefix="lidar_synth-") as folder,
        ):
            yield part_of(Path(folder, Path(name).name))

    @contextmanager
    def local(self, name: str, size: int) -> Iterator[Path]:
        with self.making(name) as path:
            found = self._size(name)
            size = size if found is None else found
            list(copy_files([(RemoteFile(f"{self.url}/{name}", size), path)]))
            yield path

    def remove(self, names: list[str]) -> None:
        paths = [f"{self._path}/{name}" for name in names]
        if not paths:
            return

        def send() -> None:
            with suppress(FileNotFoundError):  # another process was faster
                self._system.rm(paths)

        keep_trying(self.url, "written", send)

    def _size(self, name: str) -> int | None:
        """The size of a file; None if the server does not say."""
        found = keep_trying(
            f"{self.url}/{name}",
            "read",
            lambda: self._system.info(f"{self._path}/{name}"),
        )
        size = found["size"]
        return None if size is None else int(size)


BankFolder = LocalFolder | RemoteFolder


def open_folder(root: str | Path) -> BankFolder:
    """The files of a bank in a folder or at a URL; raises as ``RemoteFile``."""
    place = bank_root(root)
    return RemoteFolder(place) if isinstance(place, str) else LocalFolder(place)


def check_copy(url: str, digest: str, entry: Entry) -> None:
    """Refuse the copy of a shard whose bytes are not those of the index.

    Raises:
        DataError: naming its URL.
    """
    if digest != entry.sha256:
        raise DataError(
            f"{url} has sha256 {digest[:12]}",
            f"{entry.sha256[:12]}, by the bank's index",
            REPAIR,
        )


def copy_shard(root: str, entry: Entry, path: Path) -> None:
    """Copy a shard of a bank at a URL to a path, and check it.

    Raises:
        FileError: if it cannot be read, or the path not written.
        DataError: if it is not the shard of the index.
    """
    url = f"{root}/{entry.file}"
    [digest] = copy_files([(RemoteFile(url, entry.bytes), path)])
    check_copy(url, digest, entry)


def copy_files(
    copies: Iterable[tuple[RemoteFile, Path]],
) -> Generator[str, None, None]:
    """Copy files at URLs to paths, one after the other, by several requests at a time.

    Args:
        copies: the files and paths; the next one is taken as soon as all bytes of the one before
            have been requested.

    Yields:
        The SHA-256 of each, once it has been written.

    Raises:
        FileError: if a file cannot be read, or its path not written.
    """
    for (_, path), blocks in groupby(_requested(copies), itemgetter(0)):
        yield _write_blocks(path, (block.result() for _, block in blocks))


def _write_blocks(path: Path, blocks: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    with writing(path):
        path.touch()
        with path.open("r+b") as out:  # its size stays what was reserved for it
            for block in blocks:
                digest.update(block)
                out.write(block)
            out.truncate()
    return digest.hexdigest()


def _requested(
    copies: Iterable[tuple[RemoteFile, Path]],
) -> Iterator[tuple[tuple[RemoteFile, Path], Future[bytes]]]:
    """The blocks of files in order; the next ones are requested meanwhile, also those of the next
    file, so that the time until an answer begins costs no transfer."""
    waiting: deque[tuple[tuple[RemoteFile, Path], Future[bytes]]] = deque()
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for copy in copies:
            file = copy[0]
            for start in range(0, max(file.size, 1), BLOCK):
                size = min(BLOCK, file.size - start)
                waiting.append((copy, pool.submit(file.read, start, size)))
                if len(waiting) > _AT_ONCE:
                    yield waiting.popleft()
        yield from waiting
