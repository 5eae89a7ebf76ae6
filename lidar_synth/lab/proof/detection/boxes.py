"""The boxes that are detected: their classes, and their returns."""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, Scan

CLASSES = {
    "car": ("Car", "Van"),
    "pedestrian": ("Pedestrian", "Person_sitting"),
    "cyclist": ("Cyclist",),
}
"""Names of the boxes of each class; other boxes (trucks, trams) are background."""

CLASS_OF = {
    name: number for number, names in enumerate(CLASSES.values()) for name in names
}
"""From a box's name to the number of its class."""

LEAST = 5
"""Minimum number of points of a box that is trained on, or that has to be found."""


def points_in(
    boxes: Boxes,
    scan: Scan,
) -> NDArray[np.int64]:
    """(M,) number of returns of a scan in each of M boxes, above its floor."""
    return np.asarray(boxes.contain(scan.points, above_floor=0.1).sum(1))


def detected(scan: Scan) -> Boxes:
    """The boxes of a scan's detected classes.

    Raises:
        DataError: on a scan without boxes.
    """
    if scan.boxes is None:
        raise DataError(f"scan {scan.id!r} without boxes", "scans with boxes")
    return scan.boxes[np.array([name in CLASS_OF for name in scan.boxes.names], bool)]


def classes_of(boxes: Boxes) -> NDArray[np.int64]:
    """(M,) the class of each box."""
    return np.array([CLASS_OF[name] for name in boxes.names], np.int64)


def with_points(scan: Scan) -> Scan:
    """The scan with those boxes that hold ``LEAST`` returns."""
    assert scan.boxes is not None
    scan.boxes = scan.boxes[points_in(scan.boxes, scan) >= LEAST]
    return scan
