"""Pools of synthetic scans, which all arms and seeds share: made once, kept in SemanticKITTI's
layout.

A pool is a folder. An interrupted pool is continued where it stopped.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.datasets.recordings import Recordings
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import hash_of_names, read_text, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.formats.semantic_kitti import SemanticKITTI, SemanticKITTIWriter
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.generate.loading import find_model, load_generator
from lidar_synth.geometry import Scan, Sensor, spread
from lidar_synth.geometry.transfer import Measurement, Response, Transfer
from lidar_synth.lab.evaluate.leakage import town
from lidar_synth.lab.town import STRETCH_FRAMES, Skin, Town, fit_skin, load_skin
from lidar_synth.lab.town.catalogue import TABLES_HASH
from lidar_synth.lab.town.skin.fit import FEWEST_SCANS
from lidar_synth.labels.exchange import thin_scan
from lidar_synth.noise import keyed_rng

FRAMES = (4, 10, 16)
"""The scans of each street of the town that a pool has."""
TOWN_SEED = 4242
"""Seed of the towns in pools; the next one is taken where the dataset is that town."""
MOST_SKIN_SCANS = 60
SKIN_STREETS = 16
SETTINGS = "pool.json"
DONE = "complete"
SKIN = "own.skin"


@dataclass(frozen=True)
class PoolTask:
    """One pool to make.

    Args:
        kind: a name of ``POOLS``.
        folder: where it is kept.
        sensor: of the user's scans.
        grid: the sensor on whose grid the scans are thinned; None to keep all returns.
        count: number of scans.
        town_seed: seed of the town.
        model: the generator's name or path.
        scans: unlabelled scans by whose look a skin is learnt, as a function that reads them.
        learnt: names of these scans.
    """

    kind: str
    folder: Path
    sensor: Sensor
    grid: Sensor | None
    count: int
    town_seed: int = TOWN_SEED
    model: str = "town"
    scans: Callable[[], Sequence[Scan]] | None = None
    learnt: tuple[str, ...] = ()


def raw_town(task: PoolTask) -> Iterator[Scan]:
    """Scans of the town as the physical model measures them."""
    yield from town_scans(task, None)


def make_skinned_town(task: PoolTask) -> Iterator[Scan]:
    """Scans of the town with a skin that is learnt from the unlabelled scans."""
    path = task.folder / SKIN
    if not path.is_file():
        assert task.scans is not None
        scans = task.scans()
        if len(scans) < FEWEST_SCANS:
            raise DataError(
                f"{len(scans)} scans to learn a skin from",
                f"at least {FEWEST_SCANS} in the places that are trained on",
                "Leave out the arms with a skin: --arm real --arm exchange --arm town.",
            )
        fit_skin(scans, task.sensor, streets=SKIN_STREETS, progress=False).save(path)
    yield from town_scans(task, load_skin(path))


def make_generated(task: PoolTask) -> Iterator[Scan]:
    """Scans of a generator, turned into scans of the user's sensor where theirs is another one.
    What a model with a condition needs, the town gives: label maps or layouts of its streets."""
    generator = load_generator(task.model)
    streets: Iterable[Scan | None] = repeat(None, task.count)
    if generator.condition is not None:
        streets = town_scans(replace(task, sensor=generator.sensor), None)
    made = (generator.scans(0, [i], s)[0] for i, s in enumerate(streets))
    yield from as_sensor(made, task.sensor)


def learnt_town(task: PoolTask) -> Iterator[Scan]:
    """Scans of the town that the generator learnt from, evenly spread, turned into scans of the
    user's sensor where the generator's is another one.

    Raises:
        ConfigError: if it did not learn from the town.
    """
    generator = load_generator(task.model)
    data = generator.header.provenance.get("data")
    if not isinstance(data, dict) or not data.get("town"):
        raise ConfigError(
            f"generator {task.model!r}, which did not learn from the town",
            "one that did, such as town",
            "Leave out the arm pretrain-learnt.",
        )
    interval = data["interval"]
    motion = data["motion"]
    made = Town(data["seed"], generator.sensor, data["town"], interval, motion=motion)
    yield from as_sensor(
        (made[i] for i in spread(range(len(made)), task.count)), task.sensor
    )


def as_sensor(scans: Iterable[Scan], sensor: Sensor) -> Iterator[Scan]:
    """The scans as a sensor would measure them; reflectance is matched in each training, to its
    labelled scans."""
    unchanged = Response((0.0, 1.0), (0.0, 1.0))
    change = Transfer(sensor, measurement=Measurement(response=unchanged))
    for index, scan in enumerate(scans):
        yield change(scan, keyed_rng(0, index))


POOLS: dict[str, Callable[[PoolTask], Iterator[Scan]]] = {
    "town": raw_town,
    "skin": make_skinned_town,
    "generator": make_generated,
    "learnt": learnt_town,
}
"""Makers of pools by name."""
OF_GENERATOR = {"generator", "learnt"}
"""Pools that depend on the generator."""


def make_pool(task: PoolTask) -> Path:
    """Make a pool, unless it is complete, and return its folder.

    Raises:
        ConfigError: if the folder holds another pool.
        DataError, FileError: if it cannot be made or written.
    """
    start = time.monotonic()
    claim(task.folder / SETTINGS, _settings(task))
    if (task.folder / DONE).is_file():
        return task.folder
    writer = SemanticKITTIWriter(task.folder)
    made = 0
    for scan in POOLS[task.kind](task):
        kept = scan if task.grid is None else thin_scan(scan, task.grid)
        writer.write(kept, made, name=f"00/{made:06d}")
        made += 1
    write_file(
        task.folder / DONE,
        json.dumps({"scans": made, "seconds": time.monotonic() - start}).encode(),
    )
    return task.folder


def seconds_of(folder: Path) -> float:
    """How long it took to make a pool."""
    return float(parse_json(read_text(folder / DONE), str(folder / DONE))["seconds"])


def read_pool(folder: Path) -> list[Scan]:
    """All scans of a pool, in memory."""
    return list(SemanticKITTI(folder))


def has_lasers(model: str, sensor: Sensor) -> bool:
    """Whether a model's scans are of a sensor's lasers."""
    return read_header(find_model(model))[0].sensor.same_lasers(sensor)


def match_reflectance(scans: Sequence[Scan], real: Sequence[Scan]) -> list[Scan]:
    """The scans with the distribution of the reflectance of real ones."""
    response = Response.match(scans, real)
    return [
        replace(s, reflectance=response(s.reflectance).astype(np.float32))
        for s in scans
    ]


def town_seed(recordings: Recordings) -> int:
    """The seed of a town whose streets are not among the recordings."""
    seed = TOWN_SEED
    while town(seed) & recordings:
        seed += 1
    return seed


def _settings(task: PoolTask) -> dict[str, Any]:
    plain = {
        "kind": task.kind,
        "sensor": task.sensor.to_dict(),
        "grid": task.grid and task.grid.to_dict(),
        "count": task.count,
    }
    streets = {"seed": task.town_seed, "tables": TABLES_HASH}
    if task.kind in OF_GENERATOR:
        header, checkpoint = read_header(find_model(task.model))
        return (
            plain
            | {"model": task.model, "checkpoint": checkpoint}
            | (streets if header.conditioning else {})
        )
    if task.kind == "skin":
        streets["learnt_from"] = hash_of_names(task.learnt)
    return plain | streets


def town_scans(task: PoolTask, skin: Skin | None) -> Iterator[Scan]:
    """The scans of ``FRAMES`` of each street of the town, in a skin or as they are."""
    streets = -(-task.count // len(FRAMES))
    made = Town(task.town_seed, task.sensor, streets * STRETCH_FRAMES, skin=skin)
    places = [
        STRETCH_FRAMES * street + frame for street in range(streets) for frame in FRAMES
    ]
    for place in places[: task.count]:
        yield made[place]
