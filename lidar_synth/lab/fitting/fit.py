"""``fit_sensor``: from a few scans to a ``Sensor``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan, Sensor, Source, check_source, spread
from lidar_synth.geometry.arrays import Float64Array, Int64Array
from lidar_synth.geometry.lines import nearest_beams, residuals
from lidar_synth.lab.fitting.azimuths import Azimuths, fit_azimuths, turn_of
from lidar_synth.lab.fitting.beams import NEAREST, Beams, fit_beams, room_of
from lidar_synth.lab.fitting.doubts import doubts, name_vendor
from lidar_synth.lab.fitting.limits import range_limits, range_step, reflectance_levels
from lidar_synth.lab.fitting.lost_beams import add_lost_beams
from lidar_synth.lab.fitting.model import Cloud, Model
from lidar_synth.lab.fitting.points import follows_time

SCANS = 20
"""Largest number of scans that a fit uses, evenly spaced among those given."""

TURNS = 5
"""Number of scans in which firings are looked for."""

LEAST_POINTS = 500
"""A fit needs as many points."""

LEAST_QUALITY = 0.92
"""Share of points in the middle half between the borders of their beams; less is no fit, and 0.5
are any points."""

FRAME_HINT = (
    "Give the points in the frame of the sensor, or of a vehicle within 2 m and 6 degrees of it, "
    "with the time of each "
    "point where motion is compensated, and only those of one rotating sensor."
)

CLOSE = 0.05
"""Degrees; the share of points that lie as close to their beam is reported."""


@dataclass(frozen=True)
class SensorFit:
    """A fitted sensor, and what the fit is sure of.

    Args:
        sensor: the sensor; its elevations are those of the lasers, seen from their heights.
        points: (B,) number of points of each beam, without those nearer than 0.5 m, which are not
            fitted.
        spread: (B,) degrees, the median distance of a beam's points from it.
        within: (B,) share of a beam's points within 0.05 degrees.
        mount: (4, 4) the sensor's pose in the frame of the given points, metres; its heading is not
            fitted. ``(points - mount[:3, 3]) @ mount[:3, :3]`` are points (N, 3) in the sensor's
            own frame, for which ``sensor`` holds.
        motion: (S, 6) velocity and turn rate that motion compensation has added to each scan: m/s
            and rad/s where scans have ``time``, otherwise per turn; zero where it is not needed.
        source: where rings come from: "ring field", "order of the points" or "elevations".
        nearest: metres, of all points.
        farthest: metres, of all points.
        azimuths: firings and azimuth offsets, with what they rest on.
        rings: for each scan (N,) int16, the beam of each point; -1 for points at the origin:
            firings without a return.
        off: for each scan (N,) float32 degrees, how far each point lies above its beam.
        uncertain: one sentence for each part that the fit is not sure of.
        vendor: the sensor that a vendor sells with these beams, and how many of its channels are
            missing; "" if none.

    Example:
        >>> from lidar_synth import Town, fit_sensor
        >>> fit = fit_sensor(Town(seed=0, sensor="os1_128", scans=1, motion=False))
        >>> fit.source, fit.points.shape, fit.mount[:3, 3].round(2).tolist()
        ('ring field', (128,), [0.0, 0.0, 0.0])
        >>> fit.uncertain
        ()
    """

    sensor: Sensor
    points: Int64Array
    spread: Float64Array
    within: Float64Array
    mount: Float64Array
    motion: Float64Array
    source: str
    nearest: float
    farthest: float
    azimuths: Azimuths
    rings: tuple[NDArray[np.int16], ...] = field(repr=False)
    off: tuple[NDArray[np.float32], ...] = field(repr=False)
    uncertain: tuple[str, ...] = ()
    vendor: str = ""

    @property
    def share(self) -> float:
        """Share of all points within 0.05 degrees of their beam."""
        return float((self.within * self.points).sum() / self.points.sum())


def fit_sensor(
    scans: Source | Sequence[Scan], *, name: str = "fitted", columns: int | None = None
) -> SensorFit:
    """Fit a sensor to scans: elevation, height and azimuth offset of each beam, firings, range
    limits, quantisation.

    Rings are taken from ``scan.ring`` or from KITTI's order of points; otherwise beams are peaks of
    the elevations. The frame of the points may be the sensor's or one up to a few metres and
    degrees away, such as the vehicle's. What motion compensation has added is estimated from the
    points, with ``scan.time`` or, without, from the azimuth; undo it with ``reskew`` where there
    are poses.

    Args:
        scans: of one sensor, of different places where possible; at most 20 of them are used.
        name: of the fitted sensor.
        columns: of its range images; by default as many as firings if they are at fixed angles,
            otherwise the next lower power of two.

    Raises:
        ConfigError: on a path, which ``open_scans`` opens, or another that is no ``Source``.
        DataError: without points, with one beam only, or if the points do not lie on beams, such as
            with a frame that is too far from the sensor's.

    Example:
        >>> from lidar_synth import Town, fit_sensor
        >>> fit = fit_sensor(Town(seed=0, sensor="os1_128", scans=2, motion=False))
        >>> fit.sensor.shape, fit.sensor.elevations[:2], round(fit.share, 3)
        ((128, 1024), (22.3242, 21.9727), 1.0)
    """
    check_source(scans)
    given = [scans[i] for i in spread(range(len(scans)), SCANS)]
    returned = [np.asarray(scan.points.any(axis=1)) for scan in given]
    scans = [scan[there] for scan, there in zip(given, returned, strict=True)]
    count = sum(len(scan) for scan in scans)
    if count < LEAST_POINTS:
        raise DataError(
            f"{len(scans)} scans with {count} points",
            f"at least {LEAST_POINTS} points to fit a sensor to",
        )
    beams, cloud = fit_beams(scans)
    if beams is None:
        raise DataError(
            f"{count} points whose elevations show fewer than two beams",
            "two beams or more",
            FRAME_HINT,
        )
    found = _described(beams, cloud, scans, name, columns)
    return replace(
        found,
        rings=_fill_up(found.rings, returned, -1),
        off=_fill_up(found.off, returned, 0),
    )


def _fill_up(
    parts: Sequence[NDArray[Any]], returned: Sequence[NDArray[np.bool_]], other: int
) -> tuple[NDArray[Any], ...]:
    """Values of the points of each scan that are there as values of all points, with another one
    for the rest."""
    filled = []
    for values, there in zip(parts, returned, strict=True):
        filled.append(np.full(len(there), other, values.dtype))
        filled[-1][there] = values
    return tuple(filled)


def _described(
    beams: Beams,
    cloud: Cloud,
    scans: Sequence[Scan],
    name: str,
    columns: int | None,
) -> SensorFit:
    points = beams.model.aligned(cloud)
    lost = beams.model if cloud.kept else add_lost_beams(beams.model, points)
    model = _highest_first(lost)
    points = model.aligned(cloud)
    ring = nearest_beams(points, model.tangents, model.heights)
    off = residuals(points, ring, model.tangents, model.heights)
    usable = np.hypot(points[:, 0], points[:, 1]) > NEAREST
    used = ring[usable]
    _check(model, used, off[usable])
    rows = len(model.tangents)
    number = np.bincount(used, minlength=rows)
    degrees = np.abs(np.degrees(off))[usable]
    within = _by_ring(np.mean, degrees < CLOSE, used, number)
    azimuths = _azimuths(scans, cloud, points, ring, rows)
    nearest, farthest = range_limits(np.linalg.norm(points[usable], axis=1))
    step = None
    if not model.motion.any():
        x, y, z = points[usable].T
        distance = np.sqrt(x**2 + y**2 + (z - model.heights[used]) ** 2)
        step = range_step(distance, used, rows)
    elevations = np.degrees(np.arctan(model.tangents)).round(4)
    sensor = Sensor(
        name=name,
        columns=columns or _columns(azimuths),
        # Other scans can have nearer and farther points than these.
        range_min=min(nearest, 1.0),
        range_max=float(5 * np.ceil(farthest / 5)),
        elevations=tuple(elevations.tolist()),
        heights=tuple(model.heights.round(4).tolist()) if model.heights.any() else None,
        firings=azimuths.firings,
        azimuths=_offsets(azimuths),
        range_step=step,
        reflectance_levels=reflectance_levels(
            np.concatenate([scan.reflectance for scan in scans])
        ),
        description=f"fitted to {len(scans)} scans",
    )
    mount = np.eye(4)
    mount[:3, :3] = model.turn
    mount[:3, 3] = model.offset
    splits = np.cumsum([len(scan) for scan in scans])[:-1]
    near = 1 - float(usable.mean())
    return SensorFit(
        sensor,
        number,
        spread=_by_ring(np.median, degrees, used, number),
        within=within,
        mount=mount,
        motion=model.motion,
        source=beams.source,
        nearest=nearest,
        farthest=farthest,
        azimuths=azimuths,
        rings=tuple(np.split(ring.astype(np.int16), splits)),
        off=tuple(np.split(np.degrees(off).astype(np.float32), splits)),
        uncertain=tuple(doubts(elevations, number, within, near, azimuths)),
        vendor=name_vendor(elevations, number),
    )


def _by_ring(
    measure: Callable[[NDArray[Any]], Any],
    values: NDArray[Any],
    ring: Int64Array,
    number: Int64Array,
) -> Float64Array:
    """(R,) a measure of the values of each ring, which has ``number`` of them; 0 without any."""
    parts = np.split(values[np.argsort(ring, kind="stable")], np.cumsum(number)[:-1])
    return np.array([measure(part) if len(part) else 0.0 for part in parts])


def _highest_first(model: Model) -> Model:
    """The model with its beams in order, and with heights about the origin of a frame that is close
    to the sensor's."""
    order = np.argsort(-model.tangents)
    tangents = model.tangents[order]
    heights = model.heights[order]
    offset = model.offset
    if heights.any():
        # A common height and a vertical offset are the same; a small one belongs to the lasers.
        inside = np.abs(offset).max() < 0.5 and model.turn[2, 2] > np.cos(
            np.radians(0.5)
        )
        common = (
            -float(offset @ model.turn[:, 2]) if inside else float(np.median(heights))
        )
        heights = heights - common
        offset = offset + model.turn[:, 2] * common
    return Model(tangents, heights, offset, model.turn, model.motion)


