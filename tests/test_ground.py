"""The ground under an object in a scan without labels, where the lowest returns tell it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from box_scenes import HEIGHT, car, cast

from lidar_synth import open_scans
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels import objects_of
from lidar_synth.labels.ground import ground_under


def bare(scan: Scan) -> Scan:
    """The scan without labels, and with boxes that name no instance."""
    assert scan.boxes is not None
    boxes = Boxes(scan.boxes.values, scan.boxes.names)
    return replace(scan, label=None, instance=None, boxes=boxes)


def test_mirror_returns_under_a_car_are_no_ground() -> None:
    scan = bare(cast([car(12, 0, 0.3)]))
    near = np.flatnonzero(np.abs(scan.points[:, :2] - (12, 0)).max(1) < 3)
    scan.points[near[:: len(near) // 20], 2] = -HEIGHT - 3
    [item] = objects_of(scan).values()
    assert abs(item.ground + HEIGHT) < 0.05


def test_cars_of_unlabelled_recordings_stand_on_their_ground(
    labelled_scans: Path,
) -> None:
    off = [
        ground.height - (box[2] - box[5] / 2)
        for scan in open_scans(labelled_scans / "kitti_drive_0048")
        for box in scan.boxes.values
        if (ground := ground_under(scan, box)) is not None
    ]
    assert len(off) == 54 and np.abs(off).max() < 0.3
