"""What all readers have in common: names of scans, reading by index, and what happens to a bad scan."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeVar, get_args

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats.calibration import Calibration
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor

OnBad = Literal["error", "skip"]
"""What a source does with a scan that cannot be read: raise, or count and name it and go on."""

Choice = TypeVar("Choice")


class ScanFiles(ABC):
    """An indexable source of scans on disk; a dataset says how one scan is read.

    Args:
        root: where the files are.
        ids: the scans' names, unique in the source, in order.
        sensor: a preset's name, a YAML file or a ``Sensor``.
        on_bad: ``"error"`` raises on a scan that cannot be read. With ``"skip"`` ``source[i]`` is the next good
            scan (from the end on, the first), iterating leaves the bad ones out, and ``skipped`` names them.

    Attributes:
        skipped: {id: reason} of the scans that could not be read so far, in this process.

    Raises:
        ConfigError: on another ``on_bad``.
        DataError: where there is no scan.
    """

    def __init__(self, root: Path, ids: Sequence[str], sensor: str | Path | Sensor, on_bad: OnBad = "error") -> None:
        if on_bad not in get_args(OnBad):
            raise ConfigError(f"on_bad={on_bad!r}", f"one of {get_args(OnBad)}")
        if not ids:
            raise DataError(f"{root} holds no scan", (self.__doc__ or "").splitlines()[0].rstrip("."))
        self.root = root
        self.ids = tuple(ids)
        self.sensor = load_sensor(sensor)
        self.on_bad = on_bad
        self.skipped: dict[str, str] = {}

    @abstractmethod
    def read(self, index: int) -> Scan:
        """The scan at ``index``, 0 <= index < len.

        Raises:
            DataError, FileError: where it cannot be read.
        """

    def calibration(self, index: int) -> Calibration | None:
        """The camera beside the sensor when scan ``index`` was taken; None where the dataset tells none."""
        return None

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Scan:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        if self.on_bad == "error":
            return self.read(index % len(self))
        for step in range(len(self)):
            scan = self._try((index + step) % len(self))
            if scan is not None:
                return scan
        reason = next(iter(self.skipped.values()))
        raise DataError(
            f"none of the {len(self)} scans of {self.root} can be read ({reason})", "at least one good scan"
        )

    def __iter__(self) -> Iterator[Scan]:
        for index in range(len(self)):
            scan = self.read(index) if self.on_bad == "error" else self._try(index)
            if scan is not None:
                yield scan

    def _try(self, index: int) -> Scan | None:
        name = self.ids[index]
        if name in self.skipped:
            return None
        try:
            return self.read(index)
        except (DataError, FileError) as error:
            self.skipped[name] = str(error)
            # A warning is seen from loader workers too, whose copy of ``skipped`` stays with them.
            warnings.warn(f"skipped scan {name}: {error}", stacklevel=3)
            return None


def choose(kind: str, name: str, table: Mapping[str, Choice], hint: str = "") -> Choice:
    """``table[name]``, or an error that lists the names.

    Raises:
        ConfigError: on a name that is not in the table.
    """
    if name not in table:
        raise ConfigError(f"{kind} {name!r}", f"one of {', '.join(map(repr, table))}", hint)
    return table[name]
