"""KITTI-360 as the package writes it: objects, their numbers, and the frames whose boxes are
known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_scenes import car, cast
from layouts import write_all

from lidar_synth.datasets.classes import SEMANTIC_KITTI, TRAIN_ID
from lidar_synth.formats import KITTI360
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels.objects import objects_of

OTHER = TRAIN_ID["other-vehicle"]


def street(names: tuple[str, ...], instances: list[int]) -> Scan:
    """Cars under other names and instances; all but the first are other vehicles to the points."""
    scan = cast([car(9, 3), car(14, -5), car(12, 9)][: len(names)])
    numbers = np.array([0, *instances])[scan.instance]
    label = np.where(scan.instance > 1, OTHER, scan.label).astype(np.uint8)
    boxes = Boxes(scan.boxes.values, names, instance=np.array(instances))
    return replace(scan, label=label, boxes=boxes, instance=numbers.astype(np.int32))


def test_boxes_and_points_keep_one_number_through_every_conversion(
    tmp_path: Path,
) -> None:
    """A tram is of another class than its points, which are those of any other vehicle."""
    scan = street(("Car", "Tram", "Misc"), [3, 4, 31_007])
    for folder in (tmp_path / "once", tmp_path / "again"):
        write_all("kitti360", folder, [scan])
        [scan] = KITTI360(folder)
        assert scan.boxes.instance.tolist() == [26_003, 43_004, 31_007]
        assert set(scan.instance.tolist()) == {0, 26_003, 43_004, 31_007}
        assert len(objects_of(scan)) == 3


def test_any_track_is_written(tmp_path: Path) -> None:
    scan = replace(cast([car(9, 3), car(14, -5)]), instance=None)
    tracks = [(1 << 31) - 1, 2_147_400_000]
    scan.boxes = replace(scan.boxes, instance=np.array(tracks, np.int32))
    write_all("kitti360", tmp_path, [scan])
    [read] = KITTI360(tmp_path)
    assert read.boxes.instance.tolist() == tracks
    assert len(objects_of(read)) == 2


@pytest.mark.parametrize("known", [(2, None, 0), (0, 0), (None, None, 1)])
def test_no_object_is_not_the_same_as_unknown_objects(
    known: tuple[int | None, ...], tmp_path: Path
) -> None:
    scan = cast([car(9, 3), car(14, -5)])
    scans = [
        replace(scan, boxes=None if count is None else scan.boxes[np.arange(count)])
        for count in known
    ]
    write_all("kitti360", tmp_path, scans)
    found = [scan.boxes for scan in KITTI360(tmp_path)]
    assert tuple(None if boxes is None else len(boxes) for boxes in found) == known


def test_a_long_object_is_near_if_one_end_is(tmp_path: Path) -> None:
    far = cast().sensor.range_max + 8.0
    scan = cast([car(9, 3)])
    tram = np.array([(far, 0, 0, 20, 2.5, 3, 0), (far, 5, 0, 4, 2, 2, 0)], np.float32)
    scan.boxes = Boxes(tram, ("Tram", "Car"))
    write_all("kitti360", tmp_path, [scan])
    assert KITTI360(tmp_path)[0].boxes.names == ("Tram",)


def test_parked_and_moving_objects_of_one_number_stay_two(tmp_path: Path) -> None:
    scan = replace(cast([car(9, 3), car(14, -5)]), boxes=None)
    ids = np.where(scan.instance == 2, 252, SEMANTIC_KITTI.encode(scan.label))
    instance = np.minimum(scan.instance, 1)
    raw = (ids | instance << 16).astype(np.uint32)
    write_all("kitti360", tmp_path, [replace(scan, instance=instance, raw_label=raw)])
    found = KITTI360(tmp_path)[0].instance
    assert [set(found[scan.instance == n].tolist()) for n in range(3)] == [
        {0},
        {26_001},
        {26_999},
    ]
