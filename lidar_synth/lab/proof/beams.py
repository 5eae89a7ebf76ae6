"""The scans of a sensor with fewer beams: every second, fourth, ... beam of another one stays."""

from dataclasses import replace
from typing import Any

import numpy as np

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.projection import laser_rows

FEWEST = 4


def kept_beams(sensor: Sensor, beams: int) -> slice:
    """The rows of a sensor of which ``beams`` evenly spaced ones stay.

    Raises:
        ConfigError: unless the number of rows is a multiple of ``beams``, at least twice as large.
    """
    rows = sensor.shape[0]
    there = [n for n in range(rows // 2, FEWEST - 1, -1) if rows % n == 0]
    if beams not in there:
        raise ConfigError(
            f"{beams} of the {rows} beams of {sensor.name!r}",
            f"one of {', '.join(map(str, there)) or 'none: it has too few'}",
            f"Use --beams {there[0]} (beams={there[0]})." if there else "",
        )
    step = rows // beams
    return slice(step // 2, None, step)


def coarser(sensor: Sensor, beams: int | None) -> Sensor:
    """The sensor that has only so many of a sensor's beams; itself for None.

    Raises:
        ConfigError: as ``kept_beams``.
    """
    if beams is None:
        return sensor
    kept = kept_beams(sensor, beams)
    lasers: dict[str, Any] = {
        name: table[kept]
        for name in ("beams", "heights", "azimuths")
        if (table := getattr(sensor, name)) is not None
    }
    elevations = np.degrees(sensor.laser_elevations.astype(np.float64))[kept]
    return replace(
        sensor,
        name=f"{sensor.name}/{beams} beams",
        rows=None,
        fov_up=None,
        fov_down=None,
        elevations=tuple(elevations.tolist()),
        **lasers,
    )


def keep_beams(scan: Scan, beams: int | None) -> Scan:
    """The returns of so many of a scan's beams, with their labels; the scan itself for None.

    Beams are told by the rings, by the order of the points, or else by their directions.

    Raises:
        ConfigError: as ``kept_beams``.
    """
    if beams is None:
        return scan
    rows = scan.sensor.shape[0]
    number = np.full(rows, -1, np.int16)
    number[kept_beams(scan.sensor, beams)] = np.arange(beams)
    try:
        row = laser_rows(scan, scan.sensor.by_beams())
    except DataError:
        row = assign_beams(scan).ring.astype(np.int64)
    ring = number[row]
    given = None if scan.ring is None else ring
    sensor = coarser(scan.sensor, beams)
    return replace(replace(scan, ring=given)[ring >= 0], sensor=sensor)
