"""``index.json``, the content of a bank: every shard's size and hash, and the facts of its scans.

``index.json``::

    format     "lidar-synth-bank/1", or "lidar-synth-bank/2" where scans have boxes and instances;
               readers refuse every other value
    scans      number of scans
    sources    the facts of each bake, see ``facts``; more than one after a merge
    shards     in order: file, seed, first index, scans, source (a position in ``sources``), bytes,
               sha256; in a curated bank also ``dropped``: positions in the file of the scans that
               are left out
    repairs    descriptions of the shards that a repair wrote with different bytes
    curation   in a curated bank: why scans were left out
    files      sha256 of the other files of the bank; missing in banks of older versions
    checksum   sha256 of all other values, as JSON without spaces and with sorted keys
"""

import json
import re
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from lidar_synth.bank.facts import FORMAT, REPAIR, Facts, bounded_json, check_format
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import sha256
from lidar_synth.files.parsing import json_checksum

INDEX = "index.json"

SETTINGS = ".bake.json"
"""File in the bank's folder with the settings of the bake; on a disk, runs that fill the folder
hold a lock on it."""

SCAN_NUMBERS = 20
"""Bytes of a scan's seed, index and CRC: the minimum size of a scan."""


@dataclass(frozen=True)
class Entry:
    """One shard: scans ``first`` to ``first + scans - 1`` of a seed.

    Args:
        file: name of the file in the bank's folder.
        seed: seed of the scans' noise.
        first: index of its first scan.
        scans: number of scans in the file.
        source: position of its facts in ``Index.sources``.
        bytes: size of the file.
        sha256: hash of the file.
        dropped: ascending positions of the scans that are in the file but not in the bank.
    """

    file: str
    seed: int
    first: int
    scans: int
    source: int = 0
    bytes: int = 0
    sha256: str = ""
    dropped: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        # a list, where it comes from JSON
        object.__setattr__(self, "dropped", tuple(self.dropped))

    @property
    def kept(self) -> int:
        """Number of its scans that are in the bank."""
        return self.scans - len(self.dropped)

    def position(self, rank: int) -> int:
        """The position in the file of the kept scan number ``rank``."""
        # ``dropped[i] - i`` kept scans precede dropped scan i; it shifts every rank from there on
        # by one.
        return rank + bisect_right(
            range(len(self.dropped)), rank, key=lambda i: self.dropped[i] - i
        )

    def measure(self, path: Path) -> "Entry":
        """The entry with the size and hash of its file."""
        return replace(self, bytes=path.stat().st_size, sha256=sha256(path))

    def to_dict(self) -> dict[str, Any]:
        """The entry as plain values."""
        values = asdict(self)
        if self.dropped:
            return values
        return {name: value for name, value in values.items() if name != "dropped"}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Entry":
        """The inverse of ``to_dict``, for a shard that has been written.

        Raises:
            TypeError, ValueError: on keys or values that a shard cannot have.
        """
        entry = cls(**values)
        numbers = (
            entry.seed,
            entry.first,
            entry.scans,
            entry.source,
            entry.bytes,
            *entry.dropped,
        )
        # A JSON number may be 1e30 or 2.0, and Python takes true for a number.
        if not all(type(number) is int and 0 <= number < 1 << 64 for number in numbers):
            raise ValueError(f"numbers of {entry}")
        if not (isinstance(entry.file, str) and isinstance(entry.sha256, str)):
            raise TypeError(f"text of {entry}")
        if entry.scans * SCAN_NUMBERS > entry.bytes:
            raise ValueError(f"{entry.bytes} bytes cannot hold {entry.scans} scans")
        return entry

    @property
    def span(self) -> str:
        """Description of its scans, for messages."""
        return (
            f"scans {self.first} to {self.first + self.scans - 1} of seed {self.seed}"
        )


