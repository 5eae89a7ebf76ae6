"""Parts exchanged between two scans of one grid: sectors of azimuth, and bands of elevation.

Sectors follow PolarMix (Xiao et al., "PolarMix: A General Data Augmentation Technique for LiDAR
Point Clouds", NeurIPS 2022), bands LaserMix (Kong et al., "LaserMix for Semi-Supervised LiDAR
Semantic Segmentation", CVPR 2023). Here both end at the edges of cells, so that no cell contains
returns of two scans.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, Scan, Sensor
from lidar_synth.geometry.overlap import find_overlapping
from lidar_synth.geometry.projection import locate
from lidar_synth.labels.ground import standing
from lidar_synth.labels.merge import merge_scans
from lidar_synth.labels.objects import enlarge_boxes
from lidar_synth.labels.view import refuse_coarser


def thin_scan(scan: Scan, sensor: Sensor) -> Scan:
    """Thin a scan to the grid of another sensor: the nearest return in each of its cells.

    Ring numbers are kept only if both sensors have the same lasers.

    Raises:
        DataError: if the scan's own sensor is coarser.
    """
    refuse_coarser(scan.sensor, sensor)
    point = locate(scan.points, sensor).point
    ring = scan.ring if sensor.same_lasers(scan.sensor) else None
    return replace(replace(scan, ring=ring)[np.sort(point[point >= 0])], sensor=sensor)


def swap_sector(scan: Scan, other: Scan, start: int, width: int) -> Scan:
    """Replace a sector of columns of a scan by those of another scan.

    Boxes that an edge of the sector cuts are removed with their objects. The other boxes contain
    only returns of their own scan, and all returns of their instance: a box is enlarged by some
    centimetres if noise or tilt puts a return outside.

    Args:
        scan: the scan that keeps the remaining columns.
        other: the scan of the sector, thinned to the grid of ``scan``.
        start: first column of the sector.
        width: number of columns of the sector, 0..W; they wrap around.
    """
    scan = enlarge_boxes(scan)
    other = enlarge_boxes(other)
    columns = scan.sensor.columns
    cell, cell_other = (locate(s.points, scan.sensor).cell for s in (scan, other))
    first = _without_cut_objects(
        scan, (cell >= 0) & ((cell - start) % columns >= width)
    )
    second = _without_cut_objects(
        other, (cell_other >= 0) & ((cell_other - start) % columns < width)
    )
    return merge_scans(*_separated(first, second))


def swap_bands(scan: Scan, other: Scan, bands: int, odd: bool) -> Scan:
    """Replace every other band of rows by those of another scan, and drop all boxes, as few objects
    fit into a band.

    Args:
        scan: the scan that keeps the bands 0, 2, ... from the top, or 1, 3, ... if ``odd``.
        other: the scan of the other bands, thinned to the grid of ``scan``.
        bands: number of bands, 2..H; their numbers of rows differ by one at most.
        odd: see ``scan``.
    """
    rows, columns = scan.sensor.shape
    ours = (np.arange(rows) * bands // rows + odd) % 2 == 0
    parts = []
    for part, mine in ((scan, ours), (other, ~ours)):
        cell = locate(part.points, scan.sensor).cell
        parts.append(replace(part[(cell >= 0) & mine[cell // columns]], boxes=None))
    return merge_scans(parts[0], parts[1:])


def _without_cut_objects(scan: Scan, keep: NDArray[np.bool_]) -> Scan:
    """Some of the scan's points, without the objects that would lose any of theirs."""
    if scan.boxes is None or not len(scan.boxes):
        return scan[keep]
    inside = standing(scan, scan.boxes)
    cut = np.logical_or(~inside.any(1), (inside & ~keep).any(1))
    return _without(scan, cut, inside, keep)


def _without(
    scan: Scan,
    removed: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    keep: NDArray[np.bool_] | bool = True,
) -> Scan:
    """The scan without some of its M boxes and the points (M, N) that belong to them."""
    assert scan.boxes is not None
    remaining = ~inside[removed].any(0)
    return replace(scan[remaining & keep], boxes=scan.boxes[~removed])


def _separated(first: Scan, second: Scan) -> tuple[Scan, list[Scan]]:
    """Both scans with boxes that share neither ground nor returns; objects of the first scan take
    precedence."""
    a = first.boxes
    b = second.boxes
    if a is not None and b is not None and len(a) and len(b):
        clash = np.array([find_overlapping(box, a.values).any() for box in b.values])
        second = _without(second, clash, standing(second, b))
    return _outside(first, second.boxes), [_outside(second, first.boxes)]


def _outside(scan: Scan, boxes: Boxes | None) -> Scan:
    """The points that do not belong to the boxes of another scan."""
    if boxes is None or not len(boxes):
        return scan
    return scan[~standing(replace(scan, instance=None), boxes).any(0)]
