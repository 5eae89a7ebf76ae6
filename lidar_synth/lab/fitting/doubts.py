"""What a fit is not sure of, as sentences, and the sensor that a vendor sells with these beams."""

from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.files.parsing import parse_yaml
from lidar_synth.geometry import presets
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.fitting.azimuths import FAR, FEW, FEWEST, Azimuths

FEW_POINTS = 50
"""A beam needs as many points to be certain."""

LEAST_SHARE = 0.9
"""Share of a beam's points within 0.05 degrees of it; less is a doubt."""

STRAYS = 0.005
"""Share of points that lie on no beam, or too near to be fitted, which rounds to one per cent."""

SAME = 0.2
"""Beams within this part of their spacing of a vendor's table, or within 0.1 degrees, are those of
the table."""

MOST_MISSING = 0.5
"""Share of a table's beams that may be missing for it to be named."""


def doubts(
    elevations: Float64Array,
    points: NDArray[np.int64],
    within: Float64Array,
    near: float,
    known: Azimuths,
) -> list[str]:
    """One sentence for each part of a fit that is not certain.

    Args:
        elevations: (B,) degrees.
        points: (B,) number of points of each beam.
        within: (B,) share of them within 0.05 degrees.
        near: share of all points that are too near to be fitted.
        known: firings and azimuth offsets.
    """
    found = []
    if few := _listed(elevations[points < FEW_POINTS]):
        found.append(f"The beams at {few} degrees have fewer than {FEW_POINTS} points.")
    if wide := _listed(elevations[(points >= FEW_POINTS) & (within < LEAST_SHARE)]):
        found.append(
            f"The beams at {wide} degrees have under {LEAST_SHARE:.0%} of their points within "
            "0.05 degrees."
        )
    strays = 1 - float((points * within).sum() / max(points.sum(), 1))
    if strays >= STRAYS:
        found.append(
            f"{strays:.1%} of the points lie farther than 0.05 degrees from every beam."
        )
    if near >= STRAYS:
        found.append(
            f"{near:.1%} of the points are nearer than 0.5 m and were not fitted."
        )
    return found + _of_azimuths(elevations, known)


def _listed(values: Float64Array) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _of_azimuths(elevations: Float64Array, known: Azimuths) -> list[str]:
    found = []
    if known.firings is None:
        found.append(
            "The number of firings is not known: too many points of each beam are missing."
        )
    if known.offsets is None:
        return [
            *found,
            "The azimuth offsets are not known: the points have neither a time nor a common "
            "raster.",
        ]
    if missing := _listed(elevations[np.isnan(known.offsets)]):
        needed = (
            f"{FEWEST} points beyond {FAR:.0f} m"
            if known.known == "time"
            else f"{FEW} points"
        )
        found.append(
            f"The azimuth offsets of the beams at {missing} degrees are not known: no scan has "
            f"{needed} there."
        )
    if known.known == "one firing" and np.nanmax(np.abs(known.offsets)) >= 0.005:
        found.append(
            "The azimuth offsets are known up to a multiple of the angle between two firings."
        )
    elif known.spread > 0.05:
        found.append(
            f"The azimuth offsets differ between scans by {known.spread:.2f} degrees."
        )
    return found


@lru_cache(maxsize=1)
def vendors() -> dict[str, Float64Array]:
    """{name: (B,) elevations in degrees, highest first} of the sensors in ``vendors.yaml``."""
    text = (
        files("lidar_synth.geometry")
        .joinpath("vendors.yaml")
        .read_text(encoding="utf-8")
    )
    tables = parse_yaml(text, "vendors.yaml")
    return {name: _elevations(table) for name, table in tables.items()}


def _elevations(table: Any) -> Float64Array:
    """An entry of ``vendors.yaml`` as a table."""
    if isinstance(table, dict):
        return np.linspace(*table["evenly"])
    return np.asarray(
        presets()[table].elevations if isinstance(table, str) else table, np.float64
    )


def name_vendor(elevations: Float64Array, points: NDArray[np.int64]) -> str:
    """The vendors' sensor with these beams and the fewest others, and how many it has that are
    missing; "" if none.

    Args:
        elevations: (B,) degrees, highest first.
        points: (B,) number of points of each beam.
    """
    best = ""
    missing = np.inf
    for name, table in vendors().items():
        spacing = np.abs(np.gradient(table))
        nearest = np.abs(elevations[:, None] - table).argmin(1)
        off = np.abs(elevations - table[nearest])
        if (off > np.minimum(SAME * spacing[nearest], 0.1)).any() or len(
            np.unique(nearest)
        ) < len(elevations):
            continue
        few = len(table) - int((points >= FEW_POINTS).sum())
        if few < missing and few <= MOST_MISSING * len(table):
            best = name + (f"; {few} channels had few points or none" if few else "")
            missing = few
    return best
