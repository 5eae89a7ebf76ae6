"""The layout of a scan: its boxes, and the ground and the outlines that its points show."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, TRAIN_ID, has_ground
from lidar_synth.errors import DataError
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.geometry.layout.layout import (
    CLASSES,
    Layout,
    Outline,
    around_sensor,
)
from lidar_synth.geometry.overlap import overlapping_pairs
from lidar_synth.geometry.scan import Boxes, Scan

KINDS = {
    "building": ("building",),
    "vegetation": ("vegetation", "trunk"),
    "fence": ("fence",),
}
"""The classes of points behind each kind of outline."""

SECTORS = 512
"""Directions in which an outline has a corner."""

_LEAST = 3  # minimum number of returns of an outline in a sector
# The others are in metres.
_GAP = (
    1.5  # between an outline and what stands behind it, and between connected sectors
)
_STEP = 0.5  # by which the edges of connected sectors may differ
_EDGE = 0.05  # between the outermost return and the edge of an outline
_NEAR = 30.0  # around the sensor, in which the ground is a plane
# Without labels:
_FLAT = 0.3  # largest depth of a building's returns in one sector
_CLEAR = 0.3  # height above the ground from which on a return is of an outline
_SQUARE = 1.0  # side of the squares whose lowest return may be ground


def layout_of(scan: Scan, reach: float | None = None) -> Layout:
    """The layout of a scan.

    Args:
        scan: N points and boxes. Ground and outlines are those of its labels; a scan without labels
            of the ground has the plane of its lowest returns, and outlines of what stands on it.
            Its boxes are ``select_known_boxes``.
        reach: of the ground, metres; by default the sensor's range.

    Raises:
        DataError: on a scan without boxes, or with fewer than 20 returns of the ground.

    Example:
        >>> from lidar_synth import Town, layout_of
        >>> layout = layout_of(Town(seed=0, scans=1)[0])
        >>> len(layout.boxes) > 0, len(layout.outlines) > 0
        (True, True)
    """
    if scan.boxes is None:
        raise DataError(
            f"scan {scan.id!r} has no boxes", "a scan with boxes around its objects"
        )
    label = scan.label if has_ground(scan.label) else None
    if label is None:
        ground = _plane(_lowest(scan.points), scan.id)
        outlines = list(_unlabelled(scan, ground))
    else:
        ground = _plane(scan.points[GROUND[label]], scan.id)
        outlines = list(_labelled(scan.points, label))
    return Layout(
        select_known_boxes(scan),
        ground,
        outlines,
        reach or scan.sensor.range_max,
        scan.id,
    )


def select_known_boxes(scan: Scan) -> Boxes:
    """The boxes of a scan that its layout can have: of known classes, within the sensor's range,
    and not around the sensor; of overlapping boxes only the first."""
    assert scan.boxes is not None
    boxes = scan.boxes[np.hypot(*scan.boxes.values[:, :2].T) <= scan.sensor.range_max]
    known = np.isin(np.array(boxes.names, "U32"), CLASSES)
    boxes = boxes[known & ~around_sensor(boxes)]
    dropped: set[int] = set()
    # Pairs are in order: whether the first box of a pair is dropped is known by then.
    for first, second in overlapping_pairs(boxes):
        if first not in dropped:
            dropped.add(second)
    if not dropped:
        return boxes
    return boxes[[i for i in range(len(boxes)) if i not in dropped]]


def _plane(points: Float32Array, name: str) -> tuple[float, float, float]:
    """The plane z = a + b x + c y through ground returns near the sensor, by repeated least
    squares."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _NEAR].astype(np.float64)
    if len(near) < 20:
        raise DataError(
            f"scan {name!r} with {len(near)} returns of the ground", "20 or more"
        )
    plane = np.zeros(3)
    kept = near
    for limit in (0.5, 0.2):
        design = np.c_[np.ones(len(kept)), kept[:, :2]]
        # Returns crowd near the sensor; the weight makes the plane fit everywhere. A level plane is
        # preferred.
        weight = np.hypot(kept[:, 0], kept[:, 1])[:, None]
        normal = design.T @ (weight * design) + np.diag([0.0, 1e3, 1e3])
        plane = np.linalg.solve(normal, design.T @ (weight[:, 0] * kept[:, 2]))
        distance = np.abs(near[:, 2] - np.c_[np.ones(len(near)), near[:, :2]] @ plane)
        kept = near[distance < limit] if (distance < limit).sum() >= 20 else kept
    return float(plane[0]), float(plane[1]), float(plane[2])


