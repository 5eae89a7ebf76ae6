"""Metrics for a training loop: ``update`` with scans of both sets, ``compute``, ``reset``.

They behave as those of torchmetrics: ``update(scans, real=True)`` collects, ``compute`` merges over
the processes of torch.distributed where it is initialised, ``reset(real=False)`` keeps the real
scans for the next epoch.
"""

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch.distributed
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.lab.evaluate.cache import checked
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.features import (
    Extractor,
    Figure,
    figures_beside,
    figures_of,
    load_extractors,
    statistic_of,
)
from lidar_synth.lab.evaluate.intervals import FEWEST, LEVEL, bootstrap
from lidar_synth.lab.evaluate.measures import KINDS
from lidar_synth.lab.evaluate.protocols import (
    FEATURES,
    Measure,
    Protocol,
    alike,
    find_protocol,
)

SIDES = ("real", "generated")


@dataclass(frozen=True)
class Score:
    """One value of a metric with its protocol.

    Args:
        metric: name of the metric.
        value: the value.
        protocol: name of the protocol that defines the metric.
        real: number of real scans.
        generated: number of generated scans.
        table: what the paper's tables call it; "" where no paper reports it.
        times: the factor by which the tables show it.
        low, high: its 95 % interval, if one was asked for and can be had.
        corrected: then, the value without the bias of few scans, which the interval is around.
    """

    metric: str
    value: float
    protocol: str
    real: int
    generated: int
    table: str = ""
    times: float = 1.0
    low: float | None = None
    high: float | None = None
    corrected: float | None = None

    def shown(self, times: float = 1.0, digits: int = 4) -> str:
        """The value times a factor, with its interval; beside a value that the interval does not
        contain, the corrected one."""
        text = f"{self.value * times:.{digits}g}"
        if self.low is None or self.high is None:
            return text
        if self.corrected and not self.low <= self.value <= self.high:
            text += f" (corrected {self.corrected * times:.4g})"
        return f"{text} [{self.low * times:.4g}, {self.high * times:.4g}]"

    def __str__(self) -> str:
        setting = (
            f"{self.protocol} protocol, {self.real} real, {self.generated} generated"
        )
        table = (
            f", in its tables {self.table} = {self.value * self.times:.4g}"
            if self.table
            else ""
        )
        return f"{self.metric} = {self.shown(digits=6)} ({setting}){table}"


@dataclass
class _Kept:
    """What is kept of one set.

    Args:
        descriptions: {kind and options: one description per scan}.
        features: {extractor: one array (n, D) per batch}.
        count: number of scans.
        sensor: of the first scan, and its id.
    """

    descriptions: dict[str, list[Any]] = field(default_factory=dict)
    features: dict[str, list[NDArray[np.floating]]] = field(default_factory=dict)
    count: int = 0
    sensor: tuple[Sensor, str] | None = None

    def add(self, other: "_Kept") -> None:
        for key, more in other.descriptions.items():
            self.descriptions.setdefault(key, []).extend(more)
        for key, arrays in other.features.items():
            self.features.setdefault(key, []).extend(arrays)
        self.count += other.count
        self.sensor = self.sensor or other.sensor


def _join_features(
    kept: Mapping[str, _Kept], name: str
) -> Iterator[NDArray[np.floating]]:
    """What an extractor found in the real and in the generated scans."""
    return (np.concatenate(kept[side].features[name]) for side in SIDES)


