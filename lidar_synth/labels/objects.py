"""Objects cut out of scans, to be pasted into other scans."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE, LABELS, TRAIN_ID
from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, Scan, Sensor
from lidar_synth.labels.boxes import grow_box, turn_boxes, turn_points
from lidar_synth.labels.ground import ground_of

THINGS = TRAIN_ID["road"]
"""Train ids below this one have instances."""

LOWEST = 0.1
"""Minimum height above the ground, metres, of an object's returns if the scan has neither labels
nor instances."""

NOISE = 0.15
"""Maximum distance of an instance's returns from its box, metres."""


class Object(NamedTuple):
    """One object at its recorded position.

    Args:
        scan: its points with reflectance and label, with the class of the file and ring if the
            recorded scan has them, and its one box.
        ground: height of the ground under it, metres above the sensor's origin.
        cast: ``(boxes, sensor) -> Scan`` makes its returns at another place, as of
            ``ObjectBank.from_town``; without it, the points themselves are moved.
    """

    scan: Scan
    ground: float
    cast: Callable[[Boxes, Sensor], Scan] | None = None

    @property
    def box(self) -> NDArray[np.float32]:
        """(7,) the object's box."""
        values: NDArray[np.float32] = self.scan.boxes.values[0]  # type: ignore[union-attr]
        return values

    def turned(self, angle: float) -> "Object":
        """The object turned about the sensor, counter-clockwise by an angle in radians."""
        assert self.scan.boxes is not None
        points = turn_points(self.scan.points, angle)
        return self._replace(
            scan=replace(
                self.scan, points=points, boxes=turn_boxes(self.scan.boxes, angle)
            )
        )


def objects_of(scan: Scan, least: int = 5) -> dict[int, Object]:
    """The objects in a scan's boxes, as ``{index of the box: object}``.

    If boxes and points have instances, an object's points are those of its instance; its box is
    enlarged by some centimetres if noise or tilt puts points outside. Otherwise its points are
    those in the box above the ground.

    Args:
        scan: a scan with boxes.
        least: minimum number of points of an object.

    Raises:
        DataError: if the scan has no boxes.
    """
    if scan.boxes is None:
        raise DataError(
            f"scan {scan.id!r} has no boxes", "a scan with boxes around its objects"
        )
    objects = {}
    for number in range(len(scan.boxes)):
        cut = _cut(scan, scan.boxes[[number]])
        if cut is not None and len(cut.scan) >= least:
            objects[number] = cut
    return objects


def instances_of(scan: Scan, least: int = 5) -> list[Object]:
    """The objects of a scan with instances but without boxes; their boxes are the extents of their
    points.

    Raises:
        DataError: if the scan has no instances or no labels.
    """
    if scan.instance is None or scan.label is None:
        raise DataError(
            f"scan {scan.id!r} has no instances",
            "labels and instances, as in SemanticKITTI",
        )
    things = np.flatnonzero(scan.label < THINGS)
    which = number_instances(scan)[things]
    objects = []
    ordered = things[np.argsort(which, kind="stable")]
    for part in np.split(ordered, np.cumsum(np.bincount(which)))[1:]:
        if len(part) >= least:
            box = enclose(scan.points[part])
            objects.append(_object(scan, part, Boxes(box, ("Misc",))))
    return objects


def number_instances(scan: Scan) -> NDArray[np.int32]:
    """(N,) the instances of a scan as 1, 2, ..., 0 = none.

    Files count instances within each of their classes: a parked car and a moving one of
    SemanticKITTI may both have number 1. Without ``raw_label``, the classes are those of ``label``.
    """
    assert scan.instance is not None
    kind: Any = scan.label if scan.raw_label is None else scan.raw_label
    some = np.flatnonzero(scan.instance > 0)
    keys = scan.instance[some].astype(np.int64) << 32 | kind[some]
    numbers = np.zeros(len(scan), np.int32)
    numbers[some] = np.unique(keys, return_inverse=True)[1] + 1
    return numbers


def enclose(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """The box of yaw 0 around points, as of ``Boxes``."""
    low = points.min(0)
    high = points.max(0)
    box = np.r_[(low + high) / 2, np.maximum(high - low, 0.1), 0].astype(np.float32)
    return grow_box(box, points)


def enlarge_boxes(scan: Scan) -> Scan:
    """The scan with boxes enlarged by some centimetres, so that they contain all returns of their
    instance."""
    if scan.boxes is None or scan.instance is None:
        return scan
    values = scan.boxes.values.copy()
    for number in np.flatnonzero(scan.boxes.instance > 0):
        values[number] = grow_box(
            values[number], scan.points[_instance(scan, scan.boxes[[number]])]
        )
    return replace(scan, boxes=replace(scan.boxes, values=values))


def find_returns(scan: Scan, box: Boxes) -> NDArray[np.bool_]:
    """(N,) True for the returns of the object in one box: those of its instance, or those above the
    ground if no point of the scan has one."""
    numbered = box.instance[0] > 0 and scan.instance is not None and scan.instance.any()
    return _instance(scan, box) if numbered else _standing(scan, box)


def _instance(scan: Scan, box: Boxes) -> NDArray[np.bool_]:
    """(N,) True for points of a box's instance that lie within it or within ``NOISE`` of it."""
    near = box.enlarged(NOISE).contain(scan.points)[0]
    return np.asarray(near & (scan.instance == box.instance[0]))


def _cut(scan: Scan, box: Boxes) -> Object | None:
    """The object in one box; None if it contains no points."""
    mine = np.flatnonzero(find_returns(scan, box))
    if len(mine):
        return _object(
            scan,
            mine,
            replace(box, values=grow_box(box.values[0], scan.points[mine])[None]),
        )
    return None


def _standing(scan: Scan, box: Boxes) -> NDArray[np.bool_]:
    """(N,) True for the points in a box that are above the ground."""
    inside: NDArray[np.bool_] = box.contain(scan.points)[0]
    ground = ground_of(scan, box.values[0])
    if ground is not None:
        inside[inside] = ground.above(scan.points[inside], box.values[0]) > LOWEST
    return inside if scan.label is None else inside & ~GROUND[scan.label]


def _object(scan: Scan, mine: NDArray[np.intp], box: Boxes) -> Object:
    """The object of some returns (n,) of a scan, with its one box."""
    [values] = box.values
    ground = ground_of(scan, values)
    label = LABELS.get(box.names[0], IGNORE)
    part = Scan(
        scan.points[mine],
        scan.reflectance[mine],
        scan.sensor,
        label=np.full(len(mine), label, np.uint8)
        if scan.label is None
        else scan.label[mine],
        raw_label=None if scan.raw_label is None else scan.raw_label[mine],
        ring=None if scan.ring is None else scan.ring[mine],
        boxes=replace(box, dont_care=np.zeros((0, 4), np.float32)),
        id=scan.id,
    )
    return Object(
        part, float(values[2] - values[5] / 2) if ground is None else ground.height
    )
