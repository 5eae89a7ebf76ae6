"""Policies that insert labelled parts of real (or town) scans into the synthetic scan.

A mixed scan keeps the position, the id and the ``domain`` (``SYNTHETIC``) of its synthetic
scan. Inserted points are not marked; they have confidence 1. The remaining synthetic points
keep the labels of their model; if it gives none, they are ignored.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import BOXED
from lidar_synth.errors import ConfigError, DataError, check_count
from lidar_synth.geometry import Scan, Source, check_source
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.edit.redraw import open_model
from lidar_synth.labels.edit.unboxed import remove_unboxed
from lidar_synth.labels.exchange import swap_bands, swap_sector, thin_scan
from lidar_synth.labels.objects import THINGS, Object, instances_of, objects_of
from lidar_synth.labels.own import (
    check_own,
    check_share,
    keep_own,
    require_label,
)
from lidar_synth.labels.pasting import paste, paste_groups

TRIES = 5
"""Number of candidates that are tried for each object to be placed."""


@dataclass(frozen=True)
class PasteObjects:
    """``paste``: pastes objects of a bank with their boxes, for training detectors.

    Args:
        bank: the objects, or their file; "town" takes ``ObjectBank.from_town``; None
            collects the objects in the boxes of the mixture's real scans, all of which are
            read.
        count: maximum number of objects to place in a scan, in total or as ``{name of the
            boxes: number}``; they are sampled at random.
        least: minimum number of visible points of an object.
        turn: maximum angle, 0 to 180 degrees to either side, by which an object is turned
            about the sensor.
        clear: whether to remove the scan's own objects that have no box, and to fill the
            holes; a detector would learn that they are background. "same", for a segmenter,
            removes only those of the classes that are pasted, and gives a scan without boxes none.
        model: draws the holes, a generator, its name or file; None fills them by geometry,
            see ``edit.remove``.
        threshold: minimum confidence of the scan's own labels, 0 to 1; labels below it
            become 255 = ignore.

    Raises:
        ConfigError: on invalid values.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, ObjectBank, PasteObjects, Town
        >>> objects = ObjectBank.from_scans(Town(0, "hdl64e_lasers", 2))
        >>> policy = PasteObjects(objects, count=8)  # as labels= of a mixture
        >>> scan = policy(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> 0 < len(scan.boxes) <= 8
        True
    """

    bank: ObjectBank | str | Path | None = None
    count: int | Mapping[str, int] = 10
    least: int = 5
    turn: float = 0.0
    clear: bool | str = True
    model: str | Path | None = None
    threshold: float = 0.0

    def __post_init__(self) -> None:
        for name, number in self._limits.items():
            check_count(f"count {name}".strip(), number, 1)
        check_count("least", self.least, 1)
        check_share("turn", self.turn, 180)
        check_share("threshold", self.threshold)
        if self.clear not in (True, False, "same"):
            raise ConfigError(f"clear={self.clear!r}", 'True, False or "same"')

    def bind(self, real: Source | None, fields: frozenset[str]) -> "PasteObjects":
        """The policy with the objects of real scans, if it has no others.

        Raises:
            ConfigError: if there are no boxes, or none of a given name; if the synthetic
                scans have neither labels nor boxes, so that their own objects cannot be
                found, or with "same" no labels.
            FileError, DataError: if a file of objects cannot be read.
        """
        check_own(self.threshold, fields)
        if self.clear == "same":
            require_label("paste", fields)
        bound = self
        if self.bank is None:
            bound = replace(self, bank=_collect_objects(real, self.least))
        bound._groups  # noqa: B018 - raises where there is nothing to paste
        if self.clear and not {"label", "boxes"} & fields:
            raise ConfigError(
                "labels='paste' for synthetic scans with neither labels nor boxes",
                "labels or boxes: without them their own objects cannot be found, and are "
                "background for a detector",
                "clear=False, if the scans hold no such objects.",
            )
        return bound

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        boxed = scan.boxes is not None or self.clear != "same"
        if self.clear:  # before labels of low confidence are ignored
            model = open_model(self.model)
            seed = int(rng.integers(1 << 32))
            scan = remove_unboxed(scan, model, seed, self._cleared)
        scan = keep_own(scan, rng, self.threshold)
        scan = paste_groups(scan, self._candidates(rng), self.least)
        return scan if boxed else replace(scan, boxes=None)

    def _candidates(
        self, rng: np.random.Generator
    ) -> Iterator[tuple[Iterator[Object], int]]:
        """(objects to try, number to place) pairs."""
        for indices, count in self._groups:
            picks = rng.choice(indices, min(TRIES * count, len(indices)), replace=False)
            angles = np.radians(rng.uniform(-self.turn, self.turn, len(picks)))
            yield map(self._object, picks.tolist(), angles.tolist()), count

    @property
    def _limits(self) -> Mapping[str, int]:
        """Number of objects to place by the name of their boxes; "" = any."""
        return self.count if isinstance(self.count, Mapping) else {"": self.count}

    @cached_property
    def _objects(self) -> ObjectBank:
        if isinstance(self.bank, ObjectBank):
            return self.bank
        if self.bank is None:
            return _collect_objects(None, self.least)
        if self.bank == "town":
            return _objects_of_town(tuple(self._limits))
        return ObjectBank.load(self.bank)

    @cached_property
    def _cleared(self) -> set[int]:
        """Classes of the scan's own objects that are removed."""
        labels = np.unique(self._objects.label)
        others = () if self.clear == "same" else BOXED
        return {*others, *labels[labels < THINGS].tolist()}

    @cached_property
    def _groups(self) -> list[tuple[NDArray[np.intp], int]]:
        """(indices of objects in the bank, number to place) pairs."""
        bank = self._objects
        names = np.array(bank.boxes.names)
        groups = []
        for name, number in self._limits.items():
            fits = (bank.counts >= self.least) & ((names == name) | (name == ""))
            if not fits.any():
                raise ConfigError(
                    f"count={self.count}, least={self.least}",
                    f"names and points of {bank} ({sorted(set(bank.boxes.names))})",
                )
            groups.append((np.flatnonzero(fits), number))
        return groups

    def _object(self, index: int, angle: float) -> Object:
        return self._objects[index].turned(angle) if angle else self._objects[index]


@dataclass(frozen=True)
class _RealMix:
    """A policy that draws from labelled scans."""

    def bind(self: Any, real: Source | None, fields: frozenset[str]) -> Any:
        """The policy with real scans, if it has no others.

        Raises:
            ConfigError: if they have no labels, or neither boxes nor instances for objects.
        """
        check_own(self.threshold, fields)
        bound = replace(self, real=real if self.real is None else self.real)
        policy = type(self).__name__
        first = _first_labelled(bound.real, policy)
        if (
            getattr(self, "objects", 0)
            and first.boxes is None
            and first.instance is None
        ):
            raise ConfigError(
                f"{policy} with real scans that have neither boxes nor instances",
                "objects=0",
            )
        return bound


@dataclass(frozen=True)
class PolarMix(_RealMix):
    """``polarmix``: inserts a sector of a random real scan, and objects of it turned about the
    sensor (Xiao et al., "PolarMix", NeurIPS 2022).

    Args:
        width: width of the sector, 0 to 360 degrees.
        objects: number of objects to place; at most all that the real scan has.
        threshold: minimum confidence of the scan's own labels, 0 to 1; labels below it
            become 255 = ignore.
        real: labelled scans; None takes the mixture's real scans.

    Raises:
        ConfigError: on invalid values.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PolarMix, Town
        >>> policy = PolarMix(width=90, objects=0, real=Town(0, "hdl64e_lasers", 2))
        >>> scan = policy(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> scan.domain, scan.label.shape == (len(scan),)
        (1, True)
    """

    width: float = 180.0
    objects: int = 10
    threshold: float = 0.0
    real: Source | None = None

    def __post_init__(self) -> None:
        check_share("width", self.width, 360)
        check_count("objects", self.objects, 0)
        check_share("threshold", self.threshold)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _draw_real(self.real, type(self).__name__, scan, rng)
        columns = scan.sensor.columns
        width = round(columns * self.width / 360)
        labelled = keep_own(scan, rng, self.threshold)
        mixed = swap_sector(labelled, other, int(rng.integers(columns)), width)
        if self.objects:
            mixed = self._add_objects(mixed, other, rng)
        known = scan.label is not None or scan.boxes is not None
        if other.boxes is not None and known:
            return mixed
        # Boxes of some objects only would make all others negatives of a detector.
        return replace(mixed, boxes=None)

    def _add_objects(self, mixed: Scan, other: Scan, rng: np.random.Generator) -> Scan:
        objects = (
            instances_of(other)
            if other.boxes is None
            else list(objects_of(other).values())
        )
        angles = rng.uniform(-np.pi, np.pi, len(objects))
        order = rng.permutation(len(objects))
        turned = (objects[i].turned(a) for i, a in zip(order, angles, strict=True))
        return paste(mixed, turned, count=self.objects)


@dataclass(frozen=True)
class LaserMix(_RealMix):
    """``lasermix``: bands of elevation, alternately from the synthetic and from a random real
    scan (Kong et al., "LaserMix", CVPR 2023).

    Args:
        bands: numbers of bands, 2 or more each, of which one is sampled for each scan.
        threshold: minimum confidence of the scan's own labels, 0 to 1; labels below it
            become 255 = ignore.
        real: labelled scans; None takes the mixture's real scans.

    Raises:
        ConfigError: on invalid values.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, LaserMix, Town
        >>> policy = LaserMix(bands=(4,), real=Town(0, "hdl64e_lasers", 2))
        >>> scan = policy(Bank("demo_out/bank")[0], np.random.default_rng(0))
        >>> scan.boxes is None  # few objects fit into a band
        True
    """

    bands: Sequence[int] = (3, 4, 5, 6)
    threshold: float = 0.0
    real: Source | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.bands, Sequence) or not self.bands:
            raise ConfigError(
                f"bands {self.bands!r}", "numbers of bands, such as [3, 4]"
            )
        for number in self.bands:
            check_count("bands", number, 2)
        check_share("threshold", self.threshold)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        other = _draw_real(self.real, "LaserMix", scan, rng)
        bands = int(rng.choice(self.bands))
        odd = bool(rng.integers(2))
        return swap_bands(keep_own(scan, rng, self.threshold), other, bands, odd)