class Metric:
    """The figures of a protocol between real and generated scans that arrive in parts.

    Measures of features whose weights are missing, and measures of labels where scans have none,
    are left out; ``left_out`` says why.

    Args:
        protocol: a name of ``PROTOCOLS``, or a protocol.
        extractors: further feature extractors by name; each adds a Frechet distance and a squared
            maximum mean discrepancy.
        weights: folder with published weights; by default the one that LIDAR_SYNTH_METRICS names.
        replicates: resamples for a 95 % interval of each value; 0 = no intervals.
        extended: add unbiased forms, precision, recall, density and coverage of all features.
        any_sensor: whether to compare scans of sensors that differ.
        batch: number of scans that extractors process at a time.
        cache: folder in which features of published weights are kept, by the hash of scan and
            weights.

    Raises:
        ConfigError: on an unknown protocol, a missing folder, or too few resamples.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.lab.evaluate import Metric
        >>> metric = Metric("town")
        >>> metric.update([Town(1, scans=2)[i] for i in range(2)], real=True)
        >>> metric.update([Town(2, scans=2)[i] for i in range(2)], real=False)
        >>> sorted(metric.compute())
        ['BEV Jensen-Shannon distance', 'BEV maximum mean discrepancy']
    """

    def __init__(
        self,
        protocol: str | Protocol = "town",
        extractors: Mapping[str, Extractor] | None = None,
        weights: Path | None = None,
        replicates: int = 0,
        extended: bool = False,
        any_sensor: bool = False,
        batch: int = 16,
        cache: Path | None = None,
    ) -> None:
        if replicates and replicates < FEWEST:
            raise ConfigError(
                f"intervals from {replicates} resamples",
                f"at least {FEWEST}, or 0 for no intervals",
            )
        self.protocol = find_protocol(protocol)
        self.left_out: dict[str, str] = {}
        self._kept = {side: _Kept() for side in SIDES}
        self._published, missing = load_extractors(self.protocol, weights, cache)
        self._missing = missing
        self._extractors = dict(extractors or {})
        self._replicates = replicates
        self._extended = extended
        self._any_sensor = any_sensor
        self._batch = batch
        self.reset()

    @property
    def uses_weights(self) -> bool:
        """Whether any published weights were found for the protocol."""
        return bool(self._published)

    def reset(self, real: bool = True) -> None:
        """Forget the generated scans, and the real ones unless ``real`` is False."""
        self._kept = {
            "real": _Kept() if real else self._kept["real"],
            "generated": _Kept(),
        }
        self.left_out = dict(self._missing)

    def update(self, scans: Iterable[Scan], real: bool) -> None:
        """Collect scans.

        Args:
            scans: any number of them.
            real: whether they are real ones.

        Raises:
            DataError: on one scan that is no list, a scan without returns in the protocol's area,
                scans of sensors that differ, scans some of which have labels, and features that are
                not finite.
        """
        if isinstance(scans, Scan):
            raise DataError(f"scan {scans.id!r}", "a list of scans")
        remaining = iter(scans)
        while batch := list(islice(remaining, self._batch)):
            self._add(batch, SIDES[not real])

    def _add(self, scans: Sequence[Scan], side: str) -> None:
        own = scans[0].sensor, scans[0].id
        part = _Kept(count=len(scans), sensor=own)
        first = self._kept["real"].sensor or self._kept["generated"].sensor or own
        generated = side == "generated"
        for scan in scans:
            self._check_sensor(scan, side, first)
            for key, description in self._describe(scan, generated, side).items():
                part.descriptions.setdefault(key, []).append(description)
        for name, extract in self._extractors.items():
            part.features[name] = [checked(extract, scans)]
        for name, paired in self._published.items():
            part.features[_own(name)] = [checked(paired, scans, generated)]
        self._kept[side].add(part)

    def _describe(self, scan: Scan, generated: bool, side: str) -> dict[str, Any]:
        measures = [m for m in self.protocol.measures.values() if m.kind != FEATURES]
        described: dict[str, Any] = {}
        try:
            prepared = self.protocol.prepare.apply(scan, generated)
            for measure in measures:
                key = _key(measure)
                kind = KINDS[measure.kind]
                if key not in described and (scan.label is not None or not kind.labels):
                    described[key] = kind.describe(prepared, **measure.options)
        except DataError as error:
            raise DataError(f"{side} scan {scan.id!r}: {error}") from error
        return described

    def _check_sensor(self, scan: Scan, side: str, first: tuple[Sensor, str]) -> None:
        grid = self.protocol.prepare.grid
        if self._any_sensor:
            return
        given = f"{side} scan {scan.id!r} of sensor {_named(scan.sensor)}"
        if grid is not None and not alike(scan.sensor, grid):
            raise DataError(
                given,
                f"{_named(grid)}, the sensor of the {self.protocol.name} protocol",
                "The protocol town takes any sensor.",
            )
        if grid is None and not alike(scan.sensor, first[0]):
            raise DataError(
                given,
                f"that of scan {first[1]!r}, {_named(first[0])}",
                "Cast one set to the other's sensor first: docs/how-to/another-sensor.md.",
            )

    def merge(self, *others: "Metric") -> None:
        """Add what other metrics of the same protocol collected, in their order."""
        for other in others:
            for side in SIDES:
                self._kept[side].add(other._kept[side])

    def compute(self) -> dict[str, float]:
        """{name: value}; of all processes together where torch.distributed is initialised. Raises
        as ``scores``."""
        return {score.metric: score.value for score in self.scores()}

    def scores(self) -> list[Score]:
        """The figures with their protocol, table names and intervals; of all processes together.

        Raises:
            DataError: on an empty set, where no figure can be measured, or where an interval needs
                more scans.
        """
        kept = self._gathered()
        for side in SIDES:
            if kept[side].count == 0:
                raise DataError(f"no {side} scans", "at least one")
        scores = [
            score
            for name in self.protocol.measures
            if (score := self._score(name, kept)) is not None
        ]
        for name in self._extractors:
            real, fake = _join_features(kept, name)
            figures = figures_of(name, real, fake, self._extended)
            scores += self._of_figures(figures, kept)
        if self._extended:
            for name in self._published:
                table = self.protocol.measures[name].table or name
                figures = figures_beside(table, *_join_features(kept, _own(name)))
                scores += self._of_figures(figures, kept)
        if not scores:
            raise DataError(
                f"no figure of {self.protocol.name}: {'; '.join(self.left_out.values())}",
                "one at least",
            )
        return scores

    def _score(self, name: str, kept: Mapping[str, _Kept]) -> Score | None:
        measure = self.protocol.measures[name]
        if measure.kind == FEATURES:
            if name not in self._published:
                return None
            real, fake = _join_features(kept, _own(name))
            statistic = statistic_of(real, fake) if self._replicates else None
            return self._made(
                measure, frechet_distance(real, fake), statistic, len(real), len(fake)
            )
        both = [kept[side].descriptions.get(_key(measure), []) for side in SIDES]
        counts = [kept[side].count for side in SIDES]
        if KINDS[measure.kind].labels and [len(b) for b in both] != counts:
            if any(0 < len(b) < n for b, n in zip(both, counts, strict=True)):
                raise DataError(
                    "a set in which only some scans have labels",
                    "labels in all scans or in none",
                )
            self.left_out[name] = "scans without labels"
            return None
        real_scans = chosen(both[0], measure.real)
        fake_scans = both[1][: measure.generated]
        compare = KINDS[measure.kind].compare
        compared = compare(real_scans, fake_scans, **measure.options)
        value = compared.value
        if not np.isfinite(value):
            self.left_out[name] = "no finite value for these scans"
            return None
        return self._made(measure, value, compared, *compared.sizes)

    def _made(
        self,
        measure: Measure,
        value: float,
        statistic: Any,
        real: int,
        fake: int,
    ) -> Score:
        least = -np.inf if measure.least is None else measure.least
        return Score(
            measure.title,
            value,
            self.protocol.name,
            real,
            fake,
            measure.table,
            measure.times,
            *self._interval(statistic, (least, np.inf)),
        )

    def _of_figures(
        self, figures: Iterable[Figure], kept: Mapping[str, _Kept]
    ) -> list[Score]:
        real, fake = (kept[side].count for side in SIDES)
        scores = []
        for title, value, statistic, limits in figures:
            made = statistic() if self._replicates else None
            interval = self._interval(made, limits)
            name = self.protocol.name
            scores.append(Score(title, value(), name, real, fake, "", 1.0, *interval))
        return scores

    def _interval(
        self, statistic: Any, limits: tuple[float, float]
    ) -> tuple[float | None, ...]:
        """Low, high and corrected value, where they are asked for and can be had."""
        if statistic is None or not self._replicates:
            return ()
        return (
            bootstrap(
                statistic,
                self._replicates,
                LEVEL,
                smallest=limits[0],
                largest=limits[1],
            )
            or ()
        )

    def _gathered(self) -> dict[str, _Kept]:
        """Both sets of all processes, in the order of their ranks."""
        together = (
            torch.distributed.is_available() and torch.distributed.is_initialized()
        )
        if not together or torch.distributed.get_world_size() == 1:
            return self._kept
        parts: list[Any] = [None] * torch.distributed.get_world_size()
        torch.distributed.all_gather_object(parts, self._kept)
        merged = {side: _Kept() for side in SIDES}
        for part in parts:
            for side in SIDES:
                merged[side].add(part[side])
        return merged


def chosen(items: Sequence[Any], most: int | None) -> Sequence[Any]:
    """A fixed random choice of at most ``most`` items, as R2Flow's code makes it."""
    if most is None or len(items) <= most:
        return items
    return [items[i] for i in choice(len(items), most)]


def choice(count: int, most: int) -> list[int]:
    """The positions of ``chosen``."""
    order = list(range(count))
    random.Random(0).shuffle(order)
    return order[:most]


def _key(measure: Measure) -> str:
    """The same for measures that share their descriptions."""
    return f"{KINDS[measure.kind].describe.__name__} {sorted(measure.options.items())}"


def _own(name: str) -> str:
    """The features of a protocol's measure, told apart from those of a user's extractor of that
    name."""
    return f"measure {name}"


def _named(sensor: Sensor) -> str:
    return f"{sensor.name} ({sensor.shape[0]} rows, {sensor.up:.1f} to {sensor.down:.1f} degrees)"
