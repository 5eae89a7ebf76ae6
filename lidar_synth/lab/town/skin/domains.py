"""The returns of several scans with their features and strata: a domain, real or the town's."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.arrays import Float32Array, Int32Array
from lidar_synth.geometry.projection import laser_rows
from lidar_synth.geometry.transfer.surfaces import as_fired
from lidar_synth.lab.town.catalogue import Rng
from lidar_synth.lab.town.skin.features import (
    BANDS,
    CELLS,
    HEIGHTS,
    KINDS,
    ROUGH,
    STRATA,
    RayFeatures,
    find_features,
    find_strata,
)
from lidar_synth.lab.town.skin.skin import PARTS
from lidar_synth.lab.town.skin.tables import pool_quantiles

_ANOTHER = np.radians(1.0)
"""Mean distance between the elevations of rings and lasers above which a scan is of another
sensor."""


class Returns(NamedTuple):
    """The returns of one scan in order, with their features.

    Args:
        found: their features.
        points, bright, rows: (N, 3) metres, (N,) reflectance with its rounding undone at random,
            (N,) laser.
        boxed: (N,) whether a point belongs to an object with a box.
    """

    found: RayFeatures
    points: Float32Array
    bright: Float32Array
    rows: Int32Array
    boxed: NDArray[np.bool_]


def _check_lasers(scan: Scan, rows: NDArray[np.intp], lasers: Sensor) -> None:
    """Refuse a scan whose rings are not where the lasers of its sensor look."""
    distance = np.maximum(np.linalg.norm(scan.points, axis=1), 1e-3)
    elevation = np.arcsin(scan.points[:, 2] / distance)
    away = np.abs(elevation - lasers.laser_elevations[rows])[distance > 5]
    if len(away) and np.median(away) > _ANOTHER:
        raise DataError(
            f"scan {scan.id!r}: its rings are {np.degrees(np.median(away)):.1f} degrees from the "
            f"lasers of {lasers.name!r} (median)",
            "scans of this sensor",
        )


def returns_of(
    scan: Scan,
    lasers: Sensor,
    step: float,
    rng: Rng,
    centred: bool,
) -> Returns:
    """The returns of a scan in the order of features.

    Args:
        scan: in ring order, or with ring numbers.
        lasers: its sensor.
        step: of its reflectance, 0 if unknown.
        rng: undoes the rounding of reflectance.
        centred: whether reflectance was rounded to the nearest step rather than down.

    Raises:
        DataError: on a scan that is not in ring order, of another sensor, or a range image with
            fewer columns than the sensor fires.
    """
    rows = laser_rows(scan, lasers.by_beams())
    if scan.ring is not None:
        order = np.lexsort((np.arctan2(scan.points[:, 1], scan.points[:, 0]), rows))
        scan = scan[order]
        rows = rows[order]
    points = scan.points
    boxed = np.zeros(len(points), bool) if scan.instance is None else scan.instance > 0
    _check_lasers(scan, rows, lasers)
    if as_fired(replace(scan, sensor=lasers), rows) is not lasers:
        raise DataError(
            f"scan {scan.id!r}: a range image, with {lasers.columns} columns for the "
            f"{lasers.firings} firings of {lasers.name!r}",
            "scans with every return",
        )
    dither = (rng.random(len(points), np.float32) - 0.5 * centred) * step
    bright = (scan.reflectance + dither).astype(np.float32)
    laser = rows.astype(np.int32)
    return Returns(
        find_features(points, bright, laser, lasers), points, bright, laser, boxed
    )


@dataclass(frozen=True)
class Domain:
    """The returns of several scans.

    Args:
        scans: the returns of each.
        cuts: (CELLS, ROUGH - 1) limits of roughness between the ranks.
        strata: of each scan, (N,) the stratum of each return.
    """

    scans: list[Returns]
    cuts: Float32Array
    strata: list[Int32Array]

    @classmethod
    def of(cls, scans: list[Returns]) -> "Domain":
        """Rank the roughness of the returns of some scans."""
        cell = np.concatenate([s.found.cell for s in scans])
        rough = np.concatenate([s.found.roughness for s in scans])
        fine = np.arange(CELLS)
        levels = [fine, fine // BANDS, 0 * fine]
        [table] = pool_quantiles([(rough, cell)], levels, ROUGH + 1)
        cuts = np.ascontiguousarray(table[:, 1:-1])
        return cls(scans, cuts, [find_strata(s.found, cuts) for s in scans])


def _pool_levels(parts: int = 1) -> list[NDArray[np.int64]]:
    """From fine to coarse, the set of strata to which each stratum belongs: without range, without
    height, all."""
    stratum, part = np.divmod(np.arange(STRATA * parts), parts)
    cell, rank = np.divmod(stratum, ROUGH)
    place = cell // BANDS
    kind = place // (len(HEIGHTS) + 1)
    assert kind.max() == len(KINDS) - 1
    return [
        np.arange(STRATA * parts),
        (place * ROUGH + rank) * parts + part,
        (kind * ROUGH + rank) * parts + part,
        part,
    ]


PART_LEVELS = _pool_levels(PARTS)
STRATUM_LEVELS = _pool_levels()
