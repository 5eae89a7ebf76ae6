"""The plan of a comparison: places, labelled scans, trainings, and what fits into the time.

A *pair* is a place that is left out and a seed; it has one training of every arm, on the same labelled scans. Only
whole pairs are compared.
"""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.datasets.recordings import PLACES, TOWN, Recordings, frames_of
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.evaluate.leakage import recordings_of
from lidar_synth.formats import layout_of
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.labels.exchange import thinned
from lidar_synth.mixing.sources import sensor_of
from lidar_synth.models.segmenter import RangeSegmenter
from lidar_synth.proof.arms import Row, rows
from lidar_synth.proof.places import Places, choose, find_places, names_of
from lidar_synth.proof.pools import MOST_SKIN_SCANS, SKIN_STREETS
from lidar_synth.proof.scores import GROUPS, Groups, groups_of, require_labels
from lidar_synth.proof.settings import MOST_LABELLED, ProofSettings
from lidar_synth.train.precision import faster_in_bfloat16
from lidar_synth.train.segmentation import train_segmenter

Pair = tuple[str, int]
"""The place that is left out, and the seed."""

FORMAT = "lidar-synth-proof/2"
TOWN_SECONDS, SKIN_SECONDS, GENERATOR_SECONDS = 0.5, 1.5, 1.0
"""Processor time for a scan of the town, a scan that a skin is learnt from, and a generated scan."""
OVERHEAD = 1.3
"""Time of a training over that of its steps: loading, tests, a busy machine."""


@dataclass(frozen=True)
class ProofPlan:
    """All that is known before the first training.

    Args:
        settings: what was asked for.
        places: {name: indices of its scans}.
        names: of all scans.
        sensor: of the scans.
        grid: on which they are thinned; None to keep all returns.
        rows: the arms.
        groups: the scored classes.
        absent: those that no label has.
        pairs: in the order in which they are trained.
        wanted: number of pairs without a limit of time.
        labelled: {pair: indices of the labelled scans that are trained on}.
        tested: {place: indices of the scans that are tested on}.
        recordings: of the tested scans.
        half: whether the reference network computes in bfloat16.
        step: seconds of one of its iterations.
        minutes: expected for all pairs, with ``jobs`` processes.
        jobs: processes.
    """

    settings: ProofSettings
    places: Places
    names: tuple[str, ...]
    sensor: Sensor
    grid: Sensor | None
    rows: list[Row]
    groups: Groups
    absent: list[str]
    pairs: list[Pair]
    wanted: int
    labelled: dict[Pair, list[int]]
    tested: dict[str, list[int]]
    recordings: Recordings
    half: bool
    step: float
    minutes: float
    jobs: int

    @property
    def budget(self) -> int:
        """Number of labelled scans that a training gets."""
        return len(next(iter(self.labelled.values())))

    def skin_scans(self, place: str) -> list[int]:
        """Indices of the scans, of other places than this, that a skin is learnt from; their labels are not used."""
        indices = [i for name, members in self.places.items() if name != place for i in members]
        return _spread(indices, MOST_SKIN_SCANS)

    def seconds(self, row: Row) -> float:
        """Expected seconds of the iterations of a training, without a pretraining that it shares with others."""
        shared = row.pretraining.share if row.pretraining and self.step else 0
        return self.settings.iterations * row.arm.iterations * (1 - shared) * self.step

    def identity(self) -> dict[str, Any]:
        """Plain values that determine every training, to tell whether one that exists may be kept."""
        own = asdict(self.settings)
        free = ("arms", "ratios", "seeds", "classes", "only")  # they add trainings, or score the same ones
        digest = hashlib.sha256("\n".join(self.names).encode()).hexdigest()
        return {
            "format": FORMAT, "scans": digest, "sensor": self.sensor.name, "half": self.half,
            **{name: value for name, value in own.items() if name not in free},
        }  # fmt: skip


