"""Copies of a bank's shards on this machine, for a bank at a URL.

A copy is a whole shard, named by its SHA-256, which is checked. One process at a time decides what
is copied and makes a file of the copy's size, which is locked until it is complete, so that all
processes of a machine together fetch each shard once, and the limit holds.

What a process and its workers read next, ``MixedScans`` announces for each epoch as a plan (see
``plans``). Copies behind all plans make room for what is planned, the one that was read last first:
plans that go through a bank in the same order come back to it last. A shard that is read now also
takes the place of one that is not needed until it is done. Where there is no room, or only for a
shard of which most scans are not planned, scans are read one by one from the URL.
"""

import os
import re
import shutil
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import chain, takewhile
from math import inf
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.bank.folder import LocalFolder, check_copy, copy_files
from lidar_synth.bank.index import Entry, Index
from lidar_synth.bank.plans import Use, needed, published, uses_of
from lidar_synth.bank.storage import LocalFile, RemoteFile, Storage
from lidar_synth.errors import ConfigError, FileError, LidarSynthError
from lidar_synth.files.disk import remove_file, writing
from lidar_synth.files.lock import lock_alone, one_writer

_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
_PAUSE = 0.2  # seconds until a plan looks for room again


class ShardCache:
    """The copies of a bank's shards in a folder.

    Args:
        folder: the folder; it is made.
        limit: most bytes of all copies in it, see ``read_size``; None = no limit.
        url: URL of the bank.
        index: its index.

    Raises:
        ConfigError: if a shard is larger than the limit.
        FileError: if the folder cannot be written, or its disk has no room.
    """

    def __init__(
        self, folder: Path, limit: int | str | None, url: str, index: Index
    ) -> None:
        self.folder = folder
        self.url = url
        self.index = index
        self._limit = inf if limit is None else read_size(limit)
        self._table = folder / f"{index.checksum[:16]}.times"
        self._plan: _Plan | None = None
        copies = [self._path(entry).name for entry in index.shards]
        self._numbers = {name: number for number, name in enumerate(copies)}
        largest = max(entry.bytes for entry in index.shards)
        if self._limit < largest:
            raise ConfigError(
                f"limit={limit!r} for a bank with a shard of {largest / 1e6:.3g} MB",
                "room for several of its shards",
            )
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with self._table.open("ab") as file:
                file.truncate(8 * len(index.shards))
            self._times = self._open_table()
            self._check_space()

    def open(self, number: int) -> Storage:
        """Open the copy of a shard, which is fetched if there is room, or else its original.

        Raises:
            FileError: if it cannot be fetched or written.
            DataError: if it is not the shard of the index.
        """
        entry = self.index.shards[number]
        self.fetch([number], now=True)
        with suppress(FileError):  # there is no copy, or another process has dropped it
            return _Copy(self._path(entry))
        return _Original(self._url(entry), entry.bytes, self._path(entry))

    def note(self, number: int) -> None:
        """Note that a shard is read now."""
        self._times[number] = time.time_ns()

    def expect(self, numbers: Sequence[int]) -> None:
        """Announce the scans that this process and its workers will read next, in order. Their
        shards are fetched ahead from the first read on; before, another call may correct it.

        Raises:
            FileError: if the folder cannot be written.
        """
        self.close()
        shards = np.searchsorted(self.index.ends, numbers, side="right")
        with writing(self.folder):
            self._plan = _Plan(self, shards)
        self._plan.start()

    def fetch(self, numbers: Iterable[int], now: bool = False) -> int | None:
        """Copy shards in order, unless there is a copy, or no room, or another process copies; the
        next one is requested before one ends. Raises as ``open``.

        Args:
            numbers: numbers of the shards.
            now: whether they are read now; then it waits while another process copies.

        Returns:
            The first one that is planned, with most of its scans, and has no room yet, up to which
            they were copied; None if there is none.
        """
        claims: deque[_Claim] = deque()
        late: list[int] = []

        def copies() -> Iterator[tuple[RemoteFile, Path]]:
            for number in numbers:
                try:
                    claim = self._claim(self.index.shards[number], now)
                except _NoRoomYet:
                    late.append(number)
                    return
                if claim is not None:
                    claims.append(claim)
                    yield (
                        RemoteFile(self._url(claim.entry), claim.entry.bytes),
                        claim.part,
                    )

        try:
            with closing(copy_files(copies())) as digests:
                for digest in digests:
                    self._keep(claims[0], digest)
                    claims.popleft().held.close()
        finally:
            for claim in claims:
                claim.held.close()
        return late[0] if late else None

    def close(self) -> None:
        """End the plan of this process."""
        if self._plan is not None and self._plan.is_alive():  # not in a forked process
            self._plan.ended.set()

    def clear(self) -> None:
        """Remove the copies of this bank, and the folder if nothing else is in it.

        Raises:
            FileError: if a file cannot be removed.
        """
        self.close()
        if self._plan is not None:
            self._plan.join()
        with self._alone():
            self._parts()
            needed(self.folder)  # removes plans of dead processes
            for path in (*map(self._path, self.index.shards), self._table):
                remove_file(path)
            if {path.name for path in self.folder.iterdir()} == {"lock"}:
                remove_file(self.folder / "lock")
        with suppress(OSError):
            self.folder.rmdir()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_plan": None, "_times": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        with writing(self.folder):
            self._times = self._open_table()

    def _open_table(self) -> NDArray[np.int64]:
        """When each shard was last read, in ns; shared by all processes. It is not opened later,
        by a thread: a process that is forked meanwhile would wait for that thread."""
        return np.memmap(self._table, np.int64, "r+")

    def _url(self, entry: Entry) -> str:
        return f"{self.url}/{entry.file}"

    def _path(self, entry: Entry) -> Path:
        return self.folder / f"{entry.sha256}.h5"

    def _has(self, entry: Entry) -> bool:
        return _size(self._path(entry)) == entry.bytes

    def _check_space(self) -> None:
        held = sum(entry.bytes for entry in self.index.shards if self._has(entry))
        need = min(self._limit, self.index.size) - held
        free = shutil.disk_usage(self.folder).free
        if free < need:
            raise FileError(
                f"{self.folder} has {free / 1e9:.3g} GB free",
                f"{need / 1e9:.3g} GB for copies of {self.url}",
                "Free some space, or give a smaller limit.",
            )

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with ExitStack() as held:
            with writing(self.folder):
                held.enter_context(lock_alone(self.folder / "lock"))
            yield

    def _claim(self, entry: Entry, now: bool) -> "_Claim | None":
        """A place for a copy of a shard, as many bytes, if there is to be one; see ``fetch``."""
        name = self._path(entry).name
        while not self._has(entry):
            with self._alone():
                parts = self._parts()
                busy = any(part.name.startswith(f".{name}.") for part in parts)
                if not busy and not self._has(entry):
                    return self._reserve(entry, now, parts)
            if not now:
                break
            time.sleep(_PAUSE / 20)
        return None

    def _reserve(self, entry: Entry, now: bool, parts: list[Path]) -> "_Claim | None":
        name = self._path(entry).name
        planned = needed(self.folder)
        use = planned.get(name)
        if use is None or 2 * use.scans < entry.kept:
            use = None  # the shard is not worth what it would displace
        spare = self._spare(planned, use, now) if use else []
        if not self._make_room(entry.bytes, spare, parts):
            if use:
                raise _NoRoomYet
            return None
        with ExitStack() as held:
            part = held.enter_context(LocalFolder(self.folder).making(name))
            with writing(part):
                held.enter_context(one_writer(part))
                os.truncate(part, entry.bytes)
            return _Claim(entry, part, held.pop_all())

    def _keep(self, claim: "_Claim", digest: str) -> None:
        """Check a copy, and give it its name."""
        check_copy(self._url(claim.entry), digest, claim.entry)
        with self._alone():
            LocalFolder(self.folder).put(claim.part, self._path(claim.entry).name)

    def _parts(self) -> list[Path]:
        """The copies that are being made; what killed processes left is removed."""
        parts = []
        for part in self.folder.glob(".*.part"):
            with one_writer(part) as dead:
                if dead:
                    remove_file(part)
                else:
                    parts.append(part)
        return parts

    def _spare(self, planned: dict[str, Use], use: Use, now: bool) -> list[str]:
        """The copies that may be dropped for a planned shard, in this order: those that are not
        needed; for one that is read now also those that are not needed until it is done."""
        held = [path.name for path in self.folder.glob("*.h5")]
        spare = sorted((n for n in held if n not in planned), key=self._last_read)
        if now:
            later = [n for n in held if n in planned and planned[n].first > use.last]
            spare += sorted(later, key=lambda name: -planned[name].first)
        return spare

    def _make_room(self, size: int, spare: list[str], parts: list[Path]) -> bool:
        """Drop copies until there is room for one more, beside those that are being made."""
        held = (*self.folder.glob("*.h5"), *parts)
        sizes = {path.name: _size(path) for path in held}
        room = self._limit - sum(sizes.values()) - size
        for name in spare:
            if room >= 0:
                break
            remove_file(self.folder / name)
            room += sizes[name]
        return room >= 0

    def _last_read(self, name: str) -> float:
        """A key by which copies come first that belong to no shard of this bank, then those that
        were read last."""
        number = self._numbers.get(name)
        return -inf if number is None else -float(self._times[number])


