"""The parts of a skin from two domains: maps of distributions, offsets of lasers, missing
returns."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float32Array, Int32Array
from lidar_synth.lab.town.skin.domains import PART_LEVELS, STRATUM_LEVELS, Domain
from lidar_synth.lab.town.skin.features import (
    BAND,
    BANDS,
    STRATA,
    STRATUM_KIND,
    find_features,
)
from lidar_synth.lab.town.skin.skin import MEANS, RESIDUALS, Skin, part_of
from lidar_synth.lab.town.skin.tables import FEWEST, pool_quantiles

ROUNDS = 3
SHARE = 0.6
"""Corrections of the maps after the first, and the share of the remaining difference that each
removes."""
_SMOOTH = 9
"""Neighbouring lasers over which the running median is taken."""
_LARGEST_FACTOR = 5.0

BAND_LEVELS = [np.arange(BANDS), np.zeros(BANDS, np.int64)]
LEVELS = {"mean": BAND_LEVELS, "residual": PART_LEVELS, "range": STRATUM_LEVELS}

Pair = tuple[Float32Array, NDArray[np.integer]]


def estimate_skin(
    real: Domain,
    town: Domain,
    sensor: Sensor,
    step: float,
    provenance: dict[str, Any],
    lasers: bool = False,
) -> Skin:
    """Compare two domains.

    Args:
        real: the real scans.
        town: scans of the town with lasers of equal gain.
        sensor: the sensor of both.
        step: of the real reflectance, 0 if unknown.
        provenance: of the skin.
        lasers: whether lasers get offsets of their own; otherwise their spread is part of the
            distributions.
    """
    offset = np.stack([laser_offsets(real, sensor.shape[0], kind) for kind in (0, 1)])
    if not lasers:
        offset = np.zeros_like(offset)
    arrays = {"cuts": town.cuts, "offset": offset}
    wanted = _tables(real, offset)
    found = _tables(town, np.zeros_like(offset))
    for name in wanted:
        arrays[f"{name}_town"], arrays[f"{name}_real"] = _both(
            name, found[name], wanted[name]
        )
    arrays["missing"], arrays["missing_laser"] = missing(real, town, sensor.shape[0])
    skin = Skin(sensor, step, provenance, arrays)
    for _ in range(ROUNDS):
        skin = _corrected(skin, town, wanted)
    return skin


def _tables(
    domain: Domain, offset: Float32Array, quantiles: Float32Array | None = None
) -> dict[str, Pair]:
    """Values and groups of the local mean, the residual of reflectance and that of range."""
    mean = np.concatenate(
        [
            s.found.mean - offset[np.minimum(STRATUM_KIND[stratum], 1), s.rows]
            for s, stratum in zip(domain.scans, domain.strata, strict=True)
        ]
    )
    residual = np.concatenate([s.bright - s.found.mean for s in domain.scans])
    distance = np.concatenate([s.found.residual for s in domain.scans])
    stratum = np.concatenate(domain.strata)
    if quantiles is None:
        [quantiles] = pool_quantiles([(mean, BAND[stratum])], BAND_LEVELS, MEANS)
    measured = ~np.isnan(distance)
    return {
        "mean": (mean, BAND[stratum]),
        "residual": (residual, part_of(mean, stratum, quantiles)),
        "range": (distance[measured], stratum[measured]),
    }


def _both(name: str, town: Pair, real: Pair) -> tuple[Float32Array, Float32Array]:
    """The quantiles of the town and the real ones."""
    count = MEANS if name == "mean" else RESIDUALS
    one, other = pool_quantiles([town, real], LEVELS[name], count)
    return one, other


def _corrected(skin: Skin, town: Domain, wanted: dict[str, Pair]) -> Skin:
    """A skin whose maps leave less difference between the town with it and the real scans.

    The residuals of neighbouring returns depend on each other, so that a map of each does not give
    their distribution at once.
    """
    zeros = np.zeros((2, skin.sensor.shape[0]), np.float32)
    level = replace(skin, arrays={**skin.arrays, "offset": zeros}, step=0.0)
    scans = []
    for one, stratum in zip(town.scans, town.strata, strict=True):
        dressed = level.dress(
            one.found,
            stratum,
            one.bright,
            one.rows,
            one.boxed,
            np.ones(len(stratum), np.float32),
        )
        far = np.maximum(np.linalg.norm(one.points, axis=1), 1e-3)
        points = one.points * (1 + dressed.shift / far)[:, None].astype(np.float32)
        found = find_features(points, dressed.reflectance, one.rows, skin.sensor)
        scans.append(one._replace(found=found, bright=dressed.reflectance))
    now = _tables(replace(town, scans=scans), zeros, skin.arrays["mean_real"])
    arrays = dict(skin.arrays)
    for name in wanted:
        got, target = _both(name, now[name], wanted[name])
        moved = skin.arrays[f"{name}_real"] + SHARE * (target - got)
        arrays[f"{name}_real"] = np.maximum.accumulate(moved, axis=1).astype(np.float32)
    return replace(skin, arrays=arrays)


def _collect_differences(domain: Domain, kind: int) -> Pair:
    """Of returns on one kind of surface, the difference to the mean of the one below, and the
    row."""
    difference = []
    ring = []
    for scan, stratum in zip(domain.scans, domain.strata, strict=True):
        pairs = np.flatnonzero(
            (scan.found.below >= 0) & (STRATUM_KIND[stratum] == kind)
        )
        below = scan.found.below[pairs]
        difference.append(scan.found.mean[below] - scan.found.mean[pairs])
        ring.append(scan.rows[pairs])
    return np.concatenate(difference), np.concatenate(ring)


def laser_offsets(domain: Domain, rows: int, kind: int) -> Float32Array:
    """(rows,) reflectance of each laser on one kind of surface, beyond that of its neighbours.

    It is the sum of the median differences between neighbouring rings on the same surface, less its
    running median.
    """
    [table] = pool_quantiles([_collect_differences(domain, kind)], [np.arange(rows)], 3)
    total = np.concatenate([[0.0], np.cumsum(table[:-1, 1])])
    padded = np.pad(total, _SMOOTH // 2, mode="reflect", reflect_type="odd")
    return np.asarray(
        total - np.median(sliding_window_view(padded, _SMOOTH), axis=1), np.float32
    )


def _collect_gaps(domain: Domain) -> tuple[Int32Array, Int32Array]:
    """Stratum and gap of each return."""
    gaps = [s.found.gap for s in domain.scans]
    return np.concatenate(domain.strata), np.concatenate(gaps)


def missing(real: Domain, town: Domain, rows: int) -> tuple[Float32Array, Float32Array]:
    """Probability of a return to be missing between returns of a surface, beyond that of the town.

    Returns:
        (STRATA,) probability, and (rows,) a factor by laser, near 1.
    """
    stratum, gap = _collect_gaps(real)
    of_real = _rate(stratum, gap)
    of_town = _rate(*_collect_gaps(town))
    laser = np.concatenate([s.rows for s in real.scans])
    lost = np.bincount(laser, np.maximum(gap - 1, 0), rows)
    expected = np.bincount(laser, of_real[stratum] * gap, rows)
    factor = (lost + 1) / (expected + 1)
    excess = np.clip((of_real - of_town) / np.maximum(1 - of_town, 0.1), 0, 0.9)
    return excess.astype(np.float32), np.clip(factor, 0, _LARGEST_FACTOR).astype(
        np.float32
    )


def _rate(stratum: Int32Array, gap: Int32Array) -> NDArray[np.float64]:
    """(STRATA,) share of missing returns among the firings between returns of one surface."""
    rate = np.zeros(STRATA)
    open_ = np.ones(STRATA, bool)
    for level in STRATUM_LEVELS:
        count = int(level.max()) + 1
        fired = np.bincount(level[stratum], gap, count)[level]
        lost = np.bincount(level[stratum], np.maximum(gap - 1, 0), count)[level]
        now = open_ & (fired >= FEWEST)
        rate[now] = lost[now] / fired[now]
        open_ &= ~now
    return rate
