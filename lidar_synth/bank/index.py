"""A bank's metadata: the facts that its scans have in common, and ``index.json`` with every shard's
size and hash.

``index.json``::

    format     "lidar-synth-bank/1", or "lidar-synth-bank/2" where scans have boxes and instances;
               readers refuse every other value
    scans      number of scans
    sources    the facts of each bake; more than one after a merge
    shards     in order: file, seed, first index, scans, source (a position in ``sources``), bytes,
               sha256; in a curated bank also ``dropped``: positions in the file of the scans that
               are left out
    repairs    descriptions of the shards that a repair wrote with different bytes
    curation   in a curated bank: why scans were left out
    files      sha256 of the other files of the bank; missing in banks of older versions
    checksum   sha256 of all other values, as JSON without spaces and with sorted keys

The root attributes of each shard repeat the facts and have to agree with them; text and numbers are
stored directly, everything else as JSON::

    sensor         as in sensors.yaml; scale = range_max / 65535, metres per step of ``range``
    fields         what is stored beside the range: reflectance, label, confidence; in /2 instance,
                   boxes
    model          the checkpoint's name, or that of a data set; checkpoint: its hash, empty for
                   recorded scans
    provenance     its header's provenance; of recorded scans their data, and their terms if there
                   are any
    settings       of the bake: everything else that determines the scans
    label_policy   "generated", "condition", "annotated" (recorded scans), or "none"
    condition      the dataset that the scans are conditioned on, or null
    licence        of the weights; data_licence: of the training data
    software       versions of the libraries that made the scans
    compression    "gzip" or "blosc2"; layout "plain" or "paged"
"""

import json
import re
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lidar_synth.bank.chunks import FILTERS
from lidar_synth.bank.encoding import RANGE_STEPS, Encoding
from lidar_synth.errors import DataError
from lidar_synth.files.disk import sha256
from lidar_synth.files.parsing import json_checksum
from lidar_synth.geometry import Sensor

FORMAT = "lidar-synth-bank/1"
BOXED_FORMAT = "lidar-synth-bank/2"
"""The format of banks without boxes, which is also that of all older banks, and of those with
boxes."""

LAYOUTS = ("plain", "paged")
INDEX = "index.json"

SETTINGS = ".bake.json"
"""File in the bank's folder with the settings of the bake; on a disk, runs that fill the folder
hold a lock on it."""

SCAN_NUMBERS = 20
"""Bytes of a scan's seed, index and CRC: the minimum size of a scan."""

REPAIR = "lidar-synth repair BANK regenerates what is damaged or missing."

_TEXT = (
    "format",
    "model",
    "checkpoint",
    "label_policy",
    "licence",
    "data_licence",
    "compression",
    "layout",
)
_DEPTH = 32  # most levels of nested JSON: Python recurses once per level