@dataclass(frozen=True)
class Index:
    """The content of a bank, in order.

    Args:
        sources: the facts of each bake.
        shards: at least one.
        repairs: descriptions of shards that a repair wrote with different bytes.
        curation: why scans were left out; () for a bank that is not curated.
        files: {name: sha256} of the other files of the bank; they do not change the bank's
            identity.

    Raises:
        DataError: if the values are inconsistent.
    """

    sources: tuple[Facts, ...]
    shards: tuple[Entry, ...]
    repairs: tuple[str, ...] = ()
    curation: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        for entry in self.shards:
            self._check_shard(entry)
        if not self.shards or len({e.file for e in self.shards}) < len(self.shards):
            raise DataError(
                f"a bank with the shards {[e.file for e in self.shards]}",
                "at least one, each only once",
            )
        if any(
            (f.sensor, f.fields) != (self.sources[0].sensor, self.sources[0].fields)
            for f in self.sources
        ):
            raise DataError(
                "a bank with several sensors or fields", "the same for all scans"
            )

    def _check_shard(self, entry: Entry) -> None:
        if not re.fullmatch(r"[\w.-]+\.h5", entry.file) or entry.file[0] == ".":
            raise DataError(
                f"a bank's shard {entry.file!r}",
                "the name of an .h5 file in the bank's folder",
            )
        if not (
            0 <= entry.source < len(self.sources)
            and entry.scans >= 1
            and entry.first >= 0
        ):
            raise DataError(
                f"a bank with {entry}", "at least one scan, of one of its sources"
            )
        steps = pairwise((-1, *entry.dropped, entry.scans))
        if not (
            entry.kept >= 1
            and all(a < b for a, b in steps)
            and (self.curation or not entry.dropped)
        ):
            raise DataError(
                f"a bank with {entry}",
                "ascending positions that leave a scan, and the rule",
            )

    @property
    def scans(self) -> int:
        """Number of scans in the bank."""
        return self.ends[-1]

    @cached_property
    def ends(self) -> list[int]:
        """Number of scans up to and including each shard."""
        return list(accumulate(entry.kept for entry in self.shards))

    @cached_property
    def by_file(self) -> dict[str, Entry]:
        """The shards, by file name."""
        return {entry.file: entry for entry in self.shards}

    @property
    def size(self) -> int:
        """Size of all shards in bytes."""
        return sum(entry.bytes for entry in self.shards)

    @cached_property
    def checksum(self) -> str:
        """The bank's identity: the sha256 of all values but ``files``, one of which contains this
        checksum."""
        return json_checksum(self._values())

    def to_json(self) -> bytes:
        """The content of ``index.json``."""
        values = self._values() | ({"files": self.files} if self.files else {})
        return (
            json.dumps(
                values | {"checksum": json_checksum(values)}, indent=1, sort_keys=True
            )
            + "\n"
        ).encode()

    @classmethod
    def from_json(cls, text: bytes, where: str) -> "Index":
        """The inverse of ``to_json``.

        Raises:
            DataError: on another format or damaged content.
        """
        with parsing(where, f"the index of a bank, {FORMAT}", REPAIR):
            values = bounded_json(text)
            check_format(values.get("format"), where)
            given = values.pop("checksum", None)
            if given != json_checksum(values):
                raise ValueError(
                    "it does not match its checksum: it was damaged or edited"
                )
            return cls._from_values(values, where)

    @classmethod
    def _from_values(cls, values: Mapping[str, Any], where: str) -> "Index":
        """An index from plain values; bad ones raise whatever error they cause."""
        index = cls(
            tuple(Facts.from_dict(facts, where) for facts in values["sources"]),
            tuple(Entry.from_dict(entry) for entry in values["shards"]),
            tuple(values["repairs"]),
            tuple(values.get("curation", ())),
            {
                str(name): str(digest)
                for name, digest in values.get("files", {}).items()
            },
        )
        if values["format"] != index.sources[0].format:
            raise ValueError(
                f"format {values['format']!r} of scans with {index.sources[0].fields}"
            )
        if values["scans"] != index.scans:
            raise ValueError(
                f"{values['scans']} scans, but its shards hold {index.scans}"
            )
        for notes in (values["repairs"], values.get("curation", [])):
            if not isinstance(notes, list) or not all(
                isinstance(note, str) for note in notes
            ):
                raise TypeError(f"notes {str(notes)[:80]}")
        return index

    def _values(self) -> dict[str, Any]:
        values: dict[str, Any] = {
            "format": self.sources[0].format,
            "scans": self.scans,
            "sources": [facts.to_dict() for facts in self.sources],
            "shards": [entry.to_dict() for entry in self.shards],
            "repairs": list(self.repairs),
        }
        return values | ({"curation": list(self.curation)} if self.curation else {})
