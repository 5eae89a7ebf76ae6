"""Scans and boxes in nuScenes' form, for trainers that read it.

nuScenes' LiDAR frame has x right, y forward, z up. A point has five values: x, y, z, intensity
0..255 and ring, 0 = the lowest. Boxes have ten classes and a velocity.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.formats.nuscenes import INTENSITY_MAX
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.geometry.projection import locate
from lidar_synth.labels.boxes import move_boxes

CLASSES = (
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)
"""nuScenes' ten detection classes."""

NAMES = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Pedestrian": "pedestrian",
    "Person_sitting": "pedestrian",
    "Cyclist": "bicycle",
    "Motorcyclist": "motorcycle",
    "Bicycle": "bicycle",
    "Motorcycle": "motorcycle",
    "Tram": None,
    "Misc": None,
    **{name: name for name in CLASSES},
}
"""nuScenes' class by KITTI's; None: nuScenes has no such class, and the box is dropped. A van is a
car in nuScenes, and a cyclist a bicycle with its rider; a motorcyclist likewise."""


def as_nuscenes(scan: Scan) -> Scan:
    """Convert a scan to nuScenes' frame, exactly, and its boxes to nuScenes' classes.

    Boxes without a return are dropped, because nuScenes' trainers drop them too.

    Raises:
        DataError: on a box with a name that ``NAMES`` does not have.
    """
    boxes = scan.boxes
    if boxes is not None:
        names = nuscenes_names(boxes.names, f"scan {scan.id!r}")
        seen = boxes.contain(scan.points).any(1) if len(boxes) else np.zeros(0, bool)
        kept = np.array([name is not None for name in names], bool) & seen
        boxes = turned_boxes(
            replace(boxes, names=tuple(name or "" for name in names))[kept]
        )
    ring = scan.ring if scan.ring is not None else _rings(scan)
    return replace(
        scan, points=turned_points(scan.points), ring=ring, boxes=boxes, pose=None
    )


def nuscenes_names(names: tuple[str, ...], where: str) -> list[str | None]:
    """nuScenes' class of each name, None for those that it lacks.

    Raises:
        DataError: on a name that ``NAMES`` does not have.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise DataError(
            f"boxes of {unknown} in {where}",
            f"some of {', '.join(NAMES)}",
            "Rename the boxes.",
        )
    return [NAMES[name] for name in names]


def turned_points(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert (N, 3) points exactly from x forward, y left to nuScenes' x right, y forward."""
    return np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])


def turned_boxes(boxes: Boxes) -> Boxes:
    """Convert boxes from x forward, y left to nuScenes' x right, y forward."""
    values = boxes.values.copy()
    values[:, :3] = turned_points(boxes.values[:, :3])
    values[:, 6] += np.float32(np.pi / 2)
    return move_boxes(boxes, values)


def five_values(scan: Scan) -> NDArray[np.float32]:
    """(N, 5) float32 x, y, z, intensity 0..255 and ring of a scan that ``as_nuscenes``
    converted."""
    assert scan.ring is not None
    lowest_first = (scan.sensor.shape[0] - 1 - scan.ring).astype(np.float32)
    points = np.column_stack(
        [scan.points, scan.reflectance * np.float32(INTENSITY_MAX), lowest_first]
    )
    return np.ascontiguousarray(points, np.float32)


def _rings(scan: Scan) -> NDArray[np.int16]:
    """(N,) the row of each point on the sensor's grid, 0 = the highest; -1 becomes the lowest
    row."""
    cell = locate(scan.points, scan.sensor).cell
    rows, columns = scan.sensor.shape
    return np.where(cell < 0, rows - 1, cell // columns).astype(np.int16)
