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
"""What the scans of a layout have besides those of other models."""


@runtime_checkable
class Drawer(Protocol):
    """Objects that can be cast into a scan, such as those of ``ObjectBank.from_town``."""

    def draw(self, scan: Scan, boxes: Boxes) -> Scan:
        """The scan whose objects are those of some boxes, cast there."""
        ...


def boxes_of(given: Any, count: int) -> list[Boxes] | None:
    """The boxes of the layouts of ``count`` scans; None where conditions are images, which do not
    tell them.

    Args:
        given: the argument ``condition`` of ``Generator.range_images``.
        count: number of scans.

    Raises:
        DataError: on layouts and images together.
    """
    if isinstance(given, Mapping):
        given = given.get("layout")
    each = list(given) if isinstance(given, Sequence) else [given] * count
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
    """An image with those boxes that hold a return, and the channel ``instance``: 1 for the returns
    in the first of them, and so on; 0 = none. Returns of the ground belong to no box."""
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
    """An image whose objects are cast: those of a bank, at boxes; with the boxes that are seen, and
    the channel ``instance``."""
    drawn = objects.draw(unproject(image), boxes)
    made = project(drawn, channels=[*image.channels, "instance"])
    assert drawn.boxes is not None
    seen = np.isin(drawn.boxes.instance, made.channels["instance"])
    return replace(made, boxes=drawn.boxes[seen])
