"""An object set into a scan at a new place, as the sensor would have seen it there.

The object's recorded surface is placed anew, and every ray of the scan is cast at it. A ray that
hits it before its own return gets the object's; one whose return is nearer keeps it. So the object
hides what is behind it and is hidden by what is in front of it, on the rays of this very scan.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, TRAIN_ID
from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, Scan, wrap_angle
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.geometry.overlap import find_overlapping
from lidar_synth.geometry.transfer.casting import Hits, first_hits
from lidar_synth.geometry.transfer.rays import rays_from
from lidar_synth.geometry.transfer.surfaces import (
    ScanSurfaces,
    as_fired,
    estimate,
    rings_of,
)
from lidar_synth.labels.boxes import grow_box, join_boxes, turn_points
from lidar_synth.labels.edit.compose import next_instance, replace_returns
from lidar_synth.labels.edit.rays import ScanRays, rays_of_scan
from lidar_synth.labels.edit.removal import remove, select_boxes
from lidar_synth.labels.ground import FLOOR, ground_under
from lidar_synth.labels.objects import Object, objects_of
from lidar_synth.labels.pasting import still_visible, update_occlusion

if TYPE_CHECKING:
    from lidar_synth.generate.generator import Generator

TURN = 30.0
"""Largest angle, degrees, by which an object may be seen from another side than it was recorded
from."""

NEARER = 0.5
"""Smallest new distance of an object as a share of the recorded one; nearer, it would need returns
that it lacks."""

BESIDE = 0.05
"""Metres outside its box at which an object may still be hit: patches at its rim reach beyond the
returns."""

STRAYS = 2
"""Maximum number of other returns above the ground in the place of an object."""

GRAZE = 0.05
"""Metres by which the object has to be in front of a return to replace it."""

Pose = Sequence[float]
"""x and y in metres and, optionally, yaw in radians, counter-clockwise about +z from +x, in the
sensor frame."""


class Placed(NamedTuple):
    """The place of an object.

    Args:
        old: (7,) its recorded box.
        box: (7,) its new box.
        mirrored: whether its mirror image about its long axis is used.
    """

    old: Float64Array
    box: NDArray[np.float32]
    mirrored: bool

    def points(self, points: NDArray[np.float32]) -> Float64Array:
        """(N, 3) recorded points at the new place, metres."""
        local = turn_points(points - self.old[:3], -self.old[6])
        if self.mirrored:
            local[:, 1] *= -1
        box = self.box.astype(np.float64)
        return turn_points(local, box[6]) + box[:3]


def insert(
    scan: Scan, item: Object, pose: Pose | None = None, *, least: int = 5
) -> Scan:
    """Set an object into a scan.

    Args:
        scan: N points; the ground is found by its labels, or by the lowest returns if it has none.
        item: an object of ``objects_of`` or of an ``ObjectBank``. A mirror image of it is used if
            that shows the side that is seen.
        pose: x and y of its box's centre, and its yaw; by default the recorded place. Without a
            yaw, the sensor sees the object from the side from which it was recorded. Its height
            follows from the ground.
        least: minimum number of visible returns of an object, also of the scan's own: one that is
            hidden further loses its box and its returns.

    Returns:
        A new scan with the object's box (a scan without boxes then has this one alone) and, if it
        has instances, a new instance. Its labels are those of the object, if the scan has labels.
        It has no camera image.

    Raises:
        DataError: if the place is outside the sensor's range, taken, or without ground; if the
            object would be seen from a side that was not recorded, from too near, or not at all.

    Example:
        >>> from lidar_synth import Town
        >>> from lidar_synth.labels import edit, objects_of
        >>> town = Town(seed=8, scans=1)[0]
        >>> found = objects_of(town, 200).items()
        >>> number, car = next((i, o) for i, o in found if o.scan.boxes.names == ("Car",))
        >>> emptied = edit.remove(town, number)
        >>> back = edit.insert(emptied, car)  # at its old place
        >>> len(back.boxes) - len(emptied.boxes), back.boxes.names[-1]
        (1, 'Car')
    """
    return _set(scan, item, _place(scan, item, pose), least, np.zeros(len(scan), bool))


def _set(
    scan: Scan,
    item: Object,
    placed: Placed,
    least: int,
    estimated: NDArray[np.bool_],
    instance: int = -1,
) -> Scan:
    """Set an object into a scan at its place.

    Args:
        scan, item, least: see ``insert``.
        placed: the place.
        estimated: (N,) True for estimated returns, which the object replaces at any distance.
        instance: of the object; 0 or less takes a new one if the scan has instances.
    """
    rays = rays_of_scan(scan)
    window = np.flatnonzero(rays.through(placed.box, margin=0.3))
    rho, hits, at = _hits(item, placed, rays, window)
    replaceable = rays.hitting(estimated)[window]
    seen = np.isfinite(rho) & (replaceable | (rho < rays.rho[window] - GRAZE))
    if seen.sum() < least:
        raise DataError(
            f"an object at {_place_text(placed.box)} with {seen.sum()} visible returns of "
            f"{np.isfinite(rho).sum()}",
            f"at least {least}",
            "Choose a nearer place, or one that nothing hides.",
        )
    replaced = (
        estimated
        & Boxes(placed.box, ("Misc",)).contain(scan.points, above_floor=FLOOR)[0]
    )
    hidden = seen | _behind(rays, window, rho)
    points = rays.point[window[hidden]]
    replaced[points[points >= 0]] = True
    remaining, boxes = still_visible(scan, ~replaced, least)
    which = window[seen]
    if instance <= 0 and scan.instance is not None:
        instance = next_instance(scan)
    new = replace(
        scan[np.zeros(len(which), np.intp)],
        points=rays.points(which, rho[seen]),
        **_fields(scan, instance, hits, at[seen]),
    )
    assert item.scan.boxes is not None
    values = grow_box(placed.box, new.points)[None]
    box = Boxes(
        values,
        item.scan.boxes.names,
        occlusion=item.scan.boxes.occlusion.copy(),
        instance=np.array([instance], np.int32),
    )
    box = update_occlusion(box, np.array([seen.sum() / np.isfinite(rho).sum()]))
    result = replace_returns(scan, ~remaining, rays, which, new)
    return replace(result, boxes=join_boxes([boxes, box]))


def move(
    scan: Scan,
    box: int,
    pose: Pose,
    *,
    model: "Generator | str | Path | None" = None,
    seed: int = 0,
    least: int = 5,
) -> Scan:
    """Move an object of a scan: ``remove`` it and ``insert`` it at another place.

    Args:
        scan: N points with boxes.
        box: the number of the object's box.
        pose, least: see ``insert``. Returns that are only estimated behind the object do not block
            its new place.
        model, seed: see ``remove``.

    Returns:
        A new scan; the moved box is the last one, with its instance.

    Raises:
        DataError, ConfigError: as ``remove`` and ``insert``.

    Example:
        >>> from lidar_synth import Town
        >>> from lidar_synth.labels import edit, objects_of
        >>> town = Town(seed=8, scans=1)[0]
        >>> found = objects_of(town, 200).items()
        >>> number, car = next((i, o) for i, o in found if o.scan.boxes.names == ("Car",))
        >>> moved = edit.move(town, number, car.box[:2] * 1.02)  # a little further away
        >>> moved.boxes.names[-1], len(moved.boxes) == len(town.boxes)
        ('Car', True)
    """
    cut = cut_out(scan, box)
    emptied = remove(scan, box, model=model, seed=seed)
    recorded = _shared(emptied, scan)
    ground = recorded if emptied.label is None else recorded | GROUND[emptied.label]
    placed = _place(
        emptied[recorded], cut, pose, _with_foot(emptied[ground], cut), gone=box
    )
    assert cut.scan.boxes is not None
    instance = int(cut.scan.boxes.instance[0])
    return _set(emptied, cut, placed, least, ~recorded, instance)


def _with_foot(scan: Scan, item: Object) -> Scan:
    """The points and labels of a scan, and ground where an object of it stood, which it hid."""
    along, across = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.5, 0.5, 3))
    _, _, _, length, width, _, yaw = item.box.astype(np.float64)
    local = np.stack([along.ravel() * length, across.ravel() * width], 1)
    foot = np.full((len(local), 3), item.ground)
    foot[:, :2] = turn_points(local, yaw) + item.box[:2]
    points = np.concatenate([scan.points, foot.astype(np.float32)])
    road = np.full(len(foot), TRAIN_ID["road"], np.uint8)
    label = None if scan.label is None else np.concatenate([scan.label, road])
    return Scan(points, np.zeros(len(points), np.float32), scan.sensor, label=label)


def cut_out(scan: Scan, box: int) -> Object:
    """The object in a box of a scan, with the rings of its returns.

    Raises:
        DataError: if there is no such box, or no return in it.
    """
    select_boxes(scan, box)
    ring = rings_of(scan)[0]
    scan = replace(scan, ring=ring.astype(np.int16), sensor=as_fired(scan, ring))
    objects = objects_of(scan, least=1)
    if box not in objects:
        raise DataError(
            f"box {box} of scan {scan.id!r} without a return", "a box with an object"
        )
    return objects[box]


def _place(
    scan: Scan,
    item: Object,
    pose: Pose | None,
    ground_of: Scan | None = None,
    gone: int | None = None,
) -> Placed:
    """The object at its pose on the ground.

    Args:
        scan: the scan, without the object.
        item, pose: see ``insert``.
        ground_of: the scan in which the ground is found; by default ``scan``.
        gone: number of a box that was removed from the scan, so that errors number later boxes as
            before.
    """
    old = item.box.astype(np.float64)
    x, y, yaw = _complete(old, pose)
    distance = float(np.hypot(x, y))
    recorded = float(np.hypot(old[0], old[1]))
    box = np.array([x, y, 0, *old[3:6], yaw], np.float32)
    limits = max(scan.sensor.range_min, 1.0), scan.sensor.range_max
    if not limits[0] < distance < limits[1]:
        raise DataError(
            f"an object at {_place_text(box)}, {distance:.1f} m away",
            f"a place {limits[0]:g} to {limits[1]:g} m from the sensor {scan.sensor.name!r}",
        )
    if distance < NEARER * recorded:
        raise DataError(
            f"an object recorded at {recorded:.1f} m, to be seen at {distance:.1f} m",
            f"at least {NEARER * recorded:.1f} m, because it has too few returns for less",
        )
    if (
        scan.boxes is not None
        and (taken := find_overlapping(box, scan.boxes.values)).any()
    ):
        number = int(np.flatnonzero(taken)[0])
        name = scan.boxes.names[number]
        number += gone is not None and number >= gone
        raise DataError(
            f"an object at {_place_text(box)}, which overlaps box {number} ({name})",
            "a free place",
            "Remove that object first, or choose another place.",
        )
    if _recorded_here(scan, item, box):
        box[2] = old[2]
        return Placed(old, box, False)
    ground = ground_under(ground_of or scan, box)
    if ground is None or not ground.encloses:
        raise DataError(
            f"an object at {_place_text(box)}, where the scan has no level ground",
            "ground around the box",
        )
    count = ground.find_standing(scan.points, box)
    if count > STRAYS:
        raise DataError(
            f"an object at {_place_text(box)}, where the scan has {count} other returns",
            "a free place",
        )
    box[2] = ground.height + old[2] - item.ground
    return Placed(old, box, _mirrored(old, x, y, yaw))


def _recorded_here(scan: Scan, item: Object, box: NDArray[np.float32]) -> bool:
    """Whether an object returns to its own place in its own scan, from which its returns were
    removed."""
    same = item.scan.id == scan.id and bool(
        np.allclose(box[[0, 1, 6]], item.box[[0, 1, 6]], atol=1e-3)
    )
    return same and not _shared(item.scan, scan).any()


def _shared(scan: Scan, other: Scan) -> NDArray[np.bool_]:
    """(N,) which points of a scan the other one has, too."""
    # 12 bytes as one value: x, y and z are compared together.
    ours, theirs = (
        np.ascontiguousarray(s.points).view("V12").ravel() for s in (scan, other)
    )
    return np.isin(ours, theirs)


def _complete(old: Float64Array, pose: Pose | None) -> tuple[float, float, float]:
    """x, y and yaw of a pose."""
    values = [float(v) for v in (old[[0, 1, 6]] if pose is None else pose)]
    if len(values) not in (2, 3) or not np.isfinite(values).all():
        raise DataError(f"pose {pose}", "x, y in metres, or x, y and yaw in radians")
    if len(values) == 2:
        values.append(
            float(
                old[6] + np.arctan2(values[1], values[0]) - np.arctan2(old[1], old[0])
            )
        )
    return values[0], values[1], values[2]


def _mirrored(old: Float64Array, x: float, y: float, yaw: float) -> bool:
    """Whether the mirror image of an object shows the side that is seen at its new place.

    Raises:
        DataError: if neither the object nor its mirror image does.
    """
    recorded = np.arctan2(-old[1], -old[0]) - old[6]
    seen = np.arctan2(-y, -x) - yaw
    off = [abs(wrap_angle(seen - side)) for side in (recorded, -recorded)]
    if min(off) > np.radians(TURN):
        raise DataError(
            f"an object seen from {np.degrees(off[0]):.0f} degrees beside the side that was "
            "recorded",
            f"at most {TURN:g} degrees, for it or its mirror image",
            "Leave out the yaw: the recorded side then faces the sensor.",
        )
    return bool(off[1] < off[0])


def _hits(
    item: Object, placed: Placed, rays: ScanRays, window: NDArray[np.intp]
) -> tuple[Float64Array, Hits, NDArray[np.intp]]:
    """(n,) the horizontal distance at which each ray of the window hits the object, inf = never;
    all hits, and the index (n, 2) of each ray's."""
    rho = np.full(len(window), np.inf)
    at = np.zeros((len(window), 2), np.intp)
    surfaces = _surfaces(item.scan)
    rings, first, which = np.unique(
        rays.ring[window], return_index=True, return_inverse=True
    )
    slope = np.array(
        [np.median(rays.slope[window[which == k]]) for k in range(len(rings))]
    )
    count = round(2 * np.pi / rays.step)
    raster = rays_from(
        slope, rays.height[window[first]], rays.azimuth[window[first]], count
    )
    hits = first_hits(
        surfaces, placed.points(surfaces.scan.points), raster, np.array([0.0, 0.0, 1.0])
    )
    if len(window):
        turn = rays.azimuth[window] - raster.first[which]
        firing = np.rint(turn / rays.step).astype(np.intp) % count
        at = np.stack([which, firing], 1)
        rho = hits.nearest.rho[which, firing]
        points = rays.points(window, np.where(np.isfinite(rho), rho, 0.0))
        rho[~Boxes(placed.box, ("Misc",)).enlarged(BESIDE).contain(points)[0]] = np.inf
    return rho, hits, at


