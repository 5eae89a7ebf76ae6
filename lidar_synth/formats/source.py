"""``ScanFiles``, the base class of all readers: names of scans, reading by index, and the handling of bad scans."""

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
"""The handling of bad scans: raise an error on a scan that cannot be read, skip it with a warning, or drop points that
are NaN or infinite and count them."""

Choice = TypeVar("Choice")


class ScanFiles(ABC):
    """An indexable source of scans on disk; subclasses read one scan of their dataset.

    Args:
        root: the folder of the files.
        ids: the scans' names, unique in the source, in order.
        sensor: a preset's name, a YAML file or a ``Sensor``.
        on_bad: ``"error"`` raises on a scan that cannot be read. With ``"skip"``, ``source[i]`` is the next readable
            scan (after the last, the first one), iteration skips bad scans, and ``skipped`` lists them. With
            ``"drop-points"``, points that are NaN or infinite are dropped with their labels, and ``dropped`` counts
            them; any other fault raises.

    Attributes:
        skipped: {id: reason} of the scans that this process could not read.
        dropped: {id: number of points} that this process has dropped.
        domain: ``SYNTHETIC`` if the folder is marked as synthetic; otherwise each scan has its own domain.

    Raises:
        ConfigError: on an unknown ``on_bad``.
        DataError: if there is no scan.
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
        """Read the scan at ``index``, 0 <= index < len.

        Raises:
            DataError, FileError: if it cannot be read.
        """

    def load(self, index: int, drop_points: bool | None = None) -> Scan:
        """Read a scan, drop its bad points if required, and set the domain of the folder.

        Args:
            index: 0 <= index < len.
            drop_points: whether to drop bad points; by default whether ``on_bad`` is ``"drop-points"``.

        Raises:
            DataError, FileError: as ``read``; also if all points are dropped.
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
        """The camera calibration of scan ``index``; None if the dataset has none."""
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
            f"none of the {len(self)} scans of {self.root} can be read ({reason})", "at least one readable scan"
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
            # Loader workers have their own copy of ``skipped``, but their warnings reach the user.
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
