"""A bank as a source of scans."""

import os
import warnings
import weakref
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

from lidar_synth.bank.cache import ShardCache
from lidar_synth.bank.facts import FORMAT, REPAIR, Facts
from lidar_synth.bank.index import INDEX, SETTINGS, Index
from lidar_synth.bank.shard import ShardReader
from lidar_synth.bank.storage import RemoteFile, bank_root, open_storage
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import read_start
from lidar_synth.geometry import (
    REAL,
    SYNTHETIC,
    RangeImage,
    Scan,
    Sensor,
    index_of,
    model_provenance,
)
from lidar_synth.geometry.projection import unproject

_OPEN = 64  # files kept open at a time
_KNOWN = 1 << 20  # scans whose places are kept in memory, about 60 bytes each
_LEAST = 128  # a shard takes as much memory as one of so many scans at least


class Bank:
    """The scans of a bank, read from disk on access.

    Each process opens a shard when it first needs it, so that a bank can be passed to workers,
    forked or spawned.

    Args:
        root: the bank's folder, or a URL that fsspec supports ("s3://bucket/bank").
        cache: a folder on this machine for copies of the shards of a bank at a URL, which all
            processes share. In a mixture they are fetched ahead in the order of the plan.
        limit: the most bytes of the copies, such as "200GB"; by default all shards are kept.

    Attributes:
        index: the list of shards and sources.
        sensor: the sensor that defines the grid of the range images.
        fields: the fields that a scan has besides its points.
        identity: the checksum of the index, different for every bank.

    A bank without reflectance is opened with a warning.

    Raises:
        FileError: if there is no bank, a shard is missing, or a file cannot be read.
        DataError: on an index that is damaged or of another version, or a shard of another size.
        ConfigError: on a cache for a bank in a folder, or a limit below the size of a shard.
        LibraryError: on a URL whose file system is not installed.

    Example:
        >>> from lidar_synth import Bank
        >>> bank = Bank("demo_out/bank")
        >>> bank[0].id, sorted(bank.fields)
        ('town/1/0', ['confidence', 'label', 'reflectance'])
        >>> bank.image(0).range.shape
        (64, 2048)
    """

    def __init__(
        self,
        root: str | Path,
        cache: str | Path | None = None,
        limit: int | str | None = None,
    ) -> None:
        self.root = _settle(bank_root(root))
        self.index = read_index(self.root)
        if isinstance(self.root, Path):
            self._check_files(self.root)
        largest = max((entry.scans for entry in self.index.shards), default=0)
        self._most = max(_OPEN, _KNOWN // max(largest, _LEAST))
        self._shards: OrderedDict[int, ShardReader] = OrderedDict()
        self._open: OrderedDict[int, ShardReader] = OrderedDict()
        self._process = os.getpid()
        if "reflectance" not in self.fields:
            warnings.warn(
                f"the scans of {self.root} have no reflectance: it is read as 0",
                stacklevel=1,  # once, however often it is opened
            )
        self._cache = _open_cache(self.root, cache, limit, self.index)
        if self._cache is not None:
            self.expect = self._cache.expect  # a mixture announces what it reads next
            weakref.finalize(self, self._cache.close)

    @property
    def facts(self) -> Facts:
        """The facts that its scans have in common, from the first of its sources."""
        return self.index.sources[0]

    @property
    def sensor(self) -> Sensor:
        return self.facts.sensor

    @property
    def fields(self) -> frozenset[str]:
        return frozenset(self.facts.fields)

    @property
    def recorded(self) -> bool:
        """Whether a sensor recorded its scans; see ``Facts.recorded``."""
        return self.facts.recorded

    @property
    def identity(self) -> str:
        return self.index.checksum

    @property
    def length(self) -> int:
        """Number of scans."""
        return self.index.scans

    @property
    def shard_size(self) -> int:
        """Number of scans of its largest shard."""
        return max(entry.kept for entry in self.index.shards)

    @property
    def ids(self) -> Sequence[str]:
        """The scans' names, ``<model>/<seed>/<index>``."""
        return _Names(self.index)

    def __len__(self) -> int:
        return self.index.scans

    def __repr__(self) -> str:
        size = f"{len(self)} scans in {len(self.index.shards)} shards"
        fields = ", ".join(sorted(self.fields))
        return f"Bank({str(self.root)!r}): {size}\n  sensor {self.sensor.grid_text()}; {fields}"

    def __getitem__(self, number: int) -> Scan:
        """The returns of ``image(number)`` through the centres of their cells.

        Raises:
            DataError, FileError: if it cannot be read; the message names shard and scan.
        """
        shard, position = _place(self.index, number)
        image = self.facts.encoding.decode(self.shard(shard).read(position))
        name = _name(self.index, shard, position)
        made = _provenance(self.index, shard)
        domain = SYNTHETIC if made else REAL
        return replace(unproject(image), id=name, domain=domain, provenance=made)

    def image(self, number: int) -> RangeImage:
        """The range image of a scan; raises as ``__getitem__``."""
        shard, position = _place(self.index, number)
        return self.facts.encoding.decode(self.shard(shard).read(position))

    def facts_of(self, number: int) -> Facts:
        """The facts of the source that a scan comes from."""
        shard, _ = _place(self.index, number)
        return self.index.sources[self.index.shards[shard].source]

    def condition(self, number: int) -> str | None:
        """The name of the scan that conditioned scan ``number``; None for an unconditional one."""
        shard, position = _place(self.index, number)
        return self.shard(shard).condition(position)

    def shard(self, number: int) -> ShardReader:
        """An open shard; raises as ``__getitem__``."""
        if self._process != os.getpid():
            # After a fork: the parent's handles share its file positions and locks, so they are
            # left to the parent.
            self._shards = OrderedDict()
            self._open = OrderedDict()
            self._process = os.getpid()
        if self._cache is not None:
            self._cache.note(number)
        shard = self._shards.get(number)
        if shard is None or not shard.reopen():
            shard = self._shards[number] = self._new_reader(number)
        _touch(self._shards, number, self._most)
        self._open[number] = shard
        _touch(self._open, number, _OPEN)
        return shard

    def push_to_hub(
        self, name: str, *, licence: str | None = None, private: bool = False
    ) -> str:
        """Upload the bank to the Hugging Face hub, in one commit; its shards are checked before.

        Args:
            name: ``user/bank``, new or existing.
            licence: of the scans, an identifier of the hub such as "cc-by-4.0"; by default the
                one that the bank states.
            private: whether a new repository is private.

        Returns:
            What ``open_scans`` takes, ``hf://datasets/user/bank@COMMIT``.

        Raises:
            ConfigError: on a bank whose licence the hub does not know, or one at a URL.
            DataError: if a shard is damaged.
            FileError: if the hub refuses it or does not answer.
            LibraryError: without the extra ``hub``.
        """
        from lidar_synth.bank.hub import push_bank

        return push_bank(self.root, self.index, name, licence, private)

    def close(self) -> None:
        """Close the open shards, and fetch none ahead; reading opens them again."""
        if self._cache is not None:
            self._cache.close()
        while self._open and self._process == os.getpid():
            self._open.popitem()[1].close()

    def clear_cache(self) -> None:
        """Remove the copies of the bank's shards, and the cache's folder if it is empty then. After
        that this bank reads from its URL.

        Raises:
            FileError: if they cannot be removed.
        """
        self.close()
        self._shards.clear()
        if self._cache is not None:
            self._cache.clear()
            self._cache = None
            del self.expect

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_shards": OrderedDict(), "_open": OrderedDict()}

    def _new_reader(self, number: int) -> ShardReader:
        entry = self.index.shards[number]
        file = (
            open_storage(self.root, entry.file, entry.bytes)
            if self._cache is None
            else self._cache.open(number)
        )
        return ShardReader(
            file, f"{self.root}/{entry.file}", self.index.sources[entry.source], entry
        )

    def _check_files(self, root: Path) -> None:
        for entry in self.index.shards:
            try:
                size = (root / entry.file).stat().st_size
            except OSError as error:
                raise FileError(
                    f"{root}: shard {entry.file} is missing ({error.strerror})",
                    "a complete bank",
                    REPAIR,
                ) from error
            if size != entry.bytes:
                raise DataError(
                    f"{root / entry.file} is {size} bytes long",
                    f"{entry.bytes}, by the index",
                    REPAIR,
                )


def _settle(root: str | Path) -> str | Path:
    """The root of a bank, at one commit if it is on the hub: others may push meanwhile."""
    if isinstance(root, Path) or not root.startswith("hf://datasets/"):
        return root
    from lidar_synth.files.hub import pin_revision

    return pin_revision(root)


def _open_cache(
    root: str | Path, cache: str | Path | None, limit: int | str | None, index: Index
) -> ShardCache | None:
    if cache is None and limit is not None:
        raise ConfigError(f"limit={limit!r} without cache=", "a folder for the copies")
    if cache is None:
        return None
    if isinstance(root, Path):
        raise ConfigError(
            f"cache={str(cache)!r} for a bank in the folder {root}",
            "the URL of a bank",
            f"file://{root.absolute()} for a folder on a network drive.",
        )
    return ShardCache(Path(cache), limit, root, index)


def _touch(shards: OrderedDict[int, ShardReader], number: int, most: int) -> None:
    """Make a shard the latest, and close the oldest one if there are more than ``most``."""
    with suppress(KeyError):  # another thread has closed it
        shards.move_to_end(number)
    if len(shards) > most:
        shards.popitem(last=False)[1].close()


def is_bank(path: str | Path) -> bool:
    """Whether a folder holds a bank: complete, damaged, or begun."""
    index = Path(path) / INDEX  # other programs have files of this name
    return (
        (index.parent / SETTINGS).is_file()
        or any(index.parent.glob("shard-*.h5"))
        or (index.is_file() and FORMAT[:-1] in read_start(index, 1 << 20))
    )


class _Names(Sequence[str]):
    """The scans' names, computed on access: a bank of a million scans stores no list of texts."""

    def __init__(self, index: Index) -> None:
        self._index = index

    def __len__(self) -> int:
        return self._index.scans

    @overload
    def __getitem__(self, number: int) -> str: ...
    @overload
    def __getitem__(self, number: slice) -> Sequence[str]: ...
    def __getitem__(self, number: int | slice) -> str | Sequence[str]:
        if isinstance(number, slice):
            return [self[i] for i in range(len(self))[number]]
        return _name(self._index, *_place(self._index, number))


def _place(index: Index, number: int) -> tuple[int, int]:
    """The shard of a scan, and its position in that shard.

    Raises:
        TypeError, IndexError: as ``index_of``.
    """
    number = index_of(number, index.scans)
    shard = bisect_right(index.ends, number)
    entry = index.shards[shard]
    return shard, entry.position(number - (index.ends[shard] - entry.kept))


def _name(index: Index, shard: int, position: int) -> str:
    """A scan's name."""
    entry = index.shards[shard]
    return f"{index.sources[entry.source].model}/{entry.seed}/{entry.first + position}"


def _provenance(index: Index, shard: int) -> dict[str, Any]:
    """What made the scans of a shard, as ``Scan.provenance``; {} for recorded ones."""
    entry = index.shards[shard]
    facts = index.sources[entry.source]
    if facts.recorded:
        return {}
    return model_provenance(facts.model, facts.checkpoint, entry.seed)


def read_index(root: str | Path) -> Index:
    """The index of a bank in a folder or at a URL.

    Raises:
        FileError: if it is missing.
        DataError: if it is damaged or of another version.
    """
    return Index.from_json(_read_index(root), f"{root}/{INDEX}")


def _read_index(root: str | Path) -> bytes:
    read = (
        RemoteFile(f"{root}/{INDEX}").read_all
        if isinstance(root, str)
        else (root / INDEX).read_bytes
    )
    try:
        return read()
    except OSError as error:
        cause = error.__cause__
        if isinstance(error, FileError) and not isinstance(cause, FileNotFoundError):
            raise  # a failure of the network
        raise FileError(
            f"{root} holds no bank: {INDEX} cannot be read ({error.strerror or cause})",
            "the folder of a finished bank",
            "Run an interrupted bake again to resume it; lidar-synth repair rebuilds a lost index.",
        ) from error
