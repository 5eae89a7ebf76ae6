"""What all readers have in common: names of scans, reading by index, and what happens to a bad scan."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar, get_args

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.domain import domain_of
from lidar_synth.formats.points import bad_points_kept, without_bad_points
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor

OnBad = Literal["error", "skip", "drop-points"]
"""What a source does with a scan that cannot be read: raise, or count and name it and go on; or with one that has
points which are NaN or infinite: leave those out and count them."""

Choice = TypeVar("Choice")


class ScanFiles(ABC):
    """An indexable source of scans on disk; a dataset says how one scan is read.

    Args:
        root: where the files are.
        ids: the scans' names, unique in the source, in order.
        sensor: a preset's name, a YAML file or a ``Sensor``.
        on_bad: ``"error"`` raises on a scan that cannot be read. With ``"skip"`` ``source[i]`` is the next good
            scan (from the end on, the first), iterating leaves the bad ones out, and ``skipped`` names them. With
            ``"drop-points"`` a scan loses its points that are NaN or infinite, with their labels, and ``dropped``
            counts them; it raises on everything else.

    Attributes:
        skipped: {id: reason} of the scans that could not be read so far, in this process.
        dropped: {id: number} of the points that were left out so far, in this process.
        domain: ``SYNTHETIC`` where the folder says that all of its scans are; else scans tell it themselves.

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
        self.dropped: dict[str, int] = {}
        self.domain = domain_of(root)

    @abstractmethod
    def read(self, index: int) -> Scan:
        """The scan at ``index``, 0 <= index < len.

        Raises:
            DataError, FileError: where it cannot be read.
        """

    def load(self, index: int, drop_points: bool | None = None) -> Scan:
        """What ``read`` reads, without bad points if they are to be dropped, of the domain that the folder tells.

        Args:
            index: 0 <= index < len.
            drop_points: by default whether ``on_bad`` says so.

        Raises:
            DataError, FileError: as ``read``; where no point is left.
        """
        if drop_points if drop_points is not None else self.on_bad == "drop-points":
            with bad_points_kept():
                read = self.read(index)
            scan = without_bad_points(read)
            if len(scan) < len(read):
                self.dropped[self.ids[index]] = len(read) - len(scan)
        else:
            scan = self.read(index)
        return scan if self.domain != SYNTHETIC or scan.domain == SYNTHETIC else replace(scan, domain=SYNTHETIC)

    def calibration(self, index: int) -> Calibration | None:
        """The camera beside the sensor when scan ``index`` was taken; None where the dataset tells none."""
        return None

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Scan:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        if self.on_bad != "skip":
            return self.load(index % len(self))
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
            scan = self.load(index) if self.on_bad != "skip" else self._try(index)
            if scan is not None:
                yield scan

    def _try(self, index: int) -> Scan | None:
        name = self.ids[index]
        if name in self.skipped:
            return None
        try:
            return self.load(index)
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
