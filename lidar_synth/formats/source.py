"""``ScanFiles``, the base class of all readers: names of scans, reading by index, and the handling
of bad scans."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from lidar_synth.errors import ConfigError, DataError, FileError, suggest
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.description import FORMAT, NAME, read_description
from lidar_synth.formats.points import bad_points_kept, drop_bad_points
from lidar_synth.geometry import Scan, Sensor, index_of, load_sensor
from lidar_synth.geometry.agreement import MOST_OUTSIDE, agreement

OnBad = Literal["error", "skip", "drop-points"]
"""The handling of bad scans: raise an error on a scan that cannot be read, skip it with a warning,
or drop points that are NaN or infinite and count them."""

_TRIED = 8  # scans of which the first readable one is compared with the sensor
_NAME_IT = (
    "Name the sensor that recorded the scans, even if it is this one: --sensor NAME|FILE.yaml "
    f'(sensor=...), or {{"format": "{FORMAT}", "sensor": "NAME"}} in {NAME} in their folder. '
    "If no preset fits, or the points are in the frame of a vehicle: lidar-synth sensor fit."
)


class ScanFiles(ABC):
    """An indexable source of scans on disk; subclasses read one scan of their dataset.

    Args:
        root: the folder of the files.
        ids: the scans' names, unique in the source, in order.
        sensor: the sensor that the user names: a preset's name, a YAML file or a ``Sensor``; None
            to take the one that the files name, or else ``default_sensor``.
        on_bad: ``"error"`` raises on a scan that cannot be read. With ``"skip"``, ``source[i]`` is
            the next readable scan (after the last, the first one), iteration skips bad scans, and
            ``skipped`` lists them. With ``"drop-points"``, points that are NaN or infinite are
            dropped with their labels, and ``dropped`` counts them; any other fault raises.
        stored: the sensor that the files themselves name; None to read what stands beside them
            (``description.py``).

    If the user names another sensor than the files, the user's is taken, with a warning. If the
    files name none, the first scan that is read is compared with the sensor (``check_sensor``).

    Attributes:
        default_sensor: of the layout.
        plain: whether scans lie in folders of any name, all of which ``scans.json`` above them
            describes.
        description: what stands beside the files about all of their scans; None if there is
            nothing.
        options: further options of the reader that determine its scans, as plain values; those
            that are not chosen are missing, or have their default.
        skipped: {id: reason} of the scans that this process could not read.
        dropped: {id: number of points} that this process has dropped.

    Raises:
        ConfigError: on an unknown ``on_bad`` or sensor.
        DataError: if there is no scan, or what the files say is damaged.
    """

    default_sensor: ClassVar[str] = "hdl64e_kitti"
    plain: ClassVar[bool] = False
    _reflectance_max: float | None = None

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Whether a path looks like this layout."""
        return False

    def __init__(
        self,
        root: Path,
        ids: Sequence[str],
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
        *,
        stored: Sensor | None = None,
    ) -> None:
        if on_bad not in get_args(OnBad):
            hint = suggest(on_bad, get_args(OnBad))
            raise ConfigError(f"on_bad={on_bad!r}", f"one of {get_args(OnBad)}", hint)
        if not ids:
            raise DataError(
                f"{root} holds no scan",
                " ".join((self.__doc__ or "").split("\n\n")[0].split()).rstrip("."),
            )
        self.root = root
        self.ids = tuple(ids)
        self.description = (
            read_description(root, self.plain) if stored is None else None
        )
        named = stored if self.description is None else self.description.sensor
        self._given = None if sensor is None else load_sensor(sensor)
        self._named = self._given or named
        self.sensor = self._named or load_sensor(self.default_sensor)
        if named is not None and not named.same_grid(self.sensor):
            warnings.warn(
                f"{root} says that its scans are of sensor {named.name!r}; they are read as those "
                f"of {self.sensor.name!r}, which was given",
                stacklevel=3,
            )
        self._unchecked = named is None
        self._unknown = False
        self.on_bad = on_bad
        scale = self._reflectance_max
        self.options: dict[str, Any] = (
            {} if scale is None else {"reflectance_max": scale}
        )
        self.skipped: dict[str, str] = {}
        self.dropped: dict[str, int] = {}

    @abstractmethod
    def read(self, index: int) -> Scan:
        """Read the scan at ``index``, 0 <= index < len.

        Raises:
            DataError, FileError: if it cannot be read.
        """

    def load(self, index: int, drop_points: bool | None = None) -> Scan:
        """Read a scan, drop its bad points if required, and set the origin that the folder names.

        Args:
            index: 0 <= index < len.
            drop_points: whether to drop bad points; by default whether ``on_bad`` is
                ``"drop-points"``.

        Raises:
            DataError, FileError: as ``read``; also if all points are dropped.
            ConfigError: as ``check_sensor``, for the first scan that is read.
        """
        if drop_points if drop_points is not None else self.on_bad == "drop-points":
            with bad_points_kept():
                read = self.read(index)
            scan = drop_bad_points(read)
            if len(scan) < len(read):
                self.dropped[self.ids[index]] = len(read) - len(scan)
        else:
            scan = self.read(index)
        if self._unchecked:
            self._compare(scan)
        return scan if self.description is None else self.description.origin.apply(scan)

    def check_sensor(self) -> None:
        """Compare the first readable scan with the sensor, if the files name no sensor and no scan
        was read before.

        Points beside the beams are reported by a warning, as is everything about a sensor that the
        user named.

        Raises:
            ConfigError: if the sensor is the layout's own, and more than ``agreement.MOST_OUTSIDE``
                of the points lie outside of its field of view or its range limits.
        """
        for index in range(min(len(self), _TRIED)):
            if not self._unchecked:
                return
            with suppress(DataError, FileError), bad_points_kept():
                self._compare(self.read(index))

    def skip_sensor_check(self) -> None:
        """Do not compare any scan with the sensor, because it is not known yet: rings keep the
        file's numbers."""
        self._unchecked = False
        self._unknown = True

    def _compare(self, scan: Scan) -> None:
        shares = agreement(scan.points, self.sensor)
        if faults := shares.faults(self.sensor):
            given = (
                f"scan {scan.id} of {self.root}, read as one of sensor {self.sensor.name!r}: "
                f"{'; '.join(faults)}"
            )
            if self._given is None and shares.outside > MOST_OUTSIDE:
                raise ConfigError(given, "points of that sensor", _NAME_IT)
            warnings.warn(f"{given}. {_NAME_IT}", stacklevel=4)
        self._unchecked = False

    def files_for(self, fields: Set[str]) -> list[Path]:
        """The files and folders that fields of the scans come from; some may be missing.

        Args:
            fields: range, reflectance, label, or kinds of conditions (``CONDITIONS``).
        """
        return [self.root]

    def calibration(self, index: int) -> Calibration | None:
        """The camera calibration of scan ``index``; None if the dataset has none."""
        return None

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        names = f"{len(self)} scans, {self.ids[0]!r} to {self.ids[-1]!r}"
        return (
            f"{type(self).__name__}({str(self.root)!r}): {names}\n  sensor "
            f"{self.sensor.grid_text()}"
        )

    def __getitem__(self, index: int) -> Scan:
        index = index_of(index, len(self))
        if self.on_bad != "skip":
            return self.load(index)
        for step in range(len(self)):
            scan = self.load_or_skip((index + step) % len(self))
            if scan is not None:
                return scan
        reason = next(iter(self.skipped.values()))
        raise DataError(
            f"none of the {len(self)} scans of {self.root} can be read ({reason})",
            "at least one readable scan",
        )

    def __iter__(self) -> Iterator[Scan]:
        for index in range(len(self)):
            scan = self.load_or_skip(index)
            if scan is not None:
                yield scan

    def load_readable(self, indices: Iterable[int]) -> list[Scan]:
        """The scans at some indices, without those that ``load_or_skip`` skips."""
        return [scan for i in indices if (scan := self.load_or_skip(i)) is not None]

    def load_or_skip(self, index: int) -> Scan | None:
        """``load`` a scan; None, with a warning, if it cannot be read and ``on_bad`` is
        ``"skip"``."""
        if self.on_bad != "skip":
            return self.load(index)
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
