"""Objects set into a scan, at their own range, as the sensor would have seen them there.

An object is raised or lowered to the ground under it, and refused where there is none, or where something stands. In
the range image of the scan's sensor the nearer return of a cell then stays: what stands in front of an object hides
it, and the object hides all that lies behind its outline, in the gaps between its returns too. So a box holds the
returns of its object and, at its floor, of the ground, and there is nothing behind them.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels.boxes import overlapping, unseen, widened
from lidar_synth.labels.ground import CLEARANCE, ground_under, standing
from lidar_synth.labels.merge import merged
from lidar_synth.labels.objects import Object
from lidar_synth.labels.view import View, VisibleReturns, refuse_coarser

LIFT = 1.0
"""Metres by which an object is raised or lowered at most: farther, the sensor would see another side of it."""
OCCLUSION = ((0.80, 0), (0.45, 1), (0.0, 2))
"""KITTI's occlusion by the least visible share: 0 visible, 1 partly, 2 largely."""


def paste(scan: Scan, objects: Iterable[Object], *, count: int | None = None, least: int = 5) -> Scan:
    """A scan with objects set into it.

    Args:
        scan: N points; its labels tell ground from what stands on it; without any, the lowest returns are ground.
        objects: candidates in order; those that find no place are passed over. Their returns are thinned to one per
            cell of the scan's sensor.
        count: how many to place at most; by default all that find a place.
        least: returns that must be seen of an object. Of what was in the scan, too: a box that is left with fewer
            leaves the scan, with its returns.

    Returns:
        A new scan, which always has boxes. The pasted points follow those that are left, with their label, confidence
        1 and a new instance; their boxes, from near to far, follow those that the scan had. Occlusion is what the
        object had before or, if worse, what is hidden here; where the first is not known, a lower bound.

    Raises:
        DataError: on objects that a coarser sensor saw.
    """
    placed: list[Object] = []
    for candidate in objects:
        if count is not None and len(placed) >= count:
            break
        refuse_coarser(candidate.scan.sensor, scan.sensor)
        fitted = _fit(scan, candidate, placed)
        if fitted is not None:
            placed.append(fitted)
    placed.sort(key=lambda o: float(np.hypot(o.box[0], o.box[1])))
    view = View(scan)
    shown = [o for o in placed if view.add(o, least)]
    own = _own_boxes(scan, view.parts[0].seen, least)
    pasted = [_as_seen(o.scan, part) for o, part in zip(shown, view.parts[1:], strict=True)]
    return merged(own, [p for p in pasted if len(p) >= least])


def _fit(scan: Scan, candidate: Object, placed: list[Object]) -> Object | None:
    """The object on the ground of the scan; None where it cannot stand."""
    box = candidate.box
    taken = [o.box for o in placed] + ([] if scan.boxes is None else list(scan.boxes.values))
    if taken and overlapping(widened(box, CLEARANCE), np.array(taken)).any():
        return None
    ground = ground_under(scan, box)
    if ground is None or not (ground.encloses and ground.free) or abs(ground.height - candidate.ground) > LIFT:
        return None
    return _raised(candidate, ground.height)


def _raised(candidate: Object, height: float) -> Object:
    """The object on ground of another height."""
    assert candidate.scan.boxes is not None
    lift = np.array([0, 0, height - candidate.ground], np.float32)
    values = candidate.scan.boxes.values.copy()
    values[:, :3] += lift
    boxes = replace(unseen(candidate.scan.boxes), values=values)
    return Object(replace(candidate.scan, points=candidate.scan.points + lift, boxes=boxes), height)


def _as_seen(scan: Scan, part: VisibleReturns) -> Scan:
    """An object's returns that are seen, as an instance, with its occlusion."""
    assert scan.boxes is not None
    seen = scan[part.seen]
    boxes = replace(_hidden(scan.boxes, np.array([part.share])), instance=np.ones(1, np.int32))
    return replace(seen, instance=np.ones(len(seen), np.int32), boxes=boxes)


def _own_boxes(scan: Scan, seen: NDArray[np.bool_], least: int) -> Scan:
    """What is left of a scan of whose points (N,) these are seen, with its boxes as they are seen now."""
    if scan.boxes is None:
        return replace(scan[seen], boxes=Boxes(np.zeros((0, 7), np.float32), ()))
    inside = standing(scan, scan.boxes)
    before, after = inside.sum(1), (inside & seen).sum(1)
    gone = (after < before) & (after < least)
    left = seen & ~inside[gone].any(0)
    return replace(scan[left], boxes=_hidden(scan.boxes, after / np.maximum(before, 1) + (before == 0))[~gone])


def _hidden(boxes: Boxes, share: NDArray[np.float64]) -> Boxes:
    """Boxes of which shares (M,) of what was seen before are seen now."""
    level = np.select([share >= least for least, _ in OCCLUSION], [level for _, level in OCCLUSION])
    # That much of it is seen here says nothing of what was hidden before: unknown (-1 or 3) stays unknown.
    keep = (level == 0) | (boxes.occlusion >= level)
    return replace(boxes, occlusion=np.where(keep, boxes.occlusion, level).astype(np.int8))
