"""Boxes of generated scans: those of the layout that conditioned a scan, and the instances of its
points."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from lidar_synth.datasets.classes import GROUND
from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, RangeImage, Scan
from lidar_synth.geometry.layout import Layout, select_known_boxes
from lidar_synth.geometry.projection import project, unproject

TOLERANCE = 0.1
"""Metres outside a box within which a point belongs to it."""

FIELDS = frozenset(("boxes", "instance"))
"""Fields that only scans conditioned on a layout have."""


@runtime_checkable
class Drawer(Protocol):
    """Objects that can be cast into a scan, such as those of ``ObjectBank.from_town``."""

    def draw(self, scan: Scan, boxes: Boxes) -> Scan:
        """The scan with objects cast at the boxes (M) in the place of its own."""
        ...


def boxes_of(condition: Any, count: int) -> list[Boxes] | None:
    """The boxes of the layouts that condition ``count`` scans; None if one of them is an image,
    whose boxes are not known.

    Args:
        condition: as for ``Generator.range_images``.
        count: number of scans.

    Raises:
        DataError: on layouts and images together.
    """
    if isinstance(condition, Mapping):
        condition = condition.get("layout")
    each = list(condition) if isinstance(condition, Sequence) else [condition] * count
    each = [one.get("layout") if isinstance(one, Mapping) else one for one in each]
    known = [isinstance(one, Scan | Layout) and one.boxes is not None for one in each]
    if any(known) and not all(known):
        raise DataError(
            "layouts and images of layouts together",
            "one kind for all scans: an image does not tell its boxes",
        )
    if not all(known):
        return None
    return [
        one.boxes if isinstance(one, Layout) else select_known_boxes(one)
        for one in each
    ]


def add_boxes(image: RangeImage, boxes: Boxes) -> RangeImage:
    """An image with the boxes that hold a return, and the channel ``instance``: n for returns in
    box n of these, counted from 1; 0 = none. Returns of the ground belong to no box."""
    scan = unproject(image)
    inside = boxes.enlarged(TOLERANCE).contain(scan.points)
    if scan.label is not None:
        inside &= ~GROUND[scan.label]
    held = inside.any(1)
    kept = boxes[held]
    inside = inside[held]
    kept = replace(kept, instance=np.arange(1, len(kept) + 1, dtype=np.int32))
    instance = np.zeros(image.range.shape, np.int32)
    if len(kept):
        instance[image.mask] = np.where(inside.any(0), inside.argmax(0) + 1, 0)
    return replace(image, channels={**image.channels, "instance": instance}, boxes=kept)


def draw_boxes(image: RangeImage, boxes: Boxes, objects: Drawer) -> RangeImage:
    """An image with the objects of a bank cast at the boxes; it gets the boxes that are seen, and
    the channel ``instance``."""
    scan = objects.draw(unproject(image), boxes)
    drawn = project(scan, channels=[*image.channels, "instance"])
    assert scan.boxes is not None
    seen = np.isin(scan.boxes.instance, drawn.channels["instance"])
    return replace(drawn, boxes=scan.boxes[seen])
