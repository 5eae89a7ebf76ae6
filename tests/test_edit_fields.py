"""The fields of edited scans: labels, classes of the file, instances, causes and rings."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
from box_scenes import CAR, HEIGHT, ROAD, car, cast, wall
from hypothesis import given

from lidar_synth import ObjectBank, Town, open_scans
from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI, TRAIN_ID
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.labels import edit, objects_of
from lidar_synth.labels.edit.compose import next_instance
from lidar_synth.labels.edit.insertion import cut_out

BEHIND = wall(24, 0, np.pi / 2, length=80)


def test_an_object_of_a_bank_is_inserted_as_that_of_its_scan() -> None:
    """Its rings are those of the scan; few returns do not show them."""
    town = Town(seed=8, sensor="hdl64e_kitti", scans=1)[0]
    bank = ObjectBank.from_scans([town], least=100)
    own = list(objects_of(town, 100).values())
    assert len(bank) == len(own) > 2
    for index, item in enumerate(own):
        emptied = edit.remove(town, int(bank.number[index]))
        one, two = (edit.insert(emptied, o) for o in (item, bank[index]))
        assert len(one) == len(two)
        assert np.allclose(one.points, two.points, atol=1e-4)


def test_a_moving_object_keeps_its_class_and_its_track() -> None:
    """And shows a surface, whatever the scan's first return does; the image shows it elsewhere."""
    moving = cast([car(12, 0)], [BEHIND])
    number = np.where(moving.instance == 1, 7, 0).astype(np.int32)
    classes = np.where(number > 0, 252, SEMANTIC_KITTI.encode(moving.label))
    scan = replace(
        moving,
        raw_label=classes.astype(np.uint32) | number.astype(np.uint32) << 16,
        instance=number,
        cause=np.ones(len(moving), np.uint8),
        boxes=replace(moving.boxes, instance=np.array([7], np.int32)),
        image_path=Path("image.png"),
    )
    result = edit.move(scan, 0, (14, 3))
    mine = result.label == CAR
    assert result.image_path is None and result.boxes.instance.tolist() == [7]
    assert set(result.raw_label[mine]) == {252 | 7 << 16}
    assert set(result.instance[mine]) == {7} and not result.cause[mine].any()
    untracked = replace(scan, instance=None, label=None, raw_label=None)
    assert edit.move(untracked, 0, (14, 3)).boxes.instance.tolist() == [7]


def test_what_is_drawn_without_a_label_is_ignored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where neither model nor surroundings tell a label; not that of the scan's first return."""
    scan = cast([car(12, 0, ground=0.5 - HEIGHT)])
    scan.confidence = np.ones(len(scan), np.float32)
    drawn = RangeImage(np.full(scan.sensor.shape, 20, np.float32), scan.sensor, {})
    monkeypatch.setattr("lidar_synth.generate.inpaint.check_model", lambda *_: None)
    monkeypatch.setattr("lidar_synth.generate.inpaint.inpaint", lambda *_: [drawn])
    result = edit.remove(scan, 0, model=SimpleNamespace())
    above = result.points[:, 2] > 0
    assert above.any() and (result.label[above] == IGNORE).all()
    assert not result.confidence[above].any()
    assert (result.label[~above] == ROAD).any()


def test_an_inserted_object_survives_the_labels_of_kitti_360(tmp_path: Path) -> None:
    """Where instances are class * 1000 + number."""
    truck = cast([car(12, 0), car(8, 8)], [BEHIND])
    truck.label[truck.instance == 2] = TRAIN_ID["truck"]
    numbers = np.array([0, 26001, 27017], np.int32)
    scan = replace(
        truck,
        instance=numbers[truck.instance],
        boxes=replace(truck.boxes, names=("Car", "Truck"), instance=numbers[1:]),
    )
    writer = WRITERS["kitti360"](tmp_path)
    item = cut_out(cast([car(12, 0, 0.3)]), 0)
    writer.write(edit.insert(scan, item, (10, -9)), 0)
    writer.finish()
    back = open_scans(tmp_path)[0]
    new = back.boxes.instance[-1]
    assert new // 1000 == 26 and (back.instance == new).sum() > 100
    assert len(edit.remove(back, 2).boxes) == 2


@given(st.lists(st.integers(-1, (1 << 31) - 1), max_size=30))
def test_a_new_instance_has_a_number_of_its_own_in_every_class(used: list[int]) -> None:
    scan = cast()
    numbers = np.array(used, np.int32)
    new = next_instance(replace(scan[: len(used)], instance=numbers, boxes=None))
    assert 0 < new < 1000 and new not in numbers % 1000
