"""``Transfer``: what another sensor on another mount would have recorded of the same scene."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import hash_of_names
from lidar_synth.geometry.projection.kernels import grid_of
from lidar_synth.geometry.scan import Boxes, Scan, Source, identity_of
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.geometry.transfer.casting import Hits, first_hits
from lidar_synth.geometry.transfer.mount import Mount
from lidar_synth.geometry.transfer.rays import Rays, rays_of
from lidar_synth.geometry.transfer.returns import (
    Measurement,
    gather_hits,
    place_returns,
)
from lidar_synth.geometry.transfer.surfaces import ScanSurfaces, as_fired, estimate
from lidar_synth.geometry.transfer.sweeps import moved
from lidar_synth.noise import keyed_rng

log = logging.getLogger(__name__)

_SURFACE = 0.1  # metres that returns stick out of their box
_FLOOR = 0.1  # metres above a box's bottom, below which a return is the road's
SECTORS = 360
"""Sectors of azimuth, in which a scan has returns where its sensor looked."""


class Transferred(NamedTuple):
    """A scan of the target sensor.

    Args:
        scan: its returns, row by row.
        seen: share of the target's rays, in [0, 1], that lie within the field of view of the
            recording sensor; the others have no return.
    """

    scan: Scan
    seen: float


@dataclass(frozen=True)
class Transfer:
    """Turns scans of one sensor into scans of another.

    Surfaces are estimated from the returns: neighbours are joined unless the step between them or
    their labels say that they belong to different surfaces. The target's rays are cast at these
    surfaces from the target's mount. A return with no neighbour of its surface stands for the patch
    between it and the neighbouring rays, so that leaves and poles keep their share of returns.
    Where the recording sensor saw nothing, there is no return.

    Label, raw label, instance, confidence and time are those of the nearest return; reflectance is
    interpolated; the ring is the target's laser. Boxes, pose and the rest move to the target's
    frame; boxes in which the target has no return are left out.

    A scan of a sensor with the target's lasers, which fired about as often from the same place,
    keeps its returns: rays cast at its own surfaces add nothing (docs/research/transfer.md). In a
    range image, a sensor has fired once per column.

    Args:
        target: the sensor to imitate: its lasers, firings, limits and quantisation.
        mount: the target's place relative to the recording sensor.
        measurement: how the target measures other than the recording sensor.
        vehicle: (length, width) in metres of the footprint around the recording sensor, below it,
            whose returns are of the vehicle that carries it. If the target has another mount they
            are left out; otherwise they would stand in its way.
        recast: whether rays are cast for scans of the target's lasers too.

    Example:
        >>> from lidar_synth import Town, load_sensor
        >>> from lidar_synth.geometry.transfer import Mount, Transfer
        >>> transfer = Transfer(load_sensor("hdl32e_nuscenes"), Mount(z=0.1))
        >>> scan, seen = transfer.cast(Town(seed=0, scans=1)[0])
        >>> scan.sensor.name, int(scan.ring.max()) < 32, 0.5 < seen < 0.8
        ('hdl32e_nuscenes', True, True)
    """

    target: Sensor
    mount: Mount = field(default_factory=Mount)
    measurement: Measurement = field(default_factory=Measurement)
    vehicle: tuple[float, float] = (4.0, 2.0)
    recast: bool = False

    def __call__(self, scan: Scan, rng: np.random.Generator | None = None) -> Scan:
        """The scan as the target sensor would have recorded it; see ``cast``."""
        kept = self._kept(scan)
        if kept is not None:
            return kept
        return self._seen_by_target(scan, rng or keyed_rng(0), ())[0]

    def cast(
        self,
        scan: Scan,
        rng: np.random.Generator | None = None,
        sweeps: Sequence[Scan] = (),
    ) -> Transferred:
        """The scan as the target sensor would have recorded it, and the share of its field of view
        that was seen.

        Args:
            scan: N returns; with ``ring``, or in the order of a file of KITTI, or on the beams of
                its sensor.
            rng: samples losses and noise; by default the same for every scan.
            sweeps: other sweeps of the same drive, with poses. Their surfaces fill rays that hit
                nothing in the scan; moving objects follow their boxes (sweeps.py). The result has
                no times.

        Raises:
            DataError: on a scan without a return, with one beam only, with points on no rings or
                that are not finite; if nothing of it is in the target's field of view; on sweeps
                without poses.
        """
        kept = None if sweeps else self._kept(scan)
        if kept is not None:
            looked = _looked(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
            return Transferred(kept, float(looked.mean()))
        result, surfaces = self._seen_by_target(scan, rng or keyed_rng(0), sweeps)
        return Transferred(result, _seen(surfaces, self.target, self.mount))

    def _kept(self, scan: Scan) -> Scan | None:
        """The scan's returns within the limits of the target, if its sensor has fired the same
        lasers about as often from the same place and measures alike; None if not, or if no return
        is left or a point is not finite."""
        measured = replace(self.measurement, response=None)
        if (
            self.recast
            or self.mount != Mount()
            or measured != Measurement()
            or self.target.range_step not in (None, scan.sensor.range_step)
            or not self.target.same_lasers(scan.sensor)
        ):
            return None
        distance = np.linalg.norm(scan.points, axis=1)
        grid = grid_of(self.target)
        inside = (distance >= grid.range_min) & (distance <= grid.range_max)
        if not inside.any() or not np.isfinite(distance).all():
            return None
        sensors = (as_fired(scan), self.target)
        fired = sorted(s.firings or s.columns for s in sensors)
        if fired[0] < 0.9 * fired[1]:
            return None
        kept = scan[inside]
        return replace(
            kept,
            sensor=self.target,
            reflectance=self.measurement.reflectances(kept.reflectance, self.target),
            boxes=_with_returns(kept.boxes, kept.points),
        )

    def _seen_by_target(
        self, scan: Scan, rng: np.random.Generator, sweeps: Sequence[Scan]
    ) -> tuple[Scan, ScanSurfaces]:
        """The scan as the target sensor would have recorded it, and the surfaces of the given
        one."""
        rays = rays_of(self.target)
        surfaces = estimate(self._without_vehicle(scan))
        _warn_of_differences(
            scan.sensor,
            self.target,
            self.mount.pitch,
            self.measurement.response is None,
        )
        upright = self.mount.matrix[2, :3]
        hits = first_hits(
            surfaces, self.mount.points(surfaces.scan.points), rays, upright
        )
        further: Hits | None = None
        for sweep in sweeps:
            other = estimate(self._without_vehicle(sweep))
            found = first_hits(
                other, self.mount.points(moved(other.scan, scan)), rays, upright
            )
            if further is None:
                further = found
            else:
                further.add(found, found.nearest.rho < further.nearest.rho)
        if further is not None:
            hits.fields.pop("time", None)  # sweeps count from moments of their own
            hits.add(
                further, np.isinf(hits.nearest.rho) & np.isfinite(further.nearest.rho)
            )
        returns = self._returns(hits, rays, rng)
        if not len(returns):
            seen = _seen(surfaces, self.target, self.mount)
            raise DataError(
                f"scan {scan.id!r} of {scan.sensor.name!r}: none of its surfaces lies within the "
                f"field of view and the range of {self.target.name!r} ({self.target.down:.1f} to "
                f"{self.target.up:.1f} degrees; {100 * seen:.0f} % of it was seen)",
                "sensors whose fields of view overlap",
                "Check the two sensors and the mount.",
            )
        boxes = None if scan.boxes is None else self.mount.boxes(scan.boxes)
        pose = None if scan.pose is None else scan.pose @ self.mount.matrix
        unchanged = {
            name: getattr(scan, name)
            for name in ("image_path", "id", "domain", "provenance")
        }
        boxes = _with_returns(boxes, returns.points)
        return replace(returns, boxes=boxes, pose=pose, **unchanged), surfaces

    def _without_vehicle(self, scan: Scan) -> Scan:
        """The scan without returns of the vehicle that carries its sensor, where the target has
        another mount."""
        if self.mount == Mount():
            return scan
        along = np.abs(scan.points[:, 0])
        across = np.abs(scan.points[:, 1])
        above = scan.points[:, 2]
        # The limit below keeps the road around a low sensor; a vehicle's returns are above it.
        of_vehicle = (
            (along < self.vehicle[0] / 2)
            & (across < self.vehicle[1] / 2)
            & (above < 0)
            & (above > -1.5)
        )
        return scan if not of_vehicle.any() else scan[~of_vehicle]

    def _returns(self, hits: Hits, rays: Rays, rng: np.random.Generator) -> Scan:
        """The returns of the rays that hit something, row by row."""
        nearest = hits.nearest
        at = np.empty(nearest.rho.size, np.int32)
        distance = np.empty(nearest.rho.size)
        count = gather_hits(nearest.rho, rays.slope, at, distance)
        at = at[:count]
        distance = distance[:count]
        kept = self.measurement.returned(
            distance, nearest.value, nearest.facing, at, rng
        )
        if not kept.all():
            at = at[kept]
            distance = distance[kept]
        distance = self.measurement.ranges(distance, self.target, rng)
        points = np.empty((len(at), 3), np.float32)
        limits = np.float32(self.target.range_min), np.float32(self.target.range_max)
        count = place_returns(at, distance, rays, *limits, points)
        at = at[:count]
        reflectance = self.measurement.reflectances(nearest.value.take(at), self.target)
        ring = (at // rays.firings).astype(np.int16)
        return Scan(
            points[:count], reflectance, self.target, ring=ring, **hits.carried(at)
        )

    @property
    def identity(self) -> str:
        """A text of everything that determines the scans."""
        return (
            f"{self.target.to_dict()} {asdict(self.mount)} {asdict(self.measurement)} "
            f"{self.vehicle}{' recast' if self.recast else ''}"
        )


class SeenAs:
    """The scans of a source, each as another sensor would have recorded it.

    Args:
        source: the scans.
        transfer: from their sensor to the other one.
        seed: of losses and noise; those of a scan depend on the seed and its index.

    Example:
        >>> from lidar_synth import load_sensor, open_scans
        >>> from lidar_synth.geometry.transfer import SeenAs, Transfer
        >>> scans = SeenAs(open_scans("demo_out/town"), Transfer(load_sensor("os1_128")))
        >>> scans[0].sensor.name
        'os1_128'
    """

    def __init__(self, source: Source, transfer: Transfer, seed: int = 0) -> None:
        self.source = source
        self.transfer = transfer
        self.seed = seed
        self.sensor = transfer.target

    @property
    def identity(self) -> str:
        """A text that distinguishes it from other sources, by source, names of scans, transfer and
        seed."""
        source = getattr(self.source, "identity", "") or type(self.source).__name__
        names = map(str, getattr(self.source, "ids", [identity_of(self.source)]))
        digest = hash_of_names([source, *names, self.transfer.identity, str(self.seed)])
        return f"{type(self).__name__}:{len(self)}:{digest[:16]}"

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Scan:
        return self.transfer(
            self.source[index], keyed_rng(self.seed, index % len(self))
        )


def _with_returns(boxes: Boxes | None, points: NDArray[np.float32]) -> Boxes | None:
    """The boxes that hold a return."""
    if boxes is None:
        return None
    held = boxes.enlarged(_SURFACE).contain(points, above_floor=_FLOOR + _SURFACE)
    return boxes[held.any(axis=1)]


@lru_cache(maxsize=256)
def _warn_of_differences(
    source: Sensor, target: Sensor, pitch: float, unmatched: bool
) -> None:
    """Log once what scans of the target will lack: returns of lasers outside the recorded field of
    view, and the target's reflectance."""
    if source.name == target.name or target.same_lasers(source):
        return
    elevation = np.degrees(target.optics()[0]) - pitch
    seen = np.degrees(source.optics()[0])
    blind = int(((elevation < seen.min() - 0.5) | (elevation > seen.max() + 0.5)).sum())
    lacks = []
    if blind:
        lacks.append(
            f"{blind} of its {len(elevation)} lasers look outside the recorded {seen.min():.1f} to "
            f"{seen.max():.1f} degrees and return nothing"
        )
    if unmatched:
        lacks.append(
            "reflectance is the recording sensor's (like=FOLDER or --like matches it to real scans)"
        )
    if lacks:
        log.warning("scans of %r as %r: %s", source.name, target.name, "; ".join(lacks))