class _Claim(NamedTuple):
    """A copy that this process makes: its file, which is locked and removed by ``held``."""

    entry: Entry
    part: Path
    held: ExitStack


class _NoRoomYet(Exception):
    """Copies that are needed before a planned one take all the room."""


class _Plan(Thread):
    """The shards that a process and its workers read next, published until ``ended``; a thread
    fetches them ahead.

    Args:
        cache: the cache.
        shards: (N,) the shard of each scan, in order.

    Raises:
        OSError: if it cannot be published.
    """

    def __init__(self, cache: ShardCache, shards: NDArray[np.intp]) -> None:
        super().__init__(daemon=True)
        self.ended = Event()
        self._cache = cache
        self._since = time.time_ns()
        uses = uses_of(shards)
        self._order = list(uses)
        names = [cache._path(cache.index.shards[n]).name for n in uses]
        self._held = ExitStack()
        self._held.enter_context(
            published(cache.folder, cache._table.name, self._since, names, uses)
        )

    def run(self) -> None:
        with self._held:
            # Whoever reads a shard that cannot be fetched meets the same error.
            with suppress(LidarSynthError, RuntimeError):
                self._fetch_ahead()
            self.ended.wait()

    def _fetch_ahead(self) -> None:
        while self._cache._times.max() < self._since:
            if self.ended.wait(_PAUSE / 10):
                return
        order = takewhile(lambda _: not self.ended.is_set(), self._order)
        late = self._cache.fetch(order)
        while late is not None and not self.ended.wait(_PAUSE):
            late = self._cache.fetch(chain([late], order))


class _Copy(LocalFile):
    """A copy of a shard."""

    def reopen(self) -> bool:
        with suppress(FileError):  # it has been dropped
            return super().reopen()
        return False


class _Original(RemoteFile):
    """A shard at a URL, until there is a copy."""

    def __init__(self, url: str, size: int, copy: Path) -> None:
        super().__init__(url, size)
        self._copy = copy

    def reopen(self) -> bool:
        return not self._copy.exists()


def read_size(given: int | str) -> int:
    """A number of bytes: ``"200GB"``, ``"1.5 TB"``, or a whole number.

    Raises:
        ConfigError: on anything else.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kMGT]?)B", str(given))
    if isinstance(given, int) and not isinstance(given, bool) and given > 0:
        return given
    if match is None:
        raise ConfigError(f"limit={given!r}", 'a size such as "200GB", or bytes')
    return int(float(match[1]) * _UNITS[match[2]])


def _size(path: Path) -> int:
    """The size of a file; 0 if there is none."""
    with suppress(OSError):
        return path.stat().st_size
    return 0
