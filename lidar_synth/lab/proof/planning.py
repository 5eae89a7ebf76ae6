"""Making the plan of a comparison: scans are read and checked, the labelled ones chosen, the time
measured."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.datasets.recordings import PLACES, TOWN, Recordings, frames_of
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import layout_of
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.scan import Scan, Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.leakage import recordings_of
from lidar_synth.lab.proof.arms import rows
from lidar_synth.lab.proof.budget import measure_step, within
from lidar_synth.lab.proof.places import Places, choose, find_places, names_of, spread
from lidar_synth.lab.proof.plan import Pair, ProofPlan
from lidar_synth.lab.proof.scores import GROUPS, groups_of, require_labels
from lidar_synth.lab.proof.settings import MOST_LABELLED, ProofSettings
from lidar_synth.labels.exchange import thin_scan
from lidar_synth.mixing.sources import sensor_of


def make_plan(
    source: Source,
    settings: ProofSettings,
    minutes: float | None,
    jobs: int,
    earlier: Mapping[str, Any] | None = None,
) -> tuple[ProofPlan, dict[int, Scan]]:
    """Plan a comparison.

    Args:
        source: labelled scans.
        settings: what is asked for.
        minutes: limit of the time; None for all places and seeds.
        jobs: processes.
        earlier: ``ProofPlan.identity`` of the comparison that is resumed. It computed in bfloat16
            or not, as the machine was faster then, and had fewer iterations if the time was short.

    Returns:
        The plan, and {index: scan on the grid} of all labelled and tested scans.

    Raises:
        ConfigError: on settings that do not fit the scans, or too short a time.
        DataError: on one place only, on scans without labels, or on a class that nothing is
            labelled as.
    """
    arms = rows(settings.arms, settings.ratios)
    groups = groups_of(_classes(source, settings.classes), settings.only)
    places = find_places(source, settings.places)
    sensor = sensor_of(source)
    grid = (
        None if settings.columns is None else replace(sensor, columns=settings.columns)
    )
    rng = np.random.default_rng(settings.seed)
    order = [list(places)[i] for i in rng.permutation(len(places))]
    pairs = [(place, seed) for seed in range(settings.seeds) for place in order]
    labelled = {pair: _labelled(places, pair, settings) for pair in pairs}
    tested = {
        place: spread(indices, settings.tested) for place, indices in places.items()
    }
    needed = sorted(
        {i for part in (*labelled.values(), *tested.values()) for i in part}
    )
    scans = {i: _read(source, i, grid) for i in needed}
    absent = require_labels(_counts(scans), groups, settings.only)
    batch = [scans[i] for i in needed[: settings.batch]]
    half, step = measure_step(batch, settings, earlier.get("half") if earlier else None)
    if earlier and minutes is not None:
        settings = replace(
            settings, iterations=min(settings.iterations, earlier["iterations"])
        )
    names = tuple(names_of(source))
    plan = ProofPlan(
        settings,
        places,
        names,
        sensor,
        grid,
        arms,
        groups,
        absent,
        pairs,
        len(pairs),
        labelled,
        tested,
        recordings_of_scans(
            source, [names[i] for part in tested.values() for i in part]
        ),
        half,
        step,
        0.0,
        jobs,
    )
    return within(plan, minutes, resumed=bool(earlier)), scans


def recordings_of_scans(source: Source, names: Sequence[str]) -> Recordings:
    """The recordings behind some scans of a source; empty if it is not one of files."""
    if not isinstance(source, ScanFiles):
        return Recordings()
    layout = layout_of(source.root)
    every = recordings_of(source, layout, source.root)
    of_town = any(dataset == TOWN for dataset, _ in every.drives)
    return every if of_town or layout not in PLACES else frames_of(layout, names)


def _labelled(places: Places, pair: Pair, settings: ProofSettings) -> list[int]:
    place, seed = pair
    there = sum(len(members) for name, members in places.items() if name != place)
    count = (
        min(there, MOST_LABELLED) if settings.labelled is None else settings.labelled
    )
    if count < settings.batch:
        raise ConfigError(
            f"{count} labelled scans for batches of {settings.batch}, where {place!r} is left out",
            "at least as many scans as a batch has",
            f"Use --batch {count} (batch={count}), or label more scans.",
        )
    number = sorted(places).index(place)
    return choose(
        places, place, count, np.random.default_rng((settings.seed, seed, number))
    )


def _read(source: Source, index: int, grid: Sensor | None) -> Scan:
    scan = source[index]
    if scan.label is None:
        raise DataError(
            f"scan {scan.id!r} without labels",
            "labelled scans",
            "lidar-synth label kitti360 makes labels for KITTI-360; other scans need a folder of "
            "labels.",
        )
    wrong = (scan.label >= len(NAMES)) & (scan.label != IGNORE)
    if wrong.any():
        raise DataError(
            f"scan {scan.id!r} with labels {np.unique(scan.label[wrong])[:8].tolist()}",
            f"train ids 0 to {len(NAMES) - 1}, or {IGNORE} = ignore",
            "They are of another table: map them when they are read (Taxonomy.decode).",
        )
    return scan if grid is None else thin_scan(scan, grid)


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
