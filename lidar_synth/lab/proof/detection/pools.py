"""Pools of synthetic scans with boxes, which all arms and seeds share; each is a folder.

An interrupted pool is continued where it stopped.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lidar_synth.files.claims import claim
from lidar_synth.formats import open_scans
from lidar_synth.formats.npz import write_scan
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import Scan, Sensor, Source
from lidar_synth.lab.proof.detection.boxes import with_points
from lidar_synth.lab.proof.pools import SETTINGS, TOWN_SEED, as_sensor
from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.lab.town.catalogue import TABLES_HASH
from lidar_synth.labels import ObjectBank

MODEL = "town-layout"
MOMENTS = (3, 10, 17)
"""The scans of each stretch of the town in its pool."""


def make_town(folder: Path, sensor: Sensor, count: int) -> Source:
    """Scans of the town, each with the boxes that hold points.

    Raises:
        ConfigError: if the folder holds those of another sensor or version of the town.
    """
    stretches = -(-count // len(MOMENTS))
    town = Town(
        TOWN_SEED, sensor, stretches * STRETCH_FRAMES, interval=2.0, motion=False
    )

    def make(number: int) -> Scan:
        stretch, moment = divmod(number, len(MOMENTS))
        return town[stretch * STRETCH_FRAMES + MOMENTS[moment]]

    identity = {"sensor": sensor.to_dict(), "tables": TABLES_HASH}
    return _fill(folder, identity, count, make, "scans of the town")


def draw_layouts(folder: Path, town: Source) -> Source:
    """Scans that ``MODEL`` draws of the layouts of the town's scans, with objects of the town cast
    into their boxes, as scans of the town's sensor.

    Raises:
        ConfigError: if the folder holds those of another model, sensor or town.
        LibraryError: if embreex is missing.
    """
    sensor = town[0].sensor
    generator = load_generator(MODEL)
    objects = ObjectBank.from_town_shapes(generator.sensor)

    def make(number: int) -> Scan:
        drawn = generator.scans(0, [number], [town[number]], objects)
        return next(as_sensor(drawn, sensor))

    identity = {
        "sensor": sensor.to_dict(),
        "tables": TABLES_HASH,
        "checkpoint": generator.hash,
    }
    return _fill(folder, identity, len(town), make, "scans of layouts")


def _fill(
    folder: Path,
    identity: dict[str, Any],
    count: int,
    make: Callable[[int], Scan],
    what: str,
) -> Source:
    """Make the scans that are missing, and open the first ``count``."""
    claim(folder / SETTINGS, identity)
    for number in tqdm(range(count), what, disable=None):
        path = folder / f"{number:06d}.npz"
        if not path.exists():
            write_scan(path, with_points(make(number)))
    kept = open_scans(folder)
    kept.ids = kept.ids[:count]  # other comparisons may have made more
    return kept
