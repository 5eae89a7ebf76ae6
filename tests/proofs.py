"""Small datasets, pools and results for the tests of ``prove``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from streets import SENSOR, street

from lidar_synth.formats.semantic_kitti import SemanticKITTIWriter
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.proof import Job, Row
from lidar_synth.lab.proof.command import write_scans
from lidar_synth.lab.proof.pools import POOLS, read_pool
from lidar_synth.lab.town import STRETCH_FRAMES, Town

TOWN_SENSOR = Sensor(
    "small town",
    columns=512,
    range_min=1.0,
    range_max=80.0,
    rows=32,
    fov_up=3.0,
    fov_down=-25.0,
)


class Scans(list[Scan]):
    """Scans in memory with names, as a source."""

    def __init__(
        self,
        names: Sequence[str],
        poses: Sequence[float] | None = None,
        first: int = 0,
    ) -> None:
        super().__init__(
            replace(street(i, boxes=False), id=name)
            for i, name in enumerate(names, first)
        )
        self.ids = tuple(names)
        for i, x in enumerate(poses or ()):
            pose = np.eye(4)
            pose[0, 3] = x
            self[i].pose = pose


def drives(count: int = 3, scans: int = 4, first: int = 0) -> Scans:
    """Scans of several drives, on streets from this one on."""
    names = [f"{n:02d}/{frame:06d}" for n in range(count) for frame in range(scans)]
    return Scans(names, first=first)


def job(
    name: str, folder: Path, iterations: int = 20, ratio: float | None = None
) -> Job:
    """A training on four scans, with pools of other scans."""
    real = [street(i, boxes=False) for i in range(4)]
    other = [street(100 + i) for i in range(3)]
    write_scans(other, folder / "pool")
    pool = read_pool(folder / "pool")
    pools = dict.fromkeys(POOLS, pool)
    return Job(
        Row(name, ratio),
        3,
        real,
        {"left out": [street(9, boxes=False)]},
        pools,
        iterations,
        2,
        (4, 8),
        False,
        folder / "job",
        dict.fromkeys(pools, folder / "pool"),
    )


def write_town(root: Path, streets: int, frames: Sequence[int]) -> Path:
    """Write scans of some streets of the town in SemanticKITTI's layout, as one sequence with
    poses."""
    town = Town(0, TOWN_SENSOR, streets * STRETCH_FRAMES)
    writer = SemanticKITTIWriter(root)
    for index, (number, frame) in enumerate(
        (s, f) for s in range(streets) for f in frames
    ):
        writer.write(
            town[number * STRETCH_FRAMES + frame], index, name=f"00/{index:06d}"
        )
    writer.finish()
    return root


__all__ = ["SENSOR", "TOWN_SENSOR", "Scans", "drives", "job", "write_town"]
