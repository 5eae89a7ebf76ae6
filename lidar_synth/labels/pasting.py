"""Objects pasted into a scan at their recorded range, with occlusion as the sensor would see it.

An object is raised or lowered to the ground at its place, and skipped if there is no ground or the
place is occupied. In each cell of the range image the nearest return then wins: objects are hidden
by what is in front of them, and hide everything behind their outline, including the gaps between
their returns. A box therefore contains only the returns of its object and, at its floor, of the
ground, and there are no returns in its shadow.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, Scan, Sensor
from lidar_synth.geometry.overlap import find_overlapping
from lidar_synth.labels.boxes import forget_images, widen_boxes
from lidar_synth.labels.ground import CLEARANCE, ground_under, standing
from lidar_synth.labels.merge import merge_scans
from lidar_synth.labels.objects import Object
from lidar_synth.labels.view import Composition, VisibleReturns, refuse_coarser

LIFT = 1.0
"""Maximum height by which an object is raised or lowered, metres; beyond it the sensor would see
another side."""
OCCLUSION = ((0.80, 0), (0.45, 1), (0.0, 2))
"""(minimum visible share, KITTI's occlusion level): 0 fully visible, 1 partly occluded, 2 largely
occluded."""


def paste(
    scan: Scan, objects: Iterable[Object], *, count: int | None = None, least: int = 5
) -> Scan:
    """Paste objects into a scan.

    Args:
        scan: N points; the ground is found by its labels, or by the lowest returns if it has none.
        objects: candidates, in the order in which they are tried; those without a suitable place
            are skipped. Their returns are thinned to one per cell of the scan's sensor.
        count: maximum number of objects to place; by default all that fit.
        least: minimum number of visible returns of an object. It also applies to the scan's own
            objects: a box that falls below it by occlusion is removed, with its returns.

    Returns:
        A new scan, which always has boxes. The pasted points are appended, with their label,
        confidence 1 and a new instance; their boxes are appended from near to far. The occlusion of
        a pasted object is that of its recording or, if greater, that in this scan. If the former is
        unknown, the result is a lower bound.

    Raises:
        DataError: on objects recorded by a coarser sensor.
    """
    return paste_groups(scan, [(objects, count)], least)


def paste_groups(
    scan: Scan, groups: Iterable[tuple[Iterable[Object], int | None]], least: int
) -> Scan:
    """``paste`` of groups of candidates, each with the maximum number of them to place."""
    placed: list[Object] = []
    for objects, count in groups:
        most = None if count is None else len(placed) + count
        for candidate in objects:
            if len(placed) == most:
                break
            if candidate.cast is None:
                refuse_coarser(candidate.scan.sensor, scan.sensor)
            fitted = _fit(scan, candidate, placed)
            if fitted is not None:
                placed.append(fitted)
    placed.sort(key=lambda o: float(np.hypot(o.box[0], o.box[1])))
    seen, pasted = show_objects(scan, placed, least)
    return merge_scans(_own(scan, seen, least), pasted)


def show_objects(
    scan: Scan, placed: list[Object], least: int
) -> tuple[NDArray[np.bool_], list[Scan]]:
    """What a sensor sees of a scan and of objects in it.

    Args:
        scan: N points.
        placed: objects where they stand, from near to far.
        least: minimum number of visible returns of an object.

    Returns:
        (N,) True for points that are still visible, and the visible returns of each object that is
        seen, with its box and its occlusion.
    """
    view = Composition(scan)
    shown = [o for o in placed if view.add(o, least)]
    parts = zip(shown, view.parts[1:], strict=True)
    visible = [_as_seen(o.scan, part) for o, part in parts]
    return view.parts[0].seen, [v for v in visible if len(v) >= least]


def _fit(scan: Scan, candidate: Object, placed: list[Object]) -> Object | None:
    """The object placed on the ground of the scan; None if there is no suitable place."""
    box = candidate.box
    taken = [o.box for o in placed]
    if scan.boxes is not None:
        taken += list(scan.boxes.values)
    if taken and find_overlapping(widen_boxes(box, CLEARANCE), np.array(taken)).any():
        return None
    ground = ground_under(scan, box)
    if ground is None or not (ground.encloses and ground.free):
        return None
    if candidate.cast is None and abs(ground.height - candidate.ground) > LIFT:
        return None
    return _raised(candidate, ground.height, scan.sensor)


def _raised(candidate: Object, height: float, sensor: Sensor) -> Object:
    """The object raised or lowered to ground of a given height, and cast there if it can be."""
    assert candidate.scan.boxes is not None
    lift = np.array([0, 0, height - candidate.ground], np.float32)
    values = candidate.scan.boxes.values.copy()
    values[:, :3] += lift
    boxes = replace(forget_images(candidate.scan.boxes), values=values)
    if candidate.cast is not None:
        return Object(candidate.cast(boxes, sensor), height)
    points = candidate.scan.points + lift
    # No rings: at another height, other lasers see it.
    return Object(
        replace(candidate.scan, points=points, ring=None, boxes=boxes), height
    )


def _as_seen(scan: Scan, part: VisibleReturns) -> Scan:
    """The visible returns of an object, as one instance, with its occlusion."""
    assert scan.boxes is not None
    visible = scan[part.seen]
    boxes = replace(
        update_occlusion(scan.boxes, np.array([part.share])),
        instance=np.ones(1, np.int32),
    )
    return replace(visible, instance=np.ones(len(visible), np.int32), boxes=boxes)


def _own(scan: Scan, seen: NDArray[np.bool_], least: int) -> Scan:
    """The scan reduced to its visible points (N,), with the occlusion of its boxes updated."""
    remaining, boxes = still_visible(scan, seen, least)
    return replace(scan[remaining], boxes=boxes)


def still_visible(
    scan: Scan, seen: NDArray[np.bool_], least: int
) -> tuple[NDArray[np.bool_], Boxes]:
    """What remains of a scan behind new objects.

    Args:
        scan: N points.
        seen: (N,) True for points that are still visible.
        least: minimum number of returns of an object; one that falls below it is removed with its
            box.

    Returns:
        (N,) True for the remaining points, and the remaining boxes with their occlusion updated.
    """
    if scan.boxes is None:
        return seen, Boxes(np.zeros((0, 7), np.float32), ())
    removed = np.zeros(len(scan.boxes), bool)
    share = np.ones(len(scan.boxes))
    # Only the few boxes that lose returns: examining all would take longer than pasting.
    losing = np.flatnonzero(standing(scan[~seen], scan.boxes).any(1))
    inside = standing(scan, scan.boxes[losing])
    after = (inside & seen).sum(1)
    share[losing] = after / np.maximum(inside.sum(1), 1)
    removed[losing] = after < least
    kept = seen & ~inside[removed[losing]].any(0)
    return kept, update_occlusion(scan.boxes, share)[~removed]


def update_occlusion(boxes: Boxes, share: NDArray[np.float64]) -> Boxes:
    """The boxes with occlusion levels updated by the shares (M,) of their returns that are still
    visible."""
    level = np.select(
        [share >= least for least, _ in OCCLUSION], [level for _, level in OCCLUSION]
    )
    # Good visibility here does not exclude earlier occlusion: unknown (-1 or 3) stays unknown.
    keep = (level == 0) | (boxes.occlusion >= level)
    return replace(
        boxes, occlusion=np.where(keep, boxes.occlusion, level).astype(np.int8)
    )
