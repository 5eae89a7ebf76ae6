"""Scans of the trial: made once, kept as ``.npz``, shared by all trainings. An interrupted pool is
continued."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lidar_synth import Scan, Source, Town, load_generator, open_scans
from lidar_synth.formats.npz import write_scan
from lidar_synth.lab.proof.detection.boxes import with_points
from lidar_synth.lab.town import STRETCH_FRAMES
from lidar_synth.labels.edit import remove_unboxed

SENSOR = "hdl64e_lasers"
FRAMES = (4, 10, 16)
"""The scans of a stretch of road of which one is taken."""
NEAR = 40.0
"""Metres to each side within which pedestrians and cyclists are counted for this choice."""
RARE = {"Pedestrian": 1, "Person_sitting": 1, "Cyclist": 2}
"""What each counts."""


def make_pool(folder: Path, count: int, make: Callable[[int], Scan]) -> Source:
    """The scans 0 to ``count`` - 1 of a function, kept in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in tqdm(
        range(count),
        desc=folder.name,
        unit="scan",
        disable=(folder / f"{count - 1:06d}.npz").exists(),
    ):
        if not (path := folder / f"{i:06d}.npz").exists():
            write_scan(path, make(i))
    return open_scans(folder)


def streets(
    folder: Path, seed: int, first: int, count: int, every_box: bool = False
) -> Source:
    """One scan of each of ``count`` stretches of a town, from the stretch ``first`` on.

    Of three moments of a stretch, the one with most pedestrians and cyclists near the vehicle is
    taken: with one at random, thirty scans have two cyclists.

    Args:
        folder: where they are kept.
        seed: of the town.
        first, count: its stretches.
        every_box: whether to keep boxes with few points, too.
    """
    town = Town(
        seed, SENSOR, (first + count) * STRETCH_FRAMES, interval=2.0, motion=False
    )

    def make(number: int) -> Scan:
        moments = [(first + number) * STRETCH_FRAMES + frame for frame in FRAMES]
        scan = town[max(moments, key=lambda i: _rare(town, i))]
        return scan if every_box else with_points(scan)

    return make_pool(folder, count, make)


def _rare(town: Town, index: int) -> int:
    """Pedestrians and cyclists around the vehicle, hidden ones included; a cyclist counts as
    two."""
    snapshot, pose, _ = town.moment(index)
    objects = [
        o
        for o in (*town.world(index).scene.placed, *snapshot.movers)
        if o.prototype.name in RARE
    ]
    places = [(np.linalg.inv(pose) @ o.pose)[:2, 3] for o in objects]
    return sum(
        RARE[o.prototype.name]
        for o, place in zip(objects, places, strict=True)
        if abs(place).max() < NEAR
    )


def unconditional(folder: Path, count: int, model: str) -> Source:
    """Scans of a model without boxes."""
    generator = load_generator(model)
    return make_pool(folder, count, lambda i: generator.scans(0, [i])[0])


def without_unboxed(folder: Path, scans: Source) -> Source:
    """The same scans, as the package's default makes them: objects without a box are removed, their
    holes filled."""
    return make_pool(folder, len(scans), lambda i: remove_unboxed(scans[i]))


def laid_out(folder: Path, model: str, layouts: Source) -> Source:
    """One scan of a layout model for the layout of each given scan, with its boxes; as the
    package's default, objects without a box are removed."""
    generator = load_generator(model)
    return make_pool(
        folder,
        len(layouts),
        lambda i: with_points(
            remove_unboxed(generator.scans(0, [i], condition=layouts[i])[0])
        ),
    )
