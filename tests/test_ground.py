"""The ground under an object in a scan without labels, where the lowest returns tell it, and the
edges of a scan that was cropped."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from box_scenes import CAR, HEIGHT, car, cast

from lidar_synth import Town, open_scans
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels import edit, objects_of
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


def too_high(scans: Iterable[Scan]) -> np.ndarray:
    """(n,) metres by which the ground lies above the floors of the boxes, where there is any."""
    grounds = [
        (ground_under(scan, box), box[2] - box[5] / 2)
        for scan in scans
        for box in scan.boxes.values
    ]
    return np.array([ground.height - floor for ground, floor in grounds if ground])


def test_cars_of_unlabelled_recordings_stand_on_their_ground(
    labelled_scans: Path,
) -> None:
    off = too_high(open_scans(labelled_scans / "kitti_drive_0048"))
    assert len(off) == 54 and np.abs(off).max() < 0.3


def test_objects_of_an_unlabelled_town_stand_on_their_ground() -> None:
    off = too_high([bare(Town(3, "hdl64e_lasers", 21)[20])])
    assert len(off) == 27 and np.quantile(np.abs(off), 0.95) < 0.1


def test_a_car_without_ground_around_it_stands_on_the_floor_of_its_box() -> None:
    full = cast([car(6, -2)])
    scan = bare(full[(full.label == CAR) & (full.points[:, 2] > 0.8 - HEIGHT)])
    low = ground_under(scan, scan.boxes.values[0])
    assert low is not None and low.height > 0.7 - HEIGHT
    [item] = objects_of(scan).values()
    assert abs(item.ground + HEIGHT) < 0.01
    assert not len(edit.remove(scan, 0))


def direction(scan: Scan) -> np.ndarray:
    """(N,) degrees counter-clockwise from straight ahead."""
    return np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))


def test_nothing_is_drawn_beside_a_cropped_scan() -> None:
    full = cast([car(3, -2.5)])
    scan = bare(full[np.abs(direction(full)) < 40])
    result = edit.remove(scan, 0)
    assert np.abs(direction(result)).max() < 41