def _check(model: Model, ring: Int64Array, off: Float64Array) -> None:
    """Refuse beams that are none.

    Raises:
        DataError: if the points do not concentrate on the beams.
    """
    room = room_of(model.tangents)
    quality = float((np.abs(off) < room[ring] / 4).mean()) if len(off) else 0.0
    if (
        quality < LEAST_QUALITY
        or room.min() < np.radians(0.005)
        or np.abs(model.heights).max() >= 1
    ):
        raise DataError(
            f"no beams found: {quality:.0%} of the points lie near the middle of {len(room)} bands "
            "of elevation (anywhere: 50%)",
            f"at least {LEAST_QUALITY:.0%}",
            FRAME_HINT,
        )


def _azimuths(
    scans: Sequence[Scan],
    cloud: Cloud,
    points: Float64Array,
    ring: Int64Array,
    rows: int,
) -> Azimuths:
    turns = []
    for number in range(min(TURNS, len(scans))):
        use = np.flatnonzero(
            (cloud.scan == number) & (np.hypot(points[:, 0], points[:, 1]) > NEAREST)
        )
        time: Float64Array | None = None
        if scans[number].time is not None:
            time = cloud.time[use]
        elif follows_time(scans[number].points):
            time = np.arange(len(use), dtype=np.float64)
        turns.append(turn_of(points[use], ring[use], time))
    return fit_azimuths(turns, rows)


def _columns(azimuths: Azimuths) -> int:
    if azimuths.firings is None:
        return 1024
    if azimuths.firings == azimuths.lattice and azimuths.firings % 2 == 0:
        return azimuths.firings
    return max(2, 1 << int(np.log2(azimuths.firings)))


def _offsets(azimuths: Azimuths) -> tuple[float, ...] | None:
    """Offsets in degrees, NaN where they are not known; None if nothing is known or all are 0."""
    if azimuths.offsets is None or np.abs(azimuths.offsets).max() < 0.005:
        return None
    return tuple(azimuths.offsets.round(3).tolist())
