"""Making the plan of a comparison: scans are read and checked, the labelled ones chosen, the time
measured."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.datasets.recordings import PLACES, TOWN, Recordings, frames_of
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import layout_of
from lidar_synth.formats.source import ScanFiles
from lidar_synth.generate.devices import check_device
from lidar_synth.geometry import LABELLED_ONLY, Scan, Sensor, Source, spread
from lidar_synth.lab.evaluate.leakage import content_of, recordings_of
from lidar_synth.lab.proof.arms import rows
from lidar_synth.lab.proof.beams import coarser, keep_beams
from lidar_synth.lab.proof.budget import measure_step, within
from lidar_synth.lab.proof.places import (
    Places,
    choose,
    find_places,
    names_of,
    refuse_skipping,
)
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
    tests: Source | None = None,
    device: str = "cpu",
) -> tuple[ProofPlan, dict[int, Scan]]:
    """Plan a comparison.

    Args:
        source: labelled scans.
        settings: what is asked for.
        minutes: limit of the time; None for all places and seeds.
        jobs: processes.
        earlier: ``ProofPlan.identity`` of the comparison that is resumed. It computed in bfloat16
            or not, as the machine was faster then, and had fewer iterations if the time was short.
        tests: labelled scans of other places to test on; None leaves out each place in turn.
        device: on which the reference network computes.

    Returns:
        The plan, and {index: scan on the grid} of the labelled and tested scans of its pairs. The
        indices of ``tests`` follow those of ``source``.

    Raises:
        ConfigError: on settings that do not fit the scans or the sensor, too short a time, a device
            that is not there, scans with ``on_bad="skip"``, or tests of another sensor or of scans
            that are trained on.
        DataError: on one place only, on scans without labels, or on a class that nothing is
            labelled as.
    """
    check_device(device)
    refuse_skipping(source)
    refuse_skipping(tests or [])
    arms = rows(settings.arms, settings.ratios)
    groups = groups_of(_classes(source, settings.classes), settings.only)
    sensor = coarser(sensor_of(source), settings.beams)
    training, places = _split(source, tests, settings.places)
    grid = (
        None if settings.columns is None else replace(sensor, columns=settings.columns)
    )
    rng = np.random.default_rng(settings.seed)
    order = [list(places)[i] for i in rng.permutation(len(places))]
    pairs = [(place, seed) for seed in range(settings.seeds) for place in order]
    labelled = {pair: _labelled(places, training, pair, settings) for pair in pairs}
    tested = {
        place: spread(indices, settings.tested) for place, indices in places.items()
    }
    names = (*names_of(source), *names_of([] if tests is None else tests))
    recordings = recordings_of_scans(
        source if tests is None else tests,
        [names[i] for part in tested.values() for i in part],
    )
    if tests is not None:
        seen = recordings_of_scans(source, names_of(source))
        if shared := seen & recordings:
            raise _shared(str(shared))

    def read(indices: Collection[int]) -> dict[int, Scan]:
        return {
            i: _read(*locate(source, tests, i), grid, settings.beams)
            for i in sorted(indices)
        }

    batch = [*read(labelled[pairs[0]][: settings.batch]).values()]
    half = earlier.get("half") if earlier else None
    half, step = measure_step(batch, settings, half, device)
    if earlier and minutes is not None:
        settings = replace(
            settings, iterations=min(settings.iterations, earlier["iterations"])
        )
    plan = ProofPlan(
        settings,
        places,
        names,
        sensor,
        grid,
        arms,
        groups,
        [],
        pairs,
        len(pairs),
        labelled,
        tested,
        training,
        recordings,
        half,
        step,
        0.0,
        jobs,
        device,
        getattr(source, "options", {}),
    )
    plan = within(plan, minutes, resumed=bool(earlier))
    scans = read({i for p in plan.pairs for i in (*labelled[p], *tested[p[0]])})
    if tests is not None:
        _refuse_shared(scans, len(source))
    absent = require_labels(_counts(scans), groups, settings.only)
    return replace(plan, absent=absent), scans


def recordings_of_scans(source: Source, names: Sequence[str]) -> Recordings:
    """The recordings behind some scans of a source; empty if it is not one of files."""
    if not isinstance(source, ScanFiles):
        return Recordings()
    layout = layout_of(source.root)
    every = recordings_of(source, layout, source.root)
    of_town = any(dataset == TOWN for dataset, _ in every.drives)
    return every if of_town or layout not in PLACES else frames_of(layout, names)


def locate(source: Source, tests: Source | None, index: int) -> tuple[Source, int]:
    """The source of a scan of the plan, and its index there."""
    if tests is None or index < len(source):
        return source, index
    return tests, index - len(source)


def _split(
    source: Source, tests: Source | None, by: str
) -> tuple[Places | None, Places]:
    """The places of the labelled scans, None if they are left out in turn, and those that are
    tested."""
    if tests is None:
        return None, find_places(source, by, labelled=True)
    own = sensor_of(source)
    other = sensor_of(tests)
    if other.name != own.name:
        raise ConfigError(
            f"tests of sensor {other.name!r} for labelled scans of {own.name!r}",
            "scans of one sensor",
            f"lidar-synth convert IN OUT --as-sensor {own.name} turns them into its scans.",
        )
    found = find_places(tests, by, fewest=1)
    tested = {name: [len(source) + i for i in part] for name, part in found.items()}
    return find_places(source, "drive", fewest=1, labelled=True), tested


def _refuse_shared(scans: Mapping[int, Scan], labelled: int) -> None:
    """Refuse scans that are both labelled, the first so many indices, and tested."""
    trained = {content_of(scan): scan.id for i, scan in scans.items() if i < labelled}
    for index, scan in scans.items():
        if index >= labelled and (twin := trained.get(content_of(scan))) is not None:
            raise _shared(f"scan {scan.id!r}, which is {twin!r} of the labelled scans")


def _shared(what: str) -> ConfigError:
    return ConfigError(
        f"tests that are labelled scans too: {what}",
        "tests of other places than those that are trained on",
    )


def _labelled(
    places: Places, training: Places | None, pair: Pair, settings: ProofSettings
) -> list[int]:
    place, seed = pair
    if training is not None:
        rng = np.random.default_rng((settings.seed, seed))
        return choose(training, _count_labelled(training, settings), rng)
    others = {name: part for name, part in places.items() if name != place}
    count = _count_labelled(others, settings)
    number = sorted(places).index(place)
    rng = np.random.default_rng((settings.seed, seed, number))
    return choose(others, count, rng)


def _count_labelled(places: Places, settings: ProofSettings) -> int:
    there = sum(map(len, places.values()))
    return min(there, MOST_LABELLED) if settings.labelled is None else settings.labelled


def _read(source: Source, index: int, grid: Sensor | None, beams: int | None) -> Scan:
    scan = source[index]
    if scan.label is None:
        raise DataError(
            f"scan {scan.id!r} without labels",
            "labelled scans",
            LABELLED_ONLY,
        )
    wrong = (scan.label >= len(NAMES)) & (scan.label != IGNORE)
    if wrong.any():
        raise DataError(
            f"scan {scan.id!r} with labels {np.unique(scan.label[wrong])[:8].tolist()}",
            f"train ids 0 to {len(NAMES) - 1}, or {IGNORE} = ignore",
            "They are of another table: map them when they are read (Taxonomy.decode).",
        )
    scan = keep_beams(scan, beams)
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
