"""``mix``: labelled parts of real (or town) scans are inserted into the synthetic scan.

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
from lidar_synth.labels.own import Ignored, Own, generated
from lidar_synth.labels.pasting import paste

TRIES = 5
"""Number of candidates that are tried for each object to be placed."""


@dataclass(frozen=True)
class Objects:
    """Pastes objects of a bank with their boxes, for training detectors.

    Args:
        own: the policy for the scan's own labels.
        bank: the bank of objects.
        groups: (indices of objects in the bank, number to place) pairs; objects are sampled from
            each group.
        least: minimum number of visible points of an object.
        turn: maximum angle, degrees to either side, by which an object is turned about the sensor.
        clear: whether to remove the scan's own objects that have no box, and to fill the holes; a
            detector would learn that they are background.
        model: draws the holes; None fills them by geometry, see ``edit.remove``.
    """

    own: Own | Ignored
    bank: ObjectBank
    groups: tuple[tuple[NDArray[np.intp], int], ...]
    least: int = 5
    turn: float = 0.0
    clear: bool = True
    model: str | Path | None = None

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if self.clear:  # before labels of low confidence are ignored
            things = {
                int(label) for label in np.unique(self.bank.label) if label < THINGS
            }
            scan = remove_unboxed(
                scan,
                open_model(self.model),
                int(rng.integers(1 << 32)),
                {*BOXED, *things},
            )
        scan = self.own(scan, rng)
        for indices, count in self.groups:
            picks = rng.choice(indices, min(TRIES * count, len(indices)), replace=False)
            angles = np.radians(rng.uniform(-self.turn, self.turn, len(picks)))
            candidates = (
                self._object(i, a)
                for i, a in zip(picks.tolist(), angles.tolist(), strict=True)
            )
            scan = paste(scan, candidates, count=count, least=self.least)
        return scan

    def _object(self, index: int, angle: float) -> Object:
        return self.bank[index].turned(angle) if angle else self.bank[index]


@dataclass(frozen=True)
class Polar:
    """PolarMix: inserts a sector of a real scan, and its objects turned about the sensor.

    Args:
        own: the policy for the scan's own labels.
        real: labelled scans.
        width: width of the sector in degrees.
        objects: number of objects to place; at most all that the real scan has.
    """

    own: Own | Ignored
    real: Source
    width: float = 180.0
    objects: int = 10

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _partner(self.real, scan, rng)
        columns = scan.sensor.columns
        width = round(columns * self.width / 360)
        mixed = swap_sector(
            self.own(scan, rng), other, int(rng.integers(columns)), width
        )
        has_boxes = other.boxes is not None
        if self.objects:
            objects = (
                list(objects_of(other).values()) if has_boxes else instances_of(other)
            )
            angles = rng.uniform(-np.pi, np.pi, len(objects))
            turned = (
                objects[i].turned(a)
                for i, a in zip(rng.permutation(len(objects)), angles, strict=True)
            )
            mixed = paste(mixed, turned, count=self.objects)
        known = has_boxes and (scan.label is not None or scan.boxes is not None)
        # With boxes, all other objects would be negatives.
        return mixed if known else replace(mixed, boxes=None)


@dataclass(frozen=True)
class Laser:
    """LaserMix: bands of elevation, alternately from the synthetic and from a real scan.

    Args:
        own: the policy for the scan's own labels.
        real: labelled scans.
        bands: numbers of bands, of which one is sampled for each scan.
    """

    own: Own | Ignored
    real: Source
    bands: Sequence[int] = (3, 4, 5, 6)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _partner(self.real, scan, rng)
        return swap_bands(
            self.own(scan, rng),
            other,
            int(rng.choice(self.bands)),
            bool(rng.integers(2)),
        )


@dataclass(frozen=True)
class Exchange:
    """PolarMix or LaserMix, each for half of the scans at random.

    Args:
        polar, laser: the two policies.
    """

    polar: Polar
    laser: Laser

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


def objects(
    real: Source | None,
    fields: frozenset[str],
    objects: ObjectBank | str | Path | None = None,
    count: int | Mapping[str, int] = 10,
    least: int = 5,
    turn: float = 0.0,
    clear: bool = True,
    model: str | Path | None = None,
    threshold: float = 0.0,
) -> Objects:
    """Make the policy ``mix`` that pastes objects and their boxes.

    Args:
        real: scans with boxes, from which objects are collected if no bank is given; all of them
            are read.
        fields: the fields of the synthetic scans.
        objects: a bank of objects, or its file.
        count: maximum number of objects to place in a scan, in total or as ``{name of the boxes:
            number}``.
        least, turn, clear, model: see ``Objects``.
        threshold: minimum confidence of the synthetic scans' own labels, see ``generated``.

    Raises:
        ConfigError: if there are no boxes, or none of a given name; if the synthetic scans have
            neither labels nor boxes, so that their own objects cannot be found; on other invalid
            values.
    """
    limits = count if isinstance(count, Mapping) else {"": count}
    if min(limits.values(), default=0) < 1 or least < 1 or not 0 <= turn <= 180:
        raise ConfigError(
            f"count={count}, least={least}, turn={turn}",
            "at least one object, one point, 0..180 degrees",
        )
    bank = objects if isinstance(objects, ObjectBank) else _bank(real, objects, least)
    names = np.array(bank.boxes.names)
    groups = []
    for name, number in limits.items():
        indices = np.flatnonzero(
            (bank.counts >= least) & ((names == name) | (name == ""))
        )
        if not len(indices):
            raise ConfigError(
                f"count={count}, least={least}",
                f"names and points of {bank} ({sorted(set(names))})",
            )
        groups.append((indices, number))
    if clear and not {"label", "boxes"} & fields:
        raise ConfigError(
            "labels='mix', kind='objects', for synthetic scans with neither labels nor boxes",
            "labels or boxes: without them their own objects cannot be found, and are background "
            "for a detector",
            "clear=False, if the scans hold no such objects.",
        )
    return Objects(
        _own(fields, threshold), bank, tuple(groups), least, turn, clear, model
    )


def polar(
    real: Source | None,
    fields: frozenset[str],
    width: float = 180.0,
    objects: int = 10,
    threshold: float = 0.0,
) -> Polar:
    """Make the policy ``mix`` by PolarMix, see ``Polar``.

    Raises:
        ConfigError: if the real scans have no labels, or neither boxes nor instances for objects;
            on invalid values.
    """
    if not 0 <= width <= 360 or objects < 0:
        raise ConfigError(
            f"width={width}, objects={objects}",
            "0..360 degrees, and a number of objects",
        )
    real, first = _labelled(real, "polar")
    if objects and first.boxes is None and first.instance is None:
        raise ConfigError(
            "kind='polar' with real scans that have neither boxes nor instances",
            "objects=0",
        )
    return Polar(_own(fields, threshold), real, width, objects)


def laser(
    real: Source | None,
    fields: frozenset[str],
    bands: Sequence[int] = (3, 4, 5, 6),
    threshold: float = 0.0,
) -> Laser:
    """Make the policy ``mix`` by LaserMix, see ``Laser``.

    Raises:
        ConfigError: if the real scans have no labels; on fewer than two bands.
    """
    if not len(bands) or min(bands) < 2:
        raise ConfigError(f"bands={bands}", "numbers of bands, 2 or more each")
    real, _ = _labelled(real, "laser")
    return Laser(_own(fields, threshold), real, tuple(bands))


def exchange(
    real: Source | None,
    fields: frozenset[str],
    width: float = 180.0,
    objects: int = 10,
    threshold: float = 0.0,
) -> Exchange:
    """Make the policy ``mix`` by PolarMix or LaserMix at random; the arguments and errors are those
    of both."""
    return Exchange(
        polar(real, fields, width, objects, threshold),
        laser(real, fields, threshold=threshold),
    )


def _own(fields: frozenset[str], threshold: float) -> Own | Ignored:
    return (
        generated(None, fields, threshold)
        if "label" in fields
        else Ignored(boxed="boxes" in fields)
    )


def _labelled(real: Source | None, kind: str) -> tuple[Source, Scan]:
    """Check that the real scans have labels, and return the scans and the first of them."""
    if real is None or not len(real) or (first := real[0]).label is None:
        given = "none" if real is None or not len(real) else "scans without labels"
        raise ConfigError(
            f"labels='mix', kind={kind!r}, with {given}",
            "real scans with labels, such as SemanticKITTI or a town",
            "KITTI-360 and KITTI have no labels: use kind='objects' with boxes, or "
            "labels='generated'.",
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
            "ObjectBank.from_scans(source).save(path) makes a bank of objects; KITTI and the "
            "town have boxes.",
        ) from error
