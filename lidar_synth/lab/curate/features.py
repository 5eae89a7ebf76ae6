"""Measurements of a single scan."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE, NAMES
from lidar_synth.generate.support import find_unsupported
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.geometry.projection import unproject

RANGE_BINS = 64
"""Bins of the histogram of ranges, from 0 to the sensor's range_max."""

SIDE = 80.0
CELLS = 32
"""The bird's-eye map of a signature: side of its square around the sensor in metres, and cells
along a side."""

SIGNATURE = CELLS * CELLS
"""Entries of a signature."""

_SAME_SURFACE = (
    0.02  # relative range difference of two neighbouring cells on the same surface
)


@dataclass(frozen=True)
class ScanMeasure:
    """One number that describes a scan.

    Args:
        meaning: description with its interval.
        field: the field that the scan needs; None = none.
        of: computes the number from the range image and its unprojected scan.
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
    return _share(scan.points[:, 2][GROUND[scan.label]] > 0)


def _speckle(image: RangeImage, scan: Scan) -> float:
    """Compares cells across the seam of the image, too."""
    assert image.label is not None
    label = image.label
    metres = image.range
    right = np.roll(label, -1, 1)
    beyond = np.roll(metres, -1, 1)
    known = image.mask & (beyond > 0) & (label != IGNORE) & (right != IGNORE)
    return _share(
        (label != right)[known & (np.abs(metres - beyond) < _SAME_SURFACE * metres)]
    )


def _isolated(image: RangeImage, scan: Scan) -> float:
    return _share(find_unsupported(image.range[None])[0][image.mask])


def _confidence(image: RangeImage, scan: Scan) -> float:
    if image.mask.any():
        return float(image.channels["confidence"][image.mask].mean())
    return 0.0


MEASURES: dict[str, ScanMeasure] = {
    "empty": ScanMeasure("share of cells without a return", None, _empty),
    "isolated": ScanMeasure(
        "share of returns without three neighbours at almost the same range",
        None,
        _isolated,
    ),
    "unlabelled": ScanMeasure("share of returns without a label", "label", _unlabelled),
    "floating": ScanMeasure(
        "share of ground returns (road to terrain) above the sensor", "label", _floating
    ),
    "speckle": ScanMeasure(
        "share of neighbours in a row, 2 % apart in range, with two labels",
        "label",
        _speckle,
    ),
    "confidence": ScanMeasure(
        "mean confidence of the returns", "confidence", _confidence
    ),
}
"""Measures by the name of their score; a share of an empty set is 0."""


class ScanFeatures(NamedTuple):
    """The features of one scan.

    Args:
        numbers: {name: value} for the names in ``MEASURES``.
        ranges: (RANGE_BINS,) number of returns per range bin.
        classes: (19,) number of returns per train id.
        signature: (SIGNATURE,) float16 unit vector: the square roots of the number of returns in
            each cell of a bird's-eye map, starting with the cell farthest ahead and to the left; 0
            for a scan without returns in the map. The inner product of two signatures is the
            Bhattacharyya coefficient of the maps: 1 for identical maps, 0 for disjoint ones.
    """

    numbers: dict[str, float]
    ranges: NDArray[np.int64]
    classes: NDArray[np.int64]
    signature: NDArray[np.float16]


def supported_measures(fields: Collection[str]) -> tuple[str, ...]:
    """The names in ``MEASURES`` that scans with these fields support."""
    return tuple(
        name
        for name, measure in MEASURES.items()
        if measure.field is None or measure.field in fields
    )


def features(image: RangeImage) -> ScanFeatures:
    """The features of a range image; measures of missing channels are left out."""
    scan = unproject(image)
    numbers = {
        name: MEASURES[name].of(image, scan)
        for name in supported_measures(image.channels)
    }
    ranges, _ = np.histogram(
        image.range[image.mask], RANGE_BINS, (0, image.sensor.range_max)
    )
    labels = np.zeros(0, np.uint8) if scan.label is None else scan.label
    classes = np.bincount(labels[labels != IGNORE], minlength=len(NAMES))
    return ScanFeatures(numbers, ranges, classes, _signature(scan.points))


def _signature(points: NDArray[np.float32]) -> NDArray[np.float16]:
    half = SIDE / 2
    near = points[(np.abs(points[:, :2]) < half).all(1), :2]
    cells = ((half - near) * (CELLS / SIDE)).astype(np.int64)
    row, column = cells.clip(0, CELLS - 1).T
    roots = np.sqrt(np.bincount(row * CELLS + column, minlength=SIGNATURE))
    return (roots / max(float(np.linalg.norm(roots)), 1.0)).astype(np.float16)


def _share(true: NDArray[np.bool_]) -> float:
    return float(true.mean()) if len(true) else 0.0
