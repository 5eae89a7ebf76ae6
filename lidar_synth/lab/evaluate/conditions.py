"""Agreement of generated scans with the conditions that they were generated for.

Both scans of a pair show the same place: the generated one, and the real one whose label map or
camera image was the condition.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.lab.evaluate.segmentation import Judge, mean_iou
from lidar_synth.lab.evaluate.statistics import Statistic, share

FIELD = np.radians(50.0)
REACH = 40
"""The compared area: angle to either side of straight ahead (the cameras of the town and KITTI-360
see 52 degrees), and distance in metres."""

SENSOR_HEIGHT = 1.73
ABOVE = 0.5
"""Height of the LiDAR above the ground, and of the lowest returns that count above the ground;
metres."""


def map_agreement(
    generated: Sequence[Scan], real: Sequence[Scan], judge: Judge
) -> float:
    """mIoU in [0, 1] between the real scans' labels, cell by cell, and a segmenter's prediction on
    the generated ones.

    Raises:
        DataError: on sets of different lengths, or real scans without labels.
    """
    return mean_iou(
        judge.agreement([relabel(a, b) for a, b in _pairs(generated, real)])
    )


def sight_agreement(generated: Sequence[Scan], real: Sequence[Scan]) -> Statistic:
    """Mean intersection over union, in [0, 1], of the occupied bird's-eye cells (1 m) in the
    camera's view.

    Raises:
        DataError: on sets of different lengths.
    """
    overlaps = [(obstacles(a), obstacles(b)) for a, b in _pairs(generated, real)]
    return share(
        np.array([(a & b).sum() / max((a | b).sum(), 1) for a, b in overlaps]),
        False,
        len(real),
    )


def relabel(scan: Scan, other: Scan) -> Scan:
    """A scan on its sensor's grid; each return gets the label of the same cell in another scan."""
    image = project(scan, scan.sensor)
    labels = project(other, scan.sensor, ["label"]).channels["label"]
    image.channels["label"] = np.where(image.mask, labels, IGNORE).astype(np.uint8)
    return replace(unproject(image), id=scan.id, domain=scan.domain)


def obstacles(scan: Scan) -> NDArray[np.bool_]:
    """(REACH, 2 REACH) square metres ahead that have a return above the ground."""
    x, y, z = scan.points.T
    seen = (
        (np.abs(np.arctan2(y, x)) < FIELD)
        & (np.hypot(x, y) < REACH)
        & (z > ABOVE - SENSOR_HEIGHT)
    )
    cells = np.zeros((REACH, 2 * REACH), bool)
    cells[np.floor(x[seen]).astype(int), np.floor(y[seen]).astype(int) + REACH] = True
    return cells


def _pairs(generated: Sequence[Scan], real: Sequence[Scan]) -> list[tuple[Scan, Scan]]:
    if len(generated) != len(real) or not generated:
        raise DataError(
            f"{len(generated)} generated and {len(real)} real scans",
            "one real scan per generated one",
        )
    return list(zip(generated, real, strict=True))


AGREEMENTS: dict[
    str, tuple[str, Callable[[Sequence[Scan], Sequence[Scan], Judge], float]]
] = {
    "semantic": ("mIoU of map and segmenter", map_agreement),
    "camera": (
        "bird's-eye IoU in the camera's sight",
        lambda a, b, judge: sight_agreement(a, b).value,
    ),
}
"""{condition: (name of the measure, the measure)}."""