@dataclass(frozen=True)
class PolarMixOrLaserMix(PolarMix):
    """``polarmix_or_lasermix``: PolarMix or LaserMix, each for half of the scans at random; the
    arguments are those of ``PolarMix``.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, PolarMixOrLaserMix, Town
        >>> policy = PolarMixOrLaserMix(real=Town(0, "hdl64e_lasers", 2))
        >>> scans = [policy(Bank("demo_out/bank")[0], np.random.default_rng(n)) for n in range(4)]
        >>> {scan.boxes is None for scan in scans} == {True, False}
        True
    """

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if rng.random() < 0.5:
            return super().__call__(scan, rng)
        return LaserMix(threshold=self.threshold, real=self.real)(scan, rng)


def _draw_real(
    real: Source | None, policy: str, scan: Scan, rng: np.random.Generator
) -> Scan:
    """A random real scan, thinned to the grid of a synthetic one."""
    if real is None:
        raise _no_labels("no real scans", policy)
    other = real[int(rng.integers(len(real)))]
    if other.label is None:
        given = f"scan {other.id!r} has no labels"
        raise DataError(given, "real scans with labels, all of them")
    return thin_scan(other, scan.sensor)


def _first_labelled(real: Source | None, policy: str) -> Scan:
    """The first of the real scans, after checking that it has labels."""
    check_source(real or ())
    if not real:
        raise _no_labels("no real scans", policy)
    first = real[0]
    if first.label is None:
        raise _no_labels("real scans without labels", policy)
    return first


def _no_labels(given: str, policy: str) -> ConfigError:
    return ConfigError(
        f"{policy} with {given}",
        "real scans with labels, such as SemanticKITTI or a town",
        f"Give {policy}(real=scans), in YAML real: FOLDER. KITTI-360 and KITTI have no labels: use "
        "labels='paste' with boxes, or labels='generated'.",
    )


@lru_cache(maxsize=2)
def _objects_of_town(names: tuple[str, ...]) -> ObjectBank:
    """Objects of the town with boxes of these names; "" = any."""
    bank: ObjectBank = ObjectBank.from_town(classes=None if "" in names else names)
    return bank


def _collect_objects(real: Source | None, least: int) -> ObjectBank:
    try:
        return ObjectBank.from_scans(real or [], least=least)
    except DataError as error:
        without = "labels='paste' without real scans to take objects from"
        raise ConfigError(
            f"labels='paste': {error}" if real else without,
            hint='bank= gives other objects: "town", or the file that '
            "ObjectBank.from_scans(source).save(path) writes; KITTI and the town have boxes.",
        ) from error
