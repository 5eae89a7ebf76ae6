"""``mix``: labels that come with parts of real (or town) scans set into the synthetic one.

A mixed scan stays in the place, and keeps the id and the ``domain`` (``SYNTHETIC``), of the synthetic scan that it was
made from; which of its points come from elsewhere, ``confidence`` 1 tells at most. What is left of the synthetic scan
keeps the labels that its model gave it, or is ignored where it gave none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.exchange import swap_bands, swap_sector, thinned
from lidar_synth.labels.objects import Object, instances_of, objects_of
from lidar_synth.labels.own import Ignored, Own, generated
from lidar_synth.labels.pasting import paste

TRIES = 5
"""Objects tried for each that is wanted."""


@dataclass(frozen=True)
class Objects:
    """Objects of a bank with their boxes, for detectors.

    Args:
        own: what becomes of the scan's own labels.
        bank: where the objects are from.
        groups: from which of them (indices) to draw, and how many to place.
        least: points that must be seen of an object.
        turn: degrees to either side by which an object may be turned about the sensor.
        clear: take the returns of the scan's own objects away, which have no boxes.
    """

    own: Own | Ignored
    bank: ObjectBank
    groups: tuple[tuple[NDArray[np.intp], int], ...]
    least: int = 5
    turn: float = 0.0
    clear: bool = False

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        scan = self.own(scan, rng)
        if self.clear and scan.boxes is None and scan.label is not None:
            scan = scan[~np.isin(scan.label, np.unique(self.bank.label))]
        for indices, count in self.groups:
            picks = rng.choice(indices, min(TRIES * count, len(indices)), replace=False)
            angles = np.radians(rng.uniform(-self.turn, self.turn, len(picks)))
            candidates = (self._object(i, a) for i, a in zip(picks.tolist(), angles.tolist(), strict=True))
            scan = paste(scan, candidates, count=count, least=self.least)
        return scan

    def _object(self, index: int, angle: float) -> Object:
        return self.bank[index].turned(angle) if angle else self.bank[index]


@dataclass(frozen=True)
class Polar:
    """PolarMix: a sector of a real scan, and its objects turned about the sensor.

    Args:
        own: what becomes of the scan's own labels.
        real: labelled scans.
        width: degrees of the sector.
        objects: how many to place; at most all that the real scan has.
    """

    own: Own | Ignored
    real: Source
    width: float = 180.0
    objects: int = 10

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other, columns = _partner(self.real, scan, rng), scan.sensor.columns
        width = round(columns * self.width / 360)
        mixed = swap_sector(self.own(scan, rng), other, int(rng.integers(columns)), width)
        known = other.boxes is not None
        if self.objects:
            found = list(objects_of(other).values()) if known else instances_of(other)
            angles = rng.uniform(-np.pi, np.pi, len(found))
            turned = (found[i].turned(a) for i, a in zip(rng.permutation(len(found)), angles, strict=True))
            mixed = paste(mixed, turned, count=self.objects)
        return mixed if known else replace(mixed, boxes=None)  # boxes around some objects would deny the others


@dataclass(frozen=True)
class Laser:
    """LaserMix: bands of elevation, by turns from the synthetic and from a real scan.

    Args:
        own: what becomes of the scan's own labels.
        real: labelled scans.
        bands: how many bands, one of these.
    """

    own: Own | Ignored
    real: Source
    bands: Sequence[int] = (3, 4, 5, 6)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _partner(self.real, scan, rng)
        return swap_bands(self.own(scan, rng), other, int(rng.choice(self.bands)), bool(rng.integers(2)))


def _partner(real: Source, scan: Scan, rng: np.random.Generator) -> Scan:
    """A real scan on the grid of a synthetic one."""
    other = real[int(rng.integers(len(real)))]
    if other.label is None:
        raise DataError(f"scan {other.id!r} has no labels", "real scans with labels, all of them")
    return thinned(other, scan.sensor)


def objects(
    real: Source | None,
    fields: frozenset[str],
    objects: ObjectBank | str | Path | None = None,
    count: int | Mapping[str, int] = 10,
    least: int = 5,
    turn: float = 0.0,
    clear: bool = False,
    threshold: float = 0.0,
) -> Objects:
    """``mix`` with objects and their boxes.

    Args:
        real: the scans with boxes whose objects to take, if no bank is given; all of them are read.
        fields: of the synthetic scans.
        objects: a bank of objects, or its file.
        count: how many to place in a scan at most, in all or by the name of their boxes.
        least, turn, clear: see ``Objects``.
        threshold: of the synthetic scans' own labels, see ``generated``.

    Raises:
        ConfigError: where there are no boxes to take objects from, or none of a name; on other values.
    """
    wanted = count if isinstance(count, Mapping) else {"": count}
    if min(wanted.values(), default=0) < 1 or least < 1 or not 0 <= turn <= 180:
        raise ConfigError(
            f"count={count}, least={least}, turn={turn}", "at least one object, one point, 0..180 degrees"
        )
    bank = objects if isinstance(objects, ObjectBank) else _bank(real, objects, least)
    names, groups = np.array(bank.boxes.names), []
    for name, number in wanted.items():
        indices = np.flatnonzero((bank.counts >= least) & ((names == name) | (name == "")))
        if not len(indices):
            raise ConfigError(f"count={count}, least={least}", f"names and points of {bank} ({sorted(set(names))})")
        groups.append((indices, number))
    if clear and "label" not in fields:
        raise ConfigError("clear=True for synthetic scans without labels", "clear=False")
    return Objects(_own(fields, threshold), bank, tuple(groups), least, turn, clear)


def polar(
    real: Source | None,
    fields: frozenset[str],
    width: float = 180.0,
    objects: int = 10,
    threshold: float = 0.0,
) -> Polar:
    """``mix`` as PolarMix does it, see ``Polar``.

    Raises:
        ConfigError: without real scans that have labels and, for objects, boxes or instances; on other values.
    """
    if not 0 <= width <= 360 or objects < 0:
        raise ConfigError(f"width={width}, objects={objects}", "0..360 degrees, and a number of objects")
    real, first = _labelled(real, "polar")
    if objects and first.boxes is None and first.instance is None:
        raise ConfigError("kind='polar' with real scans that have neither boxes nor instances", "objects=0")
    return Polar(_own(fields, threshold), real, width, objects)


def laser(
    real: Source | None, fields: frozenset[str], bands: Sequence[int] = (3, 4, 5, 6), threshold: float = 0.0
) -> Laser:
    """``mix`` as LaserMix does it, see ``Laser``.

    Raises:
        ConfigError: without real scans that have labels; on fewer than two bands.
    """
    if not len(bands) or min(bands) < 2:
        raise ConfigError(f"bands={bands}", "numbers of bands, 2 and up")
    real, _ = _labelled(real, "laser")
    return Laser(_own(fields, threshold), real, tuple(bands))


def _own(fields: frozenset[str], threshold: float) -> Own | Ignored:
    return generated(None, fields, threshold) if "label" in fields else Ignored()


def _labelled(real: Source | None, kind: str) -> tuple[Source, Scan]:
    """The real scans and the first of them, which has to have labels."""
    if real is None or not len(real) or (first := real[0]).label is None:
        given = "none" if real is None or not len(real) else "scans without labels"
        raise ConfigError(
            f"labels='mix', kind={kind!r}, with {given}",
            "real scans with labels, such as SemanticKITTI or a town",
            "KITTI-360 and KITTI have none: use kind='objects' with boxes, or labels='generated'.",
        )
    return real, first


def _bank(real: Source | None, path: str | Path | None, least: int) -> ObjectBank:
    if path is not None:
        return ObjectBank.load(path)
    try:
        return ObjectBank.from_scans([] if real is None else real, least=least)
    except DataError as error:
        raise ConfigError(
            f"labels='mix', kind='objects': {error}",
            "real scans with boxes, or objects=",
            "A bank of objects is made by ObjectBank.from_scans(source).save(path); KITTI and the town have boxes.",
        ) from error
