"""Objects cast into a generated scan.

The model draws the street. Each box gets the returns that the sensor would have of a real shape of
that size, so that boxes, labels and instances are exact.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND
from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.merge import merge_scans
from lidar_synth.labels.objects import THINGS, Object
from lidar_synth.labels.pasting import show_objects

MARGIN = 0.3
"""Metres around a box within which the model's returns of an object are dropped."""


def draw_objects(scan: Scan, boxes: Boxes, objects: ObjectBank, least: int = 1) -> Scan:
    """Replace the objects of a generated scan by objects of a bank, cast at given boxes.

    The scan's own returns of objects are removed, wherever they are, and so are those in the boxes
    above the ground. Each box then gets the object of its class whose size is nearest, stretched to
    the box and cast by the sensor's rays, with noise and lost returns. Objects hide what is behind
    them, and are hidden by what is in front.

    Args:
        scan: N labelled points, such as ``Generator.scans`` makes them.
        boxes: M boxes in the sensor frame, such as those of the layout of the scan.
        objects: objects that can be cast, as of ``ObjectBank.from_town``.
        least: minimum number of visible returns of a box; boxes with fewer are left out.

    Returns:
        A scan with the boxes that can be seen, each with an instance of its own.

    Raises:
        ConfigError: on boxes of classes that the bank lacks, a bank of returns, which cannot be
            cast, or a scan without labels.
    """
    if scan.label is None:
        raise ConfigError(f"scan {scan.id!r} without labels", "a scan with labels")
    chosen = _nearest_sizes(boxes, objects)
    order = np.argsort(np.hypot(*boxes.values[:, :2].T), kind="stable")
    placed = [_cast(objects[chosen[n]], boxes[[n]], scan) for n in order.tolist()]
    inside = boxes.enlarged(MARGIN).contain(scan.points).any(0)
    removed = (scan.label < THINGS) | (inside & ~GROUND[scan.label])
    bare = replace(scan[~removed], boxes=None, instance=None)
    seen, shown = show_objects(bare, [p for p in placed if len(p.scan)], least)
    drawn = merge_scans(bare[seen], shown)
    return drawn if shown else replace(drawn, boxes=boxes[[]])


def _nearest_sizes(boxes: Boxes, objects: ObjectBank) -> NDArray[np.intp]:
    """(M,) the object of the same class with the nearest size, for each box."""
    known = np.array(objects.boxes.names)
    names = np.array(boxes.names, np.str_)
    if lacking := sorted(set(names.tolist()) - set(known.tolist())):
        raise ConfigError(
            f"boxes of {', '.join(lacking)}",
            f"classes of the objects: {', '.join(sorted(set(known.tolist())))}",
            "Leave these boxes out, or give a bank that has such objects.",
        )
    difference = boxes.values[:, None, 3:6] - objects.boxes.values[None, :, 3:6]
    far = np.abs(difference).sum(2) + np.where(names[:, None] == known, 0, np.inf)
    nearest: NDArray[np.intp] = far.argmin(1)
    return nearest


def _cast(item: Object, box: Boxes, scan: Scan) -> Object:
    """An object stretched to a box and cast there."""
    if item.cast is None:
        raise ConfigError(
            "a bank of returns, which cannot be cast",
            "ObjectBank.from_town(...), as it is made: a saved bank holds returns",
        )
    [values] = box.values
    return Object(item.cast(box, scan.sensor), float(values[2] - values[5] / 2))
