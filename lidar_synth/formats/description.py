"""``Description``: what files say about their scans: the sensor, its grid, and where the scans come
from.

Formats with room hold it in each file: ``.npz``, PCD and PLY (as comments), PNG, WebDataset, and
banks. For all others it stands in ``scans.json`` in the root of their folder::

    {"format": "lidar-synth-scans/1",
     "sensor": {"name": "os1_128", "rows": 128, ...},            the keys of sensors.yaml
     "grid": [128, 1024],                                        rows and columns of the sensor
     "origins": [{"domain": "synthetic", "made_by": "model", "model": "town",
                  "checkpoint": "9f...", "seed": 7}]}

An origin is the domain of some of the scans (``real`` or ``synthetic``) with their
``Scan.provenance``. A folder has several if scans of several were written into it; then it does not
say which scan has which.

For your own folder, ``{"format": "lidar-synth-scans/1", "sensor": "os1_128"}`` is enough: the name
of a preset, or the keys of ``sensors.yaml``. Without ``origins`` the scans are real.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError, parsing, shorten, suggest
from lidar_synth.files.disk import read_start, read_text, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.geometry import REAL, SYNTHETIC, Scan, Sensor, presets

NAME = "scans.json"
"""File in the root of a folder that describes its scans."""

FORMAT = "lidar-synth-scans/1"
_FORMATS = "lidar-synth-scans/"  # of any version

DOMAINS = {"real": REAL, "synthetic": SYNTHETIC}

LEVELS = 6
"""Number of folders above a scan that are searched for a description."""

LONGEST = 1 << 20
"""Maximum number of bytes of a description."""

LINE = 100
"""Number of characters of a comment: readers of PCD and PLY limit the length of a line."""

_MOST_FACTS = 32
_LONGEST_TEXT = 1000

_OF_A_LAYOUT = re.compile(
    r"velodyne(_points|_reduced)?|data|data_3d_raw|2013_05_28_drive_\d{4}_sync|sequences|\d\d"
    r"|training|testing"
)

_OF_A_DATASET = (
    "data_3d_raw",
    "sequences",
    "training",
    "testing",
    "velodyne",
    "velodyne_points",
)
# folders in the root of a dataset, whose other folders are not its own


@dataclass(frozen=True)
class Origin:
    """Where scans come from.

    Args:
        domain: ``REAL`` or ``SYNTHETIC``.
        provenance: as ``Scan.provenance``.
    """

    domain: int = REAL
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, scan: Scan) -> "Origin":
        """The origin of a scan."""
        return cls(scan.domain, scan.provenance)

    def apply(self, scan: Scan) -> Scan:
        """The scan with this origin, as far as the scan has none of its own."""
        domain = max(scan.domain, self.domain)
        provenance = scan.provenance or self.provenance
        if (domain, provenance) == (scan.domain, scan.provenance):
            return scan
        return replace(scan, domain=domain, provenance=provenance)


@dataclass(frozen=True)
class Description:
    """What files say about their scans.

    Args:
        sensor: the sensor that recorded them or that they imitate; None if it is not known.
        origins: where they come from, at least one.
    """

    sensor: Sensor | None
    origins: tuple[Origin, ...] = (Origin(),)

    @property
    def origin(self) -> Origin:
        """What all scans have in common: synthetic if all of them are, and the provenance if there
        is only one."""
        if len(self.origins) == 1:
            return self.origins[0]
        return Origin(min(origin.domain for origin in self.origins))

    def to_dict(self) -> dict[str, Any]:
        """Plain values; ``from_dict`` is the inverse."""
        names = {number: name for name, number in DOMAINS.items()}
        sensor = (
            {}
            if self.sensor is None
            else {"sensor": self.sensor.to_dict(), "grid": list(self.sensor.shape)}
        )
        origins = [
            {"domain": names[origin.domain], **origin.provenance}
            for origin in self.origins
        ]
        return {"format": FORMAT, **sensor, "origins": origins}

    @classmethod
    def from_dict(cls, values: Any) -> "Description":
        """Make a description from the values of ``to_dict``, which may be hostile.

        Raises:
            ValueError: on another format, a missing or contradictory value, or one of a wrong type.
        """
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            given = (
                values.get("format")
                if isinstance(values, dict)
                else type(values).__name__
            )
            raise ValueError(
                f"its format is {shorten(repr(given), 100)}, not {FORMAT!r}"
            )
        sensor = _sensor(values["sensor"]) if "sensor" in values else None
        shape = None if sensor is None else list(sensor.shape)
        if sensor is not None and values.get("grid", shape) != shape:
            raise ValueError(
                f"its grid is {shorten(repr(values['grid']), 100)}, but its sensor has "
                f"{sensor.shape}"
            )
        origins = values.get("origins", [{"domain": "real"}])
        if not isinstance(origins, list) or not origins:
            raise ValueError("its origins are not a list of mappings")
        return cls(sensor, tuple(map(_origin, origins)))


def _origin(value: Any) -> Origin:
    """An origin from its values."""
    if not isinstance(value, dict):
        raise ValueError("its origins are not a list of mappings")
    facts = dict(value)
    domain = facts.pop("domain", None)
    if not isinstance(domain, str) or domain not in DOMAINS:
        raise ValueError(f"the domain of an origin is not one of {', '.join(DOMAINS)}")
    return Origin(DOMAINS[domain], check_provenance(facts))


def _sensor(value: Any) -> Sensor:
    """A sensor from its keys, or a preset from its name."""
    if not isinstance(value, str):
        return Sensor.from_dict(value)
    if value not in presets():
        hint = suggest(value, presets())
        raise ValueError(
            f"sensor {value!r} is no preset ({', '.join(presets())}). {hint}".strip()
        )
    return presets()[value]


def check_provenance(values: Any) -> dict[str, Any]:
    """Check a provenance from a file: a few short texts and numbers by name.

    Raises:
        ValueError: on anything else.
    """
    if not isinstance(values, dict) or len(values) > _MOST_FACTS:
        raise ValueError(
            f"a provenance that is not a mapping of at most {_MOST_FACTS} values"
        )
    for key, value in values.items():
        texts = [text for text in (key, value) if isinstance(text, str)]
        valid = isinstance(value, str | None) or (
            isinstance(value, int | float) and abs(value) < 1e300
        )
        if not valid or any(len(text) > _LONGEST_TEXT for text in texts):
            raise ValueError(
                f"a provenance with {shorten(repr(key), 100)} that is not a short text or a number"
            )
    return values


def read_description(root: Path, plain: bool = False) -> Description | None:
    """The description beside scans, or above the folders of their layout; None if there is none.

    Args:
        root: a dataset's root, one of its folders, or one scan.
        plain: whether the scans are plain files, which lie in folders of any name below that of
            their ``scans.json``.

    Raises:
        FileError, DataError: if there is one that cannot be read, or is damaged.
    """
    root = root.resolve()
    folder = root.parent if root.is_file() else root
    folders = [folder, *folder.parents][:LEVELS]
    first = sum(
        1
        for _ in takewhile(lambda each: _OF_A_LAYOUT.fullmatch(each.name), folders[:-1])
    )
    for each in folders[: first + 1]:
        if (each / NAME).is_file():
            return _current(each / NAME)
    return _above(folders[first:]) if plain else None


def _above(folders: Sequence[Path]) -> Description | None:
    """The description of a plain folder, from the folders above the first one.

    A folder has nothing to say about those below it if it is a dataset, or holds scans itself: the
    ids of a source, from which the names come, are of one form.
    """
    for below, folder in pairwise(folders):
        if _is_dataset(below):
            return None
        path = folder / NAME
        # other programs have files of this name
        if path.is_file() and _FORMATS in read_start(path, LONGEST):
            if _is_dataset(folder) or any(folder.glob("*.bin")):
                return None
            return _current(path)
    return None


def _is_dataset(folder: Path) -> bool:
    return any((folder / name).is_dir() for name in _OF_A_DATASET)


def _current(path: Path) -> Description:
    expected = f"a description of scans, of this package or yours ({FORMAT})"
    hint = (
        "Restore it; or remove it (rename it, if it is another program's) and name the sensor: "
        "--sensor (sensor=...)."
    )
    with parsing(path, expected, hint):
        text = read_text(path, expected, LONGEST)
        return Description.from_dict(parse_json(text, str(path), expected, hint))


def record(root: Path, sensor: Sensor, origin: Origin) -> Description:
    """Write the sensor and the origin of a scan into the description of its folder, which may exist
    already.

    Args:
        root: the folder.
        sensor: the scan's sensor; that of the folder's first scan is written.
        origin: where the scan comes from.

    Returns:
        The description, with this origin.

    Raises:
        ConfigError: if the folder holds scans on another grid.
        DataError: if the existing description is damaged.
        FileError: if it cannot be read or written.
    """
    if not (root / NAME).is_file():  # another process may create it at the same time
        write_file(
            root / NAME, _encode(Description(sensor, (origin,))), overwrite=False
        )
    require_grid(root, _current(root / NAME), sensor)
    return add_origin(root, origin)


def add_origin(root: Path, origin: Origin) -> Description:
    """Add an origin to the description of a folder, and return it.

    If two processes add one at the same moment, one of the two is lost: the process that started
    them adds it again.

    Raises:
        DataError, FileError: if the description is damaged, or cannot be read or written.
    """
    there = _current(root / NAME)
    if origin not in there.origins:
        there = replace(there, origins=(*there.origins, origin))
        write_file(root / NAME, _encode(there))
    return there


def require_grid(root: Path, there: Description, sensor: Sensor) -> None:
    """Refuse a scan of another sensor than those of a folder.

    Raises:
        ConfigError: if the grids differ.
    """
    if there.sensor is not None and not sensor.same_grid(there.sensor):
        raise ConfigError(
            f"a scan of {_named(sensor)} for {root}, which holds scans of {_named(there.sensor)}",
            "scans on one grid in one folder",
            f"Choose another folder, or convert them with --as-sensor {there.sensor.name} "
            "(as_sensor=...).",
        )


def _named(sensor: Sensor) -> str:
    return f"sensor {sensor.name!r} ({sensor.shape[0]} x {sensor.shape[1]})"


def _encode(description: Description) -> bytes:
    return (json.dumps(description.to_dict(), indent=1) + "\n").encode()


def to_comments(scan: Scan) -> list[str]:
    """The description of a scan as lines of a header, of at most ``LINE`` ASCII characters each and
    a prefix."""
    text = json.dumps(
        Description(scan.sensor, (Origin.of(scan),)).to_dict(), separators=(",", ":")
    )
    # so that no program that trims or splits a line changes it
    text = text.replace(" ", r"\u0020")
    return [f"lidar_synth {text[i : i + LINE]}" for i in range(0, len(text), LINE)]


def from_comments(lines: Iterable[str], where: str) -> Description | None:
    """The inverse of ``to_comments``; other comments are ignored. None if there is no description.

    Raises:
        DataError: on a damaged one.
    """
    words = [line.split() for line in lines]
    parts = [word[1] for word in words if len(word) == 2 and word[0] == "lidar_synth"]
    if not parts:
        return None
    expected = f"a description of the scan that this package wrote ({FORMAT})"
    with parsing(f"{where}: its description", expected):
        return Description.from_dict(
            parse_json("".join(parts), f"{where}: its description", expected)
        )
