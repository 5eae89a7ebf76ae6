"""A check whether points come from the sensor that is assumed for them.

A file of points names no sensor, and with a wrong one points are lost silently: they fall into
other rows, or outside of the field of view. ``agreement`` counts the points and the beams that
contradict a sensor.

Recorded scans contradict their own sensor a little: they tilt by up to one degree against the table
of beams, motion compensation moves near points by 0.3 m, and some lasers start up to 0.2 m above
the origin. Therefore angles are compared only beyond ``NEAR`` metres, for each sector of azimuth at
the tilt that fits best.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.sensor import Sensor

NEAR = 5.0
FAR = 15.0
"""Metres beyond which points are compared with the field of view, and with single beams."""

TILT = 1.0
"""Degrees by which a scan may tilt without a point counting as outside of the field of view."""

MOST_OUTSIDE = 0.04
MOST_GAPS = 0.15
MOST_UNUSED = 0.55
MOST_BETWEEN = 0.43
"""The largest shares that are accepted. Recorded scans reach 0.02, 0.04, 0.42 and 0.37 with their
own sensor; points at random elevations reach 0.44 to 0.60 in the last one, since the tilt is
fitted."""

_COMPARED = 20_000  # points; more change the shares by less than 0.01
_FEWEST = 1000  # points that are needed for a comparison
_PER_LASER = 15  # points of an average laser that are needed for shares of beams
_SECTORS = 36
_PER_SECTOR = 60
_BIN = 0.02  # degrees
_SHIFTS = np.arange(-30, 31, 2)  # bins: tilts of up to 0.6 degrees in one sector
_COARSE = 0.3  # degrees by which the rows of a linear grid may differ from the beams


class Agreement(NamedTuple):
    """Shares of points and beams that contradict a sensor, each in [0, 1].

    Args:
        above, below: points outside of the vertical field of view, by more than half a beam's
            spacing and the tilt.
        near, far: points outside of the range limits, by more than half a metre (far: and 2 %).
        gaps: beams without points, of those between the highest and the lowest beam with points.
        unused: beams without points, of all.
        between: points between the beams, farther than a quarter of their spacing from one, where
            the sensor's table is fine enough to tell. It is 0.5 for points at random elevations.
    """

    above: float = 0.0
    below: float = 0.0
    near: float = 0.0
    far: float = 0.0
    gaps: float = 0.0
    unused: float = 0.0
    between: float = 0.0

    @property
    def outside(self) -> float:
        """Share of points outside of the field of view or the range limits."""
        return self.above + self.below + self.near + self.far

    def faults(self, sensor: Sensor) -> list[str]:
        """What contradicts the sensor, one text for each share that is too large; [] if nothing
        does."""
        texts = []
        if self.outside > MOST_OUTSIDE:
            places = {
                f"above {sensor.up:.1f} degrees": self.above,
                f"below {sensor.down:.1f} degrees": self.below,
                f"nearer than {sensor.range_min:g} m": self.near,
                f"farther than {sensor.range_max:g} m": self.far,
            }
            texts.append(
                ", ".join(
                    f"{_percent(v)} of the points lie {k}"
                    for k, v in places.items()
                    if v >= 0.005
                )
            )
        rows = sensor.shape[0]
        if self.gaps > MOST_GAPS:
            texts.append(
                f"{_percent(self.gaps)} of the {rows} beams have no points though beams around "
                "them have"
            )
        elif self.unused > MOST_UNUSED:
            texts.append(f"{_percent(self.unused)} of the {rows} beams have no points")
        if self.between > MOST_BETWEEN:
            texts.append(
                f"{_percent(self.between)} of the points lie between the beams"
            )
        return texts


def agreement(points: NDArray[np.float32], sensor: Sensor) -> Agreement:
    """Compare points with a sensor; takes a few milliseconds.

    Args:
        points: (N, 3) metres, sensor frame. Points at the origin are firings without a return, and
            are not counted.
        sensor: the sensor that is assumed for them.

    Returns:
        The shares that contradict the sensor; 0 where there are too few points to tell.

    Example:
        >>> from lidar_synth import Town, load_sensor
        >>> from lidar_synth.geometry.agreement import agreement
        >>> points = Town(seed=0, sensor="os1_128", scans=1)[0].points
        >>> agreement(points, load_sensor("os1_128")).faults(load_sensor("os1_128"))
        []
        >>> agreement(points, load_sensor("hdl64e_kitti")).above > 0.2
        True
    """
    sample = points[:: max(1, len(points) // (2 * _COMPARED))].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    distance = np.sqrt(np.einsum("ij,ij->i", sample, sample))
    sample = sample[distance > 0.05]
    distance = distance[distance > 0.05]
    if len(sample) < _FEWEST:
        return Agreement()
    near = float((distance < sensor.range_min - 0.5).mean())
    far = float((distance > 1.02 * sensor.range_max + 0.5).mean())
    sample = sample[distance > NEAR]
    if len(sample) < _FEWEST:
        return Agreement(near=near, far=far)
    # Points may lie on the sensor's lasers, or on the rows of its grid if they come from a range
    # image.
    rows = np.degrees(sensor.row_elevations().astype(np.float64))
    tables = [(rows, np.zeros(len(rows)))]
    if sensor.beams is not None or sensor.heights is not None:
        lasers = np.degrees(sensor.laser_elevations.astype(np.float64))
        tables.append((lasers, np.asarray(sensor.heights or np.zeros(len(rows)))))
    exact = sensor.beams is not None or sensor.elevations is not None
    shares = [
        _compare(sample, table[::-1], heights[::-1], exact) for table, heights in tables
    ]
    above, below, gaps, unused, between = np.min(shares, axis=0).tolist()
    return Agreement(above, below, near, far, gaps, unused, between)


def _compare(
    points: Float64Array,
    beams: Float64Array,
    heights: Float64Array,
    exact: bool,
) -> tuple[float, float, float, float, float]:
    """``above``, ``below``, ``gaps``, ``unused`` and ``between`` for beams at these elevations,
    lowest first."""
    flat = np.hypot(points[:, 0], points[:, 1])
    elevation = np.degrees(np.arctan2(points[:, 2], flat))
    elevation = np.degrees(
        np.arctan2(points[:, 2] - np.interp(elevation, beams, heights), flat)
    )
    step = np.diff(beams)
    above = float((elevation > beams[-1] + step[-1] / 2 + TILT).mean())
    below = float((elevation < beams[0] - step[0] / 2 - TILT).mean())
    gaps = unused = 0.0
    if len(points) >= _PER_LASER * len(beams):
        count = np.bincount(
            np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation),
            minlength=len(beams),
        )
        used = np.flatnonzero(count > 0.03 * np.median(count[count > 0]))
        gaps = 1 - len(used) / (used[-1] - used[0] + 1)
        unused = 1 - len(used) / len(beams)
    seen = flat > FAR
    sector = (
        (np.arctan2(points[seen, 1], points[seen, 0]) / (2 * np.pi) + 0.5) * _SECTORS
    ).astype(int) % _SECTORS
    return above, below, gaps, unused, _between(elevation[seen], sector, beams, exact)


def _between(
    elevation: Float64Array,
    sector: NDArray[np.intp],
    beams: Float64Array,
    exact: bool,
) -> float:
    """Share of points between the beams, with the tilt of each sector that leaves the fewest
    there."""
    step = np.diff(beams)
    # on either side of a beam
    width = np.minimum(np.r_[step[0], step], np.r_[step, step[-1]]) / 4
    width = width if exact else np.maximum(width, _COARSE)
    low = beams[0] - 3 * TILT
    places = low + _BIN * (np.arange(round((beams[-1] + 3 * TILT - low) / _BIN)) + 0.5)
    nearest = np.searchsorted((beams[1:] + beams[:-1]) / 2, places)
    on_beam = (np.abs(places - beams[nearest]) <= width[nearest]).astype(np.float32)
    cell = ((elevation - low) / _BIN).astype(int)
    inside = (elevation > low) & (cell < len(places))
    counts = np.bincount(
        sector[inside] * len(places) + cell[inside], minlength=_SECTORS * len(places)
    )
    image = counts.reshape(_SECTORS, -1).astype(np.float32)
    total = image.sum(axis=1)
    enough = total >= _PER_SECTOR
    if not enough.any():
        return 0.0
    hits = image @ np.stack([np.roll(on_beam, shift) for shift in _SHIFTS], axis=1)
    return float(1 - hits[enough].max(axis=1).sum() / total[enough].sum())


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
