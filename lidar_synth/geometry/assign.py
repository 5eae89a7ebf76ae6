"""The beam and the firing of every point of a scan of a known sensor."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.lines import nearest_beams, residuals
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor


class Assigned(NamedTuple):
    """Where each point of a scan comes from.

    Args:
        ring: (N,) int16 the nearest beam, 0 = highest.
        firing: (N,) int32 its firing, 0 = behind the sensor, clockwise; -1 on a beam of unknown
            azimuth offset.
        off: (N,) float32 degrees by which the point lies above its beam.
    """

    ring: NDArray[np.int16]
    firing: NDArray[np.int32]
    off: NDArray[np.float32]


def assign_beams(scan: Scan, sensor: Sensor | None = None) -> Assigned:
    """Assign a ring and a firing to each point, by its direction as seen from each laser.

    Args:
        scan: N points in the sensor's frame, without motion compensation (see ``reskew``).
        sensor: by default the scan's own. Its lasers point and start as ``Sensor.optics`` says.

    Returns:
        The ring and firing of each point, and its distance from the beam: points that lie far off
        are not from this sensor, or not in its frame.

    Example:
        >>> from lidar_synth import Town, assign_beams
        >>> scan = Town(seed=0, sensor="os1_128", scans=1, motion=False)[0]
        >>> found = assign_beams(scan)
        >>> bool((found.ring == scan.ring).all()), bool(abs(found.off).max() < 0.001)
        (True, True)
    """
    sensor = sensor or scan.sensor
    points = scan.points.astype(np.float64)
    elevations, heights = sensor.optics()
    tangents = np.tan(elevations)
    ring = nearest_beams(points, tangents, heights)
    off = np.degrees(residuals(points, ring, tangents, heights))
    count = sensor.firings or sensor.columns
    azimuth = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    if sensor.azimuths is not None:
        azimuth -= np.asarray(sensor.azimuths, np.float64)[ring] / 360
    unknown = np.isnan(azimuth)
    firing = (
        np.floor(((np.nan_to_num(azimuth) + 0.5) % 1.0) * count).astype(np.int32)
        % count
    )
    firing[unknown] = -1
    return Assigned(ring.astype(np.int16), firing, off.astype(np.float32))