@dataclass(frozen=True)
class Facts:
    """The properties that all scans of one bake share; the module's docstring describes the fields.

    Raises:
        ConfigError: on fields that have no encoding.
    """

    sensor: Sensor
    fields: tuple[str, ...]
    model: str
    checkpoint: str
    settings: dict[str, Any]
    label_policy: str
    licence: str
    data_licence: str
    provenance: dict[str, Any] = field(default_factory=dict)
    software: dict[str, Any] = field(default_factory=dict)
    condition: dict[str, Any] | None = None
    compression: str = "gzip"
    layout: str = "plain"

    @cached_property
    def encoding(self) -> Encoding:
        """The encoding of the scans."""
        return Encoding(self.sensor, self.fields)

    @property
    def recorded(self) -> bool:
        """Whether a sensor recorded the scans: no checkpoint made them."""
        return not self.checkpoint

    @property
    def format(self) -> str:
        """The format of a bank with these fields."""
        return BOXED_FORMAT if {"boxes", "instance"} & set(self.fields) else FORMAT

    @cached_property
    def text_size(self) -> int:
        """Size of the facts as JSON, in bytes."""
        return len(json.dumps(self.to_dict()).encode())

    def to_dict(self) -> dict[str, Any]:
        """The facts as plain values, with format and scale."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values |= {"sensor": self.sensor.to_dict(), "fields": list(self.fields)}
        return {
            "format": self.format,
            "scale": self.sensor.range_max / RANGE_STEPS,
            **values,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], where: str) -> "Facts":
        """The inverse of ``to_dict``.

        Raises:
            DataError: on another format, unknown keys, values of a wrong type, or a scale that does
                not match the sensor.
        """
        try:
            values = dict(values)
            given = values.pop("format", None)
            _check_format(given, where)
            scale = values.pop("scale", None)
            facts = cls(
                **values
                | {
                    "sensor": _sensor(values["sensor"]),
                    "fields": tuple(values["fields"]),
                }
            )
            facts._check_kinds()
            if given != facts.format:
                raise ValueError(f"fields {facts.fields} in format {given!r}")
            expected = facts.encoding.scale
        except DataError:
            raise
        except (
            LookupError,
            TypeError,
            ValueError,
            ArithmeticError,
            AttributeError,
        ) as error:
            raise DataError(
                f"{where}: facts that do not fit together ({error})",
                f"those of {FORMAT}",
            ) from error
        if scale != expected:
            raise DataError(
                f"{where}: scale {scale!r}",
                f"{expected!r} for sensor {facts.sensor.name!r}",
                REPAIR,
            )
        return facts

    def to_attributes(self) -> dict[str, Any]:
        """Values for HDF5 attributes, ascending by size: HDF5 moves the first eight when a ninth is
        added, which leaves a gap of their size. Text has a fixed length: HDF5 stores
        variable-length text without a checksum.
        """
        attributes = {name: _attribute(value) for name, value in self.to_dict().items()}
        return dict(
            sorted(attributes.items(), key=lambda item: np.asarray(item[1]).nbytes)
        )

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any], where: str) -> "Facts":
        """The inverse of ``to_attributes``; raises as ``from_dict``."""
        try:
            _check_format(_plain("format", attributes.get("format", b"")), where)
            values = {name: _plain(name, value) for name, value in attributes.items()}
        except DataError:
            raise
        except (ValueError, TypeError, RecursionError) as error:
            raise DataError(
                f"{where}: attributes that cannot be read ({error})",
                f"those of {FORMAT}",
            ) from error
        return cls.from_dict(values, where)

    def _check_kinds(self) -> None:
        """Raise ``TypeError`` or ``ValueError`` on a value of a wrong type."""
        kinds = dict.fromkeys(_TEXT[1:], str) | {
            "settings": dict,
            "provenance": dict,
            "software": dict,
        }
        for name, kind in kinds.items():
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise TypeError(f"{name} is {value!r}")
        if not isinstance(self.condition, dict | None):
            raise TypeError(f"condition is {self.condition!r}")
        if self.compression not in FILTERS or self.layout not in LAYOUTS:
            raise ValueError(
                f"compression {self.compression!r}, layout {self.layout!r}"
            )


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
        try:
            values = _from_json(text)
            _check_format(values.get("format"), where)
            given = values.pop("checksum", None)
            if given != json_checksum(values):
                raise DataError(
                    f"{where} does not match its checksum: it was damaged or edited",
                    "an index",
                )
            return cls._from_values(values, where)
        except DataError:
            raise
        except (
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            RecursionError,
        ) as error:
            raise DataError(
                f"{where} is damaged ({error})",
                f"the index of a bank, {FORMAT}",
                REPAIR,
            ) from error

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


def _from_json(text: str | bytes) -> Any:
    """Parse a JSON text.

    Raises:
        ValueError, RecursionError: if it is invalid, nested too deep, or has text that UTF-8 cannot
            represent.
    """
    values = json.loads(text)
    # JSON permits half of a surrogate pair, UTF-8 does not.
    json.dumps(values, ensure_ascii=False).encode()
    level = [values]
    for _ in range(_DEPTH):
        level = [
            child
            for v in level
            if isinstance(v, dict | list)
            for child in (v.values() if isinstance(v, dict) else v)
        ]
    if level:
        raise ValueError(f"values nested more than {_DEPTH} deep")
    return values


def _sensor(values: Any) -> Sensor:
    """The sensor of a bank's facts, from the values of ``Sensor.to_dict``."""
    sensor = Sensor.from_dict(values)
    numbers = [v for v in (*sensor.shape, sensor.columns, sensor.rows) if v is not None]
    if not all(type(number) is int for number in numbers) or sensor.to_dict() != values:
        raise TypeError(f"sensor {str(values)[:200]}")
    return sensor


def _check_format(given: Any, where: str) -> None:
    if given in (FORMAT, BOXED_FORMAT):
        return
    if str(given).startswith(FORMAT.rpartition("/")[0]):
        raise DataError(
            f"{where} is of format {given!r}",
            f"{FORMAT!r} or {BOXED_FORMAT!r}",
            "Use the version of lidar_synth that wrote it.",
        )
    raise DataError(f"{where} is not part of a bank (format {given!r})", repr(FORMAT))


def _attribute(value: Any) -> Any:
    if isinstance(value, float):
        return value
    text = (
        value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    ).encode()
    return np.array(text, h5py.string_dtype("utf-8", max(len(text), 1)))


def _plain(name: str, value: Any) -> Any:
    """The inverse of ``_attribute``."""
    if isinstance(value, float):
        return float(value)
    # bytes(NUMBER) would allocate that many bytes
    if not isinstance(value, str | bytes):
        raise ValueError(f"{name} is a {type(value).__name__}")
    text = value if isinstance(value, str) else value.decode()
    return text if name in _TEXT else _from_json(text)
