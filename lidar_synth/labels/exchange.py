"""Parts of the turn exchanged between two scans of one grid: sectors of azimuth, bands of elevation.

Sectors after PolarMix (Xiao et al., "PolarMix: A General Data Augmentation Technique for LiDAR Point Clouds", NeurIPS
2022), bands after LaserMix (Kong et al., "LaserMix for Semi-Supervised LiDAR Semantic Segmentation", CVPR 2023); here
both end at the edges of cells, so that no cell shows two scans.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.projection import locate
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.labels.boxes import overlapping
from lidar_synth.labels.ground import standing
from lidar_synth.labels.merge import merged
from lidar_synth.labels.objects import holding
from lidar_synth.labels.view import refuse_coarser


def thinned(scan: Scan, sensor: Sensor) -> Scan:
    """The scan as another sensor would have it: the nearest return in each of its cells.

    Raises:
        DataError: where the scan's own sensor is coarser.
    """
    refuse_coarser(scan.sensor, sensor)
    point = locate(scan.points, sensor).point
    return replace(scan[np.sort(point[point >= 0])], sensor=sensor)


def swap_sector(scan: Scan, other: Scan, start: int, width: int) -> Scan:
    """A scan in which some columns are another's.

    Boxes that an edge cuts through leave, with what stands in them; the others hold the returns of their own scan only,
    and all returns of their instance: they grow by some centimetres where noise or a tilt takes one outside.

    Args:
        scan: keeps the remaining columns.
        other: thinned to the grid of ``scan``.
        start: first column of the sector.
        width: columns of the sector, 0..W; they wrap.
    """
    scan, other = holding(scan), holding(other)
    columns = scan.sensor.columns
    cell, cell_other = (locate(s.points, scan.sensor).cell for s in (scan, other))
    first = _whole(scan, (cell >= 0) & ((cell - start) % columns >= width))
    second = _whole(other, (cell_other >= 0) & ((cell_other - start) % columns < width))
    return merged(*_apart(first, second))


def swap_bands(scan: Scan, other: Scan, bands: int, odd: bool) -> Scan:
    """A scan in which every other band of rows is another's; without boxes, for few objects fit into a band.

    Args:
        scan: keeps the bands 0, 2, ... from the top, or 1, 3, ... if ``odd``.
        other: thinned to the grid of ``scan``.
        bands: how many, 2..H, as equal as whole rows can be.
        odd: see ``scan``.
    """
    rows, columns = scan.sensor.shape
    ours = (np.arange(rows) * bands // rows + odd) % 2 == 0
    parts = []
    for part, mine in ((scan, ours), (other, ~ours)):
        cell = locate(part.points, scan.sensor).cell
        parts.append(replace(part[(cell >= 0) & mine[cell // columns]], boxes=None))
    return merged(parts[0], parts[1:])


def _whole(scan: Scan, keep: NDArray[np.bool_]) -> Scan:
    """The points that are kept, without the objects that lose some or all of theirs."""
    if scan.boxes is None or not len(scan.boxes):
        return scan[keep]
    inside = standing(scan, scan.boxes)
    cut = np.logical_or(~inside.any(1), (inside & ~keep).any(1))
    return _without(scan, cut, inside, keep)


def _without(
    scan: Scan, gone: NDArray[np.bool_], inside: NDArray[np.bool_], keep: NDArray[np.bool_] | bool = True
) -> Scan:
    """The scan without some of its M boxes and what stands (M, N) in them."""
    assert scan.boxes is not None
    left = ~inside[gone].any(0)
    return replace(scan[left & keep], boxes=scan.boxes[~gone])


def _apart(first: Scan, second: Scan) -> tuple[Scan, list[Scan]]:
    """Both scans with boxes that share neither ground nor returns: the first one's objects go before."""
    a, b = first.boxes, second.boxes
    if a is not None and b is not None and len(a) and len(b):
        clash = np.array([overlapping(box, a.values).any() for box in b.values])
        second = _without(second, clash, standing(second, b))
    return _outside(first, second.boxes), [_outside(second, first.boxes)]


def _outside(scan: Scan, boxes: Boxes | None) -> Scan:
    """The points that do not stand in boxes of somebody else."""
    if boxes is None or not len(boxes):
        return scan
    return scan[~standing(replace(scan, instance=None), boxes).any(0)]