def _seen(surfaces: ScanSurfaces, target: Sensor, mount: Mount) -> float:
    """The share of the target's rays that lie in the field of view of the sensor that recorded the
    surfaces."""
    elevation, sector = _views(target, mount)
    looked = _looked(-surfaces.azimuth.astype(np.float32))
    inside = (elevation >= surfaces.bounds[0]) & (elevation <= surfaces.bounds[1])
    return float((inside & looked.take(sector)).mean())


@lru_cache(maxsize=16)
def _views(
    target: Sensor, mount: Mount
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(H, F) elevation, radians, and sector of each ray in the frame of the recording sensor."""
    rays = rays_of(target)
    slope = np.broadcast_to(rays.slope[:, None, None], (*rays.directions.shape[:2], 1))
    x, y, z = np.moveaxis(
        np.concatenate([rays.directions, slope], -1) @ mount.matrix[:3, :3].T, -1, 0
    )
    return np.arctan2(z, np.hypot(x, y)), _sector(np.arctan2(y, x))


def _looked(angle: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(SECTORS,) whether a scan has returns in a sector, from their angles."""
    return np.bincount(_sector(angle), minlength=SECTORS) > 0


def _sector(angle: NDArray[np.floating]) -> NDArray[np.int64]:
    """The sector of an angle in [-pi, pi], radians."""
    return np.asarray(np.floor(angle / (2 * np.pi) * SECTORS), np.int64) % SECTORS
