"""The facts that the scans of one bake have in common.

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
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import h5py
import numpy as np

from lidar_synth.bank.chunks import FILTERS
from lidar_synth.bank.encoding import RANGE_STEPS, Encoding
from lidar_synth.errors import DataError, parsing
from lidar_synth.geometry import Sensor

FORMAT = "lidar-synth-bank/1"
BOXED_FORMAT = "lidar-synth-bank/2"
"""The format of banks without boxes, which is also that of all older banks, and of those with
boxes."""

LAYOUTS = ("plain", "paged")

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
        with parsing(where, f"facts of {FORMAT}", REPAIR):
            values = dict(values)
            given = values.pop("format", None)
            check_format(given, where)
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
            if scale != expected:
                raise ValueError(f"scale {scale!r} in place of {expected!r}")
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
        with parsing(where, f"facts of {FORMAT}", REPAIR):
            check_format(_plain("format", attributes.get("format", b"")), where)
            values = {name: _plain(name, value) for name, value in attributes.items()}
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


def bounded_json(text: str | bytes) -> Any:
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


def check_format(given: Any, where: str) -> None:
    """Raise ``DataError`` on another format than those of banks."""
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
    return text if name in _TEXT else bounded_json(text)