def make_plan(
    source: Source, settings: ProofSettings, minutes: float | None, jobs: int, half: bool | None = None
) -> tuple[ProofPlan, dict[int, Scan]]:
    """Plan a comparison.

    Args:
        source: labelled scans.
        settings: what is asked for.
        minutes: limit of the time; None for all places and seeds.
        jobs: processes.
        half: whether to compute in bfloat16; by default what is faster on this machine.

    Returns:
        The plan, and {index: scan on the grid} of all labelled and tested scans.

    Raises:
        ConfigError: on settings that do not fit the scans, or too short a time.
        DataError: on one place only, on scans without labels, or on a class that nothing is labelled as.
    """
    arms = rows(settings.arms, settings.ratios)
    groups = groups_of(_classes(source, settings.classes), settings.only)
    places = find_places(source, settings.places)
    sensor = sensor_of(source)
    grid = None if settings.columns is None else replace(sensor, columns=settings.columns)
    rng = np.random.default_rng(settings.seed)
    order = [list(places)[i] for i in rng.permutation(len(places))]
    pairs = [(place, seed) for seed in range(settings.seeds) for place in order]
    labelled = {pair: _labelled(places, pair, settings) for pair in pairs}
    tested = {place: _spread(indices, settings.tested) for place, indices in places.items()}
    needed = sorted({i for part in (*labelled.values(), *tested.values()) for i in part})
    scans = {i: _read(source, i, grid) for i in needed}
    absent = require_labels(_counts(scans), groups, settings.only)
    batch = [scans[i] for i in needed[: settings.batch]]
    half, step = _step(batch, settings, half)
    names = tuple(names_of(source))
    plan = ProofPlan(
        settings, places, names, sensor, grid, arms, groups, absent, pairs, len(pairs), labelled, tested,
        recordings_of_scans(source, [names[i] for part in tested.values() for i in part]), half, step, 0.0, jobs,
    )  # fmt: skip
    return _within(plan, minutes), scans


def describe(plan: ProofPlan) -> str:
    """The plan in words, for a user who decides whether to start it."""
    tested = sorted({place for place, _ in plan.pairs})
    lines = [
        f"{len(plan.names)} scans of {plan.sensor.name} in {len(plan.places)} places: "
        + ", ".join(f"{name} ({len(members)})" for name, members in plan.places.items()),
        f"each training gets {plan.budget} labelled scans and is tested on a place that was left out",
        f"tested places: {', '.join(tested)}; seeds: {len({seed for _, seed in plan.pairs})}; "
        f"{len(plan.pairs)} of {plan.wanted} pairs of place and seed",
        f"classes without a label: {', '.join(plan.absent) or 'none'}", "trainings of each pair:",
    ]  # fmt: skip
    for row in plan.rows:
        count = round(plan.settings.iterations * row.arm.iterations)
        uses = f" (uses {row.arm.budget})" if row.arm.budget else ""
        lines.append(f"  {row.key:<16}{count} iterations of {plan.settings.batch}: {row.title}{uses}")
    time = f"about {plan.minutes:.0f} minutes with {plan.jobs} processes" if plan.step else "time: that of your trainer"
    return "\n".join([*lines, f"{len(plan.rows) * len(plan.pairs)} trainings; {time}"])


def recordings_of_scans(source: Source, names: Sequence[str]) -> Recordings:
    """The recordings behind some scans of a source; empty if it is not one of files."""
    if not isinstance(source, ScanFiles):
        return Recordings()
    layout = layout_of(source.root)
    every = recordings_of(source, layout, source.root)
    of_town = any(dataset == TOWN for dataset, _ in every.drives)
    return every if of_town or layout not in PLACES else frames_of(layout, names)


def expected_minutes(plan: ProofPlan, pairs: Sequence[Pair]) -> float:
    """The time that some pairs take, with the pools that they need."""
    settings, pools = plan.settings, {pool for row in plan.rows for pool in row.arm.pools()}
    seconds = sum(map(plan.seconds, plan.rows)) * len(pairs)
    for row in plan.rows:
        if (stage := row.pretraining) is not None:
            starts = len(pairs) if stage.pool == "skin" else len({seed for _, seed in pairs})
            seconds += starts * stage.share * settings.iterations * plan.step
    seconds *= OVERHEAD
    town = settings.synthetic * TOWN_SECONDS
    if "skin" in pools:
        for place in {place for place, _ in pairs}:
            scans = len(plan.skin_scans(place))
            seconds += town + scans * SKIN_SECONDS + 2 * SKIN_STREETS * TOWN_SECONDS
    seconds += town * ("town" in pools) + settings.synthetic * GENERATOR_SECONDS * ("generator" in pools)
    return seconds / 60 / plan.jobs


