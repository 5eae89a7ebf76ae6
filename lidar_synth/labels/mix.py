"""Policies that insert labelled parts of real (or town) scans into the synthetic scan.

A mixed scan keeps the position, the id and the ``domain`` (``SYNTHETIC``) of its synthetic scan.
Inserted points are not marked; they have confidence 1. The remaining synthetic points keep the
labels of their model; if it gives none, they are ignored.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import BOXED
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.edit.redraw import open_model
from lidar_synth.labels.edit.unboxed import remove_unboxed
from lidar_synth.labels.exchange import swap_bands, swap_sector, thin_scan
from lidar_synth.labels.objects import THINGS, Object, instances_of, objects_of
from lidar_synth.labels.own import IgnoreLabels, KeepLabels, keep_own
from lidar_synth.labels.pasting import paste
from lidar_synth.labels.policies import LabelPolicy

TRIES = 5
"""Number of candidates that are tried for each object to be placed."""


@dataclass(frozen=True)
class PasteObjects:
    """``paste``: pastes objects of a bank with their boxes, for training detectors.

    Args:
        bank: the objects, or their file; None collects those of the real scans, all of which are
            read.
        count: maximum number of objects to place in a scan, in total or as ``{name of the boxes:
            number}``.
        least: minimum number of visible points of an object.
        turn: maximum angle, degrees to either side, by which an object is turned about the sensor.
        clear: whether to remove the scan's own objects that have no box, and to fill the holes; a
            detector would learn that they are background.
        model: draws the holes; None fills them by geometry, see ``edit.remove``.
        threshold: minimum confidence of the scan's own labels; those below it are ignored.

    Raises:
        ConfigError: on invalid values.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, ObjectBank, PasteObjects, Town
        >>> objects = ObjectBank.from_scans(Town(0, "hdl64e_lasers", scans=2))
        >>> bank = Bank("demo_out/bank")
        >>> policy = PasteObjects(objects, count=2).bind(None, bank.fields)
        >>> len(policy(bank[0], np.random.default_rng(0)).boxes) <= 2
        True
    """

    bank: ObjectBank | str | Path | None = None
    count: int | Mapping[str, int] = 10
    least: int = 5
    turn: float = 0.0
    clear: bool = True
    model: str | Path | None = None
    threshold: float = 0.0

    def __post_init__(self) -> None:
        enough = min(self._limits().values(), default=0) >= 1 and self.least >= 1
        if not (enough and 0 <= self.turn <= 180):
            raise ConfigError(
                f"count={self.count}, least={self.least}, turn={self.turn}",
                "at least one object, one point, 0..180 degrees",
            )

    def bind(self, real: Source | None, fields: frozenset[str]) -> LabelPolicy:
        """Open or collect the objects.

        Args:
            real: scans with boxes, from which objects are collected if no bank is given.
            fields: the fields of the synthetic scans.

        Raises:
            ConfigError: if there are no boxes, or none of a given name; if the synthetic scans have
                neither labels nor boxes, so that their own objects cannot be found.
        """
        if self.clear and not {"label", "boxes"} & fields:
            raise ConfigError(
                "labels='paste' for synthetic scans with neither labels nor boxes",
                "labels or boxes: without them their own objects cannot be found, and are "
                "background for a detector",
                "clear=False, if the scans hold no such objects.",
            )
        bank = self._open(real)
        groups = tuple(self._groups(bank))
        return _Pasting(keep_own(fields, self.threshold), self, bank, groups)

    def _limits(self) -> Mapping[str, int]:
        return self.count if isinstance(self.count, Mapping) else {"": self.count}

    def _open(self, real: Source | None) -> ObjectBank:
        if isinstance(self.bank, ObjectBank):
            return self.bank
        if self.bank is not None:
            return ObjectBank.load(self.bank)
        try:
            scans = [] if real is None else real
            return ObjectBank.from_scans(scans, least=self.least)
        except DataError as error:
            raise ConfigError(
                f"labels='paste': {error}",
                "real scans with boxes, or bank=",
                "ObjectBank.from_scans(source).save(path) makes a bank of objects; KITTI and the "
                "town have boxes.",
            ) from error

    def _groups(self, bank: ObjectBank) -> "list[tuple[NDArray[np.intp], int]]":
        """(indices of objects in the bank, number to place) pairs."""
        names = np.array(bank.boxes.names)
        groups = []
        for name, number in self._limits().items():
            named = (names == name) | (name == "")
            indices = np.flatnonzero((bank.counts >= self.least) & named)
            if not len(indices):
                raise ConfigError(
                    f"count={self.count}, least={self.least}",
                    f"names and points of {bank} ({sorted(set(names))})",
                )
            groups.append((indices, number))
        return groups


@dataclass(frozen=True)
class _Pasting:
    """``PasteObjects`` with its bank.

    Args:
        own: the policy for the scan's own labels.
        how: the settings.
        bank: the objects.
        groups: (indices of objects in the bank, number to place) pairs; objects are sampled from
            each group.
    """

    own: KeepLabels | IgnoreLabels
    how: PasteObjects
    bank: ObjectBank
    groups: tuple[tuple[NDArray[np.intp], int], ...]

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if self.how.clear:  # before labels of low confidence are ignored
            things = {label for label in np.unique(self.bank.label) if label < THINGS}
            model = open_model(self.how.model)
            seed = int(rng.integers(1 << 32))
            scan = remove_unboxed(scan, model, seed, {*BOXED, *map(int, things)})
        scan = self.own(scan, rng)
        turn = self.how.turn
        for indices, count in self.groups:
            picks = rng.choice(indices, min(TRIES * count, len(indices)), replace=False)
            angles = np.radians(rng.uniform(-turn, turn, len(picks)))
            pairs = zip(picks.tolist(), angles.tolist(), strict=True)
            candidates = (self._object(*pair) for pair in pairs)
            scan = paste(scan, candidates, count=count, least=self.how.least)
        return scan

    def _object(self, index: int, angle: float) -> Object:
        return self.bank[index].turned(angle) if angle else self.bank[index]


@dataclass(frozen=True)
class PolarMix:
    """``polarmix``: inserts a sector of a real scan, and its objects turned about the sensor
    (PolarMix, NeurIPS 2022).

    Args:
        width: width of the sector in degrees.
        objects: number of objects to place; at most all that the real scan has.
        threshold: minimum confidence of the scan's own labels; those below it are ignored.

    Raises:
        ConfigError: on invalid values.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PolarMix, open_scans
        >>> bank = Bank("demo_out/bank")
        >>> policy = PolarMix(width=90).bind(open_scans("demo_out/town"), bank.fields)
        >>> policy(bank[0], np.random.default_rng(0)).domain == bank[0].domain
        True
    """

    width: float = 180.0
    objects: int = 10
    threshold: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.width <= 360 or self.objects < 0:
            raise ConfigError(
                f"width={self.width}, objects={self.objects}",
                "0..360 degrees, and a number of objects",
            )

    def bind(self, real: Source | None, fields: frozenset[str]) -> "_SectorOf":
        """Draw from real scans.

        Raises:
            ConfigError: if they have no labels, or neither boxes nor instances for objects.
        """
        real, first = _labelled(real, "polarmix")
        if self.objects and first.boxes is None and first.instance is None:
            raise ConfigError(
                "labels='polarmix' with real scans that have neither boxes nor instances",
                "objects=0",
            )
        return _SectorOf(keep_own(fields, self.threshold), self, real)


@dataclass(frozen=True)
class _SectorOf:
    """``PolarMix`` with its real scans."""

    own: KeepLabels | IgnoreLabels
    how: PolarMix
    real: Source

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _partner(self.real, scan, rng)
        columns = scan.sensor.columns
        width = round(columns * self.how.width / 360)
        first = int(rng.integers(columns))
        mixed = swap_sector(self.own(scan, rng), other, first, width)
        has_boxes = other.boxes is not None
        if self.how.objects:
            objects = instances_of(other)
            if has_boxes:
                objects = list(objects_of(other).values())
            angles = rng.uniform(-np.pi, np.pi, len(objects))
            pairs = zip(rng.permutation(len(objects)), angles, strict=True)
            turned = (objects[i].turned(angle) for i, angle in pairs)
            mixed = paste(mixed, turned, count=self.how.objects)
        known = has_boxes and (scan.label is not None or scan.boxes is not None)
        # With boxes, all other objects would be negatives.
        return mixed if known else replace(mixed, boxes=None)


@dataclass(frozen=True)
class LaserMix:
    """``lasermix``: bands of elevation, alternately from the synthetic and from a real scan
    (LaserMix, CVPR 2023).

    Args:
        bands: numbers of bands, of which one is sampled for each scan.
        threshold: minimum confidence of the scan's own labels; those below it are ignored.

    Raises:
        ConfigError: on fewer than two bands.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, LaserMix, open_scans
        >>> bank = Bank("demo_out/bank")
        >>> policy = LaserMix(bands=[4]).bind(open_scans("demo_out/town"), bank.fields)
        >>> policy(bank[0], np.random.default_rng(0)).domain == bank[0].domain
        True
    """

    bands: Sequence[int] = (3, 4, 5, 6)
    threshold: float = 0.0

    def __post_init__(self) -> None:
        if not len(self.bands) or min(self.bands) < 2:
            raise ConfigError(f"bands={self.bands}", "numbers of bands, 2 or more each")

    def bind(self, real: Source | None, fields: frozenset[str]) -> "_BandsOf":
        """Draw from real scans.

        Raises:
            ConfigError: if they have no labels.
        """
        real, _ = _labelled(real, "lasermix")
        return _BandsOf(keep_own(fields, self.threshold), self, real)


@dataclass(frozen=True)
class _BandsOf:
    """``LaserMix`` with its real scans."""

    own: KeepLabels | IgnoreLabels
    how: LaserMix
    real: Source

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _partner(self.real, scan, rng)
        own = self.own(scan, rng)
        bands = int(rng.choice(self.how.bands))
        return swap_bands(own, other, bands, bool(rng.integers(2)))


@dataclass(frozen=True)
class PolarMixOrLaserMix:
    """``polarmix_or_lasermix``: each for half of the scans at random.

    Args:
        width, objects: as for ``PolarMix``.
        bands: as for ``LaserMix``.
        threshold: minimum confidence of the scan's own labels; those below it are ignored.

    Raises:
        ConfigError: as both.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PolarMixOrLaserMix, open_scans
        >>> bank = Bank("demo_out/bank")
        >>> policy = PolarMixOrLaserMix().bind(open_scans("demo_out/town"), bank.fields)
        >>> policy(bank[0], np.random.default_rng(0)).domain == bank[0].domain
        True
    """

    width: float = 180.0
    objects: int = 10
    bands: Sequence[int] = (3, 4, 5, 6)
    threshold: float = 0.0

    def __post_init__(self) -> None:
        self._both()

    def bind(self, real: Source | None, fields: frozenset[str]) -> "_EitherOf":
        """Draw from real scans.

        Raises:
            ConfigError: as both.
        """
        polar, laser = self._both()
        return _EitherOf(polar.bind(real, fields), laser.bind(real, fields))

    def _both(self) -> tuple[PolarMix, LaserMix]:
        polar = PolarMix(self.width, self.objects, self.threshold)
        return polar, LaserMix(self.bands, self.threshold)


@dataclass(frozen=True)
class _EitherOf:
    polar: _SectorOf
    laser: _BandsOf

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return (self.polar if rng.random() < 0.5 else self.laser)(scan, rng)


def _partner(real: Source, scan: Scan, rng: np.random.Generator) -> Scan:
    """A random real scan, thinned to the grid of a synthetic one."""
    other = real[int(rng.integers(len(real)))]
    if other.label is None:
        raise DataError(
            f"scan {other.id!r} has no labels", "real scans with labels, all of them"
        )
    return thin_scan(other, scan.sensor)


def _labelled(real: Source | None, name: str) -> tuple[Source, Scan]:
    """Check that the real scans have labels, and return the scans and the first of them."""
    if real is None or not len(real) or (first := real[0]).label is None:
        given = "none" if real is None or not len(real) else "scans without labels"
        raise ConfigError(
            f"labels={name!r}, with {given}",
            "real scans with labels, such as SemanticKITTI or a town",
            "KITTI-360 and KITTI have no labels: use labels='paste' with boxes, or "
            "labels='generated'.",
        )
    return real, first
