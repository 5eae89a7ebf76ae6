"""What is measured of one scan, without knowing the others."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES, TRAIN_ID
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import RangeImage, Scan

RANGE_BINS = 64
"""Of the histogram of ranges, from 0 to the sensor's farthest."""

SIDE, CELLS = 80.0, 32
"""Side in metres of the square around the sensor that a signature shows from above, and its cells along it."""

SIGNATURE = CELLS * CELLS
"""Entries of a signature."""

GROUND = tuple(TRAIN_ID[name] for name in ("road", "parking", "sidewalk", "other-ground", "terrain"))
"""Train ids of what one can stand on."""

_SAME_SURFACE = 0.02  # relative difference in range of two neighbouring cells that see the same thing


@dataclass(frozen=True)
class Measure:
    """One number about a scan.

    Args:
        meaning: what it is, in words, with its interval.
        field: what a scan has to carry; None = nothing.
        of: the number, from the image and the scan that it unprojects to.
    """

    meaning: str
    field: str | None
    of: Callable[[RangeImage, Scan], float]


def _empty(image: RangeImage, scan: Scan) -> float:
    return float(1 - image.mask.mean())


def _unlabelled(image: RangeImage, scan: Scan) -> float:
    assert scan.label is not None
    return _share(scan.label == IGNORE)


def _floating(image: RangeImage, scan: Scan) -> float:
    assert scan.label is not None
    return _share(scan.points[:, 2][np.isin(scan.label, GROUND)] > 0)


def _speckle(image: RangeImage, scan: Scan) -> float:
    """Around the seam, too."""
    assert image.label is not None
    label, metres = image.label, image.range
    right, beyond = np.roll(label, -1, 1), np.roll(metres, -1, 1)
    known = image.mask & (beyond > 0) & (label != IGNORE) & (right != IGNORE)
    return _share((label != right)[known & (np.abs(metres - beyond) < _SAME_SURFACE * metres)])


def _confidence(image: RangeImage, scan: Scan) -> float:
    return float(image.channels["confidence"][image.mask].mean()) if image.mask.any() else 0.0


MEASURES: dict[str, Measure] = {
    "empty": Measure("share of cells without a return", None, _empty),
    "unlabelled": Measure("share of returns without a label", "label", _unlabelled),
    "floating": Measure("share of ground returns (road to terrain) above the sensor", "label", _floating),
    "speckle": Measure("share of neighbours in a row, 2 % apart in range, with two labels", "label", _speckle),
    "confidence": Measure("mean confidence of the returns", "confidence", _confidence),
}
"""By the name of the score; a share of nothing is 0."""


class Features(NamedTuple):
    """Of one scan.

    Args:
        numbers: by name in ``MEASURES``.
        ranges: (RANGE_BINS,) returns by range.
        classes: (19,) returns by train id.
        signature: (SIGNATURE,) float16, the square roots of the returns in each cell of a map, farthest ahead and
            left first, as a vector of length 1; 0 for a scan without a return there. The product of two such vectors is
            the Bhattacharyya coefficient of the maps: 1 for scans that are alike, 0 for what has nothing in common.
    """

    numbers: dict[str, float]
    ranges: NDArray[np.int64]
    classes: NDArray[np.int64]
    signature: NDArray[np.float16]


def measured(fields: Collection[str]) -> tuple[str, ...]:
    """The names in ``MEASURES`` of what can be measured of scans with these fields."""
    return tuple(name for name, measure in MEASURES.items() if measure.field is None or measure.field in fields)


def features(image: RangeImage) -> Features:
    """What is measured of a range image, as far as its channels go."""
    scan = unproject(image)
    numbers = {name: MEASURES[name].of(image, scan) for name in measured(image.channels)}
    ranges, _ = np.histogram(image.range[image.mask], RANGE_BINS, (0, image.sensor.range_max))
    labels = np.zeros(0, np.uint8) if scan.label is None else scan.label
    classes = np.bincount(labels[labels != IGNORE], minlength=len(NAMES))
    return Features(numbers, ranges, classes, _signature(scan.points))


def _signature(points: NDArray[np.float32]) -> NDArray[np.float16]:
    half = SIDE / 2
    near = points[(np.abs(points[:, :2]) < half).all(1), :2]
    row, column = ((half - near) * (CELLS / SIDE)).astype(np.int64).clip(0, CELLS - 1).T
    roots = np.sqrt(np.bincount(row * CELLS + column, minlength=SIGNATURE))
    return (roots / max(float(np.linalg.norm(roots)), 1.0)).astype(np.float16)


def _share(true: NDArray[np.bool_]) -> float:
    return float(true.mean()) if len(true) else 0.0