def _within(plan: ProofPlan, minutes: float | None) -> ProofPlan:
    """The plan with as many pairs as fit into the time."""
    count = len(plan.pairs)
    if minutes is not None:
        while count > 0 and expected_minutes(plan, plan.pairs[:count]) > minutes:
            count -= 1
        if count < min(2, len(plan.pairs)):
            needed = expected_minutes(plan, plan.pairs[:2])
            raise ConfigError(
                f"{minutes:g} minutes, in which {count} of at least 2 places can be tested",
                f"about {needed:.0f} or more",
                "Give more --minutes, fewer arms (--arm), or fewer --iterations.",
            )  # fmt: skip
    pairs = plan.pairs[:count]
    labelled = {pair: plan.labelled[pair] for pair in pairs}
    return replace(plan, pairs=pairs, labelled=labelled, minutes=expected_minutes(plan, pairs))


def _labelled(places: Places, pair: Pair, settings: ProofSettings) -> list[int]:
    place, seed = pair
    there = sum(len(members) for name, members in places.items() if name != place)
    count = min(there, MOST_LABELLED) if settings.labelled is None else settings.labelled
    if count < settings.batch:
        raise ConfigError(
            f"{count} labelled scans for batches of {settings.batch}, where {place!r} is left out",
            "at least as many scans as a batch has", f"Use --batch {count} (batch={count}), or label more scans.",
        )  # fmt: skip
    number = sorted(places).index(place)
    return choose(places, place, count, np.random.default_rng((settings.seed, seed, number)))


def _spread(indices: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spread."""
    picks = np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).round().astype(int))
    return [indices[i] for i in picks]


def _read(source: Source, index: int, grid: Sensor | None) -> Scan:
    scan = source[index]
    if scan.label is None:
        raise DataError(
            f"scan {scan.id!r} without labels", "labelled scans",
            "lidar-synth label kitti360 makes labels for KITTI-360; other scans need a folder of labels.",
        )  # fmt: skip
    wrong = (scan.label >= len(NAMES)) & (scan.label != IGNORE)
    if wrong.any():
        raise DataError(
            f"scan {scan.id!r} with labels {np.unique(scan.label[wrong])[:8].tolist()}",
            f"train ids 0 to {len(NAMES) - 1}, or {IGNORE} = ignore",
            "They are of another table: map them when they are read (Taxonomy.decode).",
        )
    return scan if grid is None else thinned(scan, grid)


def _counts(scans: dict[int, Scan]) -> NDArray[np.int64]:
    total = np.zeros(256, np.int64)
    for scan in scans.values():
        assert scan.label is not None
        total += np.bincount(scan.label, minlength=256)
    return total[: len(NAMES)]


def _classes(source: Source, name: str) -> str:
    """The name of the pooled classes of a source."""
    if name != "auto":
        return name
    layout = layout_of(source.root) if isinstance(source, ScanFiles) else ""
    return layout if layout in GROUPS else "semantic_kitti"


def _step(scans: list[Scan], settings: ProofSettings, half: bool | None) -> tuple[bool, float]:
    """Whether bfloat16 is faster on this machine, and the seconds of an iteration."""
    if settings.columns is None:
        return False, 0.0
    from lidar_synth.proof.trial import images

    sensor = scans[0].sensor
    parts = images(scans, sensor)
    batch = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0]))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    half = faster_in_bfloat16() if half is None else half
    times: list[float] = []
    train_segmenter(
        RangeSegmenter(widths=settings.widths), [batch] * 4, height, 4, progress=False, half=half,
        watch=lambda step: times.append(time.perf_counter()),
    )  # fmt: skip
    torch.set_num_threads(threads)
    return half, float(np.diff(times).min())