def _surfaces(part: Scan) -> ScanSurfaces:
    """The surfaces of an object's returns."""
    return estimate(
        Scan(
            part.points,
            part.reflectance,
            part.sensor,
            label=part.label,
            raw_label=part.raw_label,
            ring=rings_of(part)[0].astype(np.int16),
            id=part.id,
        )
    )


def _behind(
    rays: ScanRays, window: NDArray[np.intp], rho: Float64Array
) -> NDArray[np.bool_]:
    """(n,) rays of the window between two that hit the object in their ring, whose return lies
    behind it."""
    behind = np.zeros(len(window), bool)
    for ring in np.unique(rays.ring[window]):
        mine = np.flatnonzero(rays.ring[window] == ring)
        hit = np.flatnonzero(np.isfinite(rho[mine]))
        if len(hit):
            gaps = np.diff(hit, append=hit[0] + len(mine))
            start = hit[np.argmax(gaps) + 1 - len(hit)]  # after the widest gap
            length = len(mine) - gaps.max() + 1
            inner = mine[(start + np.arange(length)) % len(mine)]
            behind[inner] = rays.rho[window[inner]] > np.min(rho[mine][hit])
    return behind


def _fields(
    scan: Scan, instance: int, hits: Hits, at: NDArray[np.intp]
) -> dict[str, Any]:
    """The fields of the object's points that the scan has."""
    row, firing = at.T
    vertex = hits.nearest.vertex
    fields = {
        "raw_label": np.zeros(len(at), np.uint32),
        "cause": np.zeros(len(at), np.uint8),
        "reflectance": hits.nearest.value[row, firing].astype(np.float32),
        "instance": np.full(len(at), instance, np.int32),
        "confidence": np.ones(len(at), np.float32),
        **hits.carried(row * vertex.shape[1] + firing),
    }
    return {name: fields[name] for name in fields.keys() & scan.fields().keys()}


def _place_text(box: NDArray[np.float32]) -> str:
    return f"({box[0]:.1f}, {box[1]:.1f})"