def _lowest(points: Float32Array) -> Float32Array:
    """The lowest return of each column of 1 m x 1 m, where it lies below the sensor."""
    below = points[points[:, 2] < -0.5]
    cell = np.floor(below[:, :2] / _SQUARE).astype(np.int64) @ (1 << 20, 1)
    order = np.lexsort((below[:, 2], cell))
    _, first = np.unique(cell[order], return_index=True)
    return below[order[first]]


def _labelled(points: Float32Array, label: NDArray[np.uint8]) -> Iterator[Outline]:
    for kind, classes in KINDS.items():
        train_ids = [TRAIN_ID[name] for name in classes]
        for profile in _profiles(points[np.isin(label, train_ids)]):
            yield Outline(kind, profile[:, :2], profile[:, 2], profile[:, 3])


def _unlabelled(scan: Scan, ground: tuple[float, float, float]) -> Iterator[Outline]:
    """Outlines of what stands on the ground outside all boxes: flat things are buildings, others
    vegetation."""
    height = scan.points[:, 2] - (
        ground[0] + scan.points[:, :2] @ np.array(ground[1:], np.float32)
    )
    assert scan.boxes is not None
    outside = ~scan.boxes.contain(scan.points).any(0)
    for profile in _profiles(scan.points[(height > _CLEAR) & outside]):
        kind = "building" if np.median(profile[:, 4]) < _FLAT else "vegetation"
        yield Outline(kind, profile[:, :2], profile[:, 2], profile[:, 3])


def _profiles(points: Float32Array) -> Iterator[Float32Array]:
    """The first thing in each sector, connected to lines: (K, 5) x, y, lowest z, highest z, depth
    of its returns."""
    rho = np.hypot(points[:, 0], points[:, 1])
    azimuth = -np.arctan2(points[:, 1], points[:, 0])
    sector = ((azimuth / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    order = np.lexsort((rho, sector))
    rho = rho[order]
    sector = sector[order]
    z = points[order, 2]
    rows = []
    for number, start, stop in _groups(sector):
        first, last = _find_run(rho[start:stop])
        if last:
            part = slice(start + first, start + last)
            near, far = np.quantile(rho[part], (0.1, 0.9))
            middle = float(np.median(rho[part]))
            rows.append(
                (
                    number,
                    middle,
                    z[part].min() - _EDGE,
                    z[part].max() + _EDGE,
                    far - near,
                )
            )
    yield from _connected(np.array(rows, np.float64).reshape(-1, 5))


def _find_run(rho: Float32Array) -> tuple[int, int]:
    """The first run of ascending distances without a gap that has enough of them; (0, 0) without
    one."""
    ends = np.append(np.flatnonzero(np.diff(rho) > _GAP) + 1, len(rho))
    for first, last in pairwise([0, *ends.tolist()]):
        if last - first >= _LEAST:
            return first, last
    return 0, 0


def _groups(sector: NDArray[np.int64]) -> Iterator[tuple[int, int, int]]:
    """(sector, first, last + 1) of sorted sectors."""
    numbers, starts = np.unique(sector, return_index=True)
    yield from zip(
        numbers.tolist(),
        starts.tolist(),
        np.append(starts, len(sector))[1:].tolist(),
        strict=True,
    )


def _connected(rows: NDArray[np.float64]) -> Iterator[Float32Array]:
    """Lines of neighbouring sectors with similar distance and edges; a sector alone is a line
    across it."""
    if not len(rows):
        return
    gap = np.abs(np.diff(rows, axis=0))
    allowed = np.maximum(_GAP, 0.15 * rows[1:, 1])
    breaks = (
        (gap[:, 0] > 1)
        | (gap[:, 1] > allowed)
        | (gap[:, 2] > _STEP)
        | (gap[:, 3] > _STEP)
    )
    for line in np.split(rows, np.flatnonzero(breaks) + 1):
        yield _trace(line)


def _trace(line: NDArray[np.float64]) -> Float32Array:
    """The line (K, 5) of ``_profiles`` of connected sectors (K - 2, 5)."""
    # Half a sector is added on both sides, so that lines of neighbouring sectors meet.
    edges = np.r_[line[0, 0], line[:, 0] + 0.5, line[-1, 0] + 1]
    padded = np.r_[line[:1], line, line[-1:]]
    azimuth = (edges / SECTORS - 0.5) * 2 * np.pi
    x = padded[:, 1] * np.cos(azimuth)
    y = -padded[:, 1] * np.sin(azimuth)
    return np.asarray(np.c_[x, y, padded[:, 2:]], np.float32)
