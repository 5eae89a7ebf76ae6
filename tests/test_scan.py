"""Scans, boxes, class tables and error messages."""

import copy
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from conftest import random_scan
from hypothesis import given

from lidar_synth.datasets.classes import (
    IGNORE,
    KITTI360,
    NAMES,
    NUSCENES,
    SEMANTIC_KITTI,
    Taxonomy,
)
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import (
    ConfigError,
    DataError,
    FileError,
    LibraryError,
    LidarSynthError,
)
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import presets

TAXONOMIES = (SEMANTIC_KITTI, KITTI360, NUSCENES)


def boxes(count: int, seed: int = 0) -> Boxes:
    rng = np.random.default_rng(seed)
    values = np.c_[
        rng.uniform(-20, 20, (count, 3)),
        rng.uniform(0.5, 5, (count, 3)),
        rng.uniform(-4, 4, count),
    ]
    return Boxes(values.astype(np.float32), ("Car",) * count)


@given(st.integers(0, 1000))
def test_a_box_contains_its_corners_and_nothing_beyond(seed: int) -> None:
    several = boxes(3, seed)
    centre = several.values[:, None, :3]
    inward = centre + (several.corners() - centre) * 0.999
    outward = centre + (several.corners() - centre) * 1.001
    for i in range(3):
        assert several.contain(inward[i])[i].all()
        assert not several.contain(outward[i])[i].any()


def test_corners_follow_the_yaw_and_points_near_the_floor_can_be_excluded() -> None:
    box = Boxes(np.array([[0, 0, 0, 4, 2, 2, np.pi / 2]], np.float32), ("Car",))
    # Front left of a car that looks to the left.
    assert np.allclose(box.corners()[0, 0], [-1, 2, -1], atol=1e-6)
    points = np.array([[0, 1.9, 0], [1.9, 0, 0], [0, 0, -0.9]], np.float32)
    assert box.contain(points).tolist() == [[True, False, True]]
    assert box.contain(points, above_floor=0.3).tolist() == [[True, False, False]]


def test_points_become_float32() -> None:
    scan = random_scan(presets()["vlp16"], 20)
    wide = replace(scan, points=scan.points.astype(np.float64))
    assert np.array_equal(wide.points, scan.points) and wide.points.dtype == np.float32
    assert replace(scan).points is scan.points


def test_fields_get_their_types_without_a_copy_of_those_that_have_them() -> None:
    scan = random_scan(presets()["vlp16"], 20)
    half = scan.reflectance.astype(np.float16)
    wide = replace(
        scan,
        reflectance=half,
        label=scan.label.astype(np.int64),
        pose=np.eye(4, dtype="f4"),
    )
    types = [a.dtype for a in (wide.reflectance, wide.label, wide.pose)]
    assert types == [np.float32, np.uint8, np.float64]
    assert np.array_equal(wide.reflectance, half)
    assert project(wide).reflectance.dtype == np.float32
    image = project(scan)
    assert replace(scan).label is scan.label and replace(image).range is image.range
    again = {
        "label": image.label.astype(np.int64),
        "mine": image.range.astype(np.float64),
    }
    again = RangeImage(image.range.astype(np.float64), image.sensor, again).channels
    assert [a.dtype for a in again.values()] == [np.uint8, np.float64]
    for field, wrong in (
        ("label", -1),
        ("ring", 70_000),
        ("instance", 0.5),
        ("pose", 1j),
    ):
        shape = (4, 4) if field == "pose" else len(scan)
        with pytest.raises(DataError, match=f"{field} .*; expected .*numbers"):
            replace(scan, **{field: np.full(shape, wrong)})
    with pytest.raises(DataError, match="range image: label holds 300"):
        RangeImage(
            image.range, image.sensor, {"label": np.full(image.range.shape, 300)}
        )


def test_a_scan_equals_only_itself() -> None:
    """Comparing arrays would be slow, and numpy's comparison has no truth value."""
    scan = random_scan(presets()["vlp16"], 20)
    scan.boxes = boxes(2)
    for one in (scan, project(scan), scan.boxes):
        assert one == one and one != copy.deepcopy(one) and one in {one}


def test_selecting_keeps_fields_together() -> None:
    scan = random_scan(presets()["town"], 100)
    scan.boxes = boxes(2)
    picked = scan[scan.label == 0]
    assert np.all(picked.label == 0) and len(picked) == (scan.label == 0).sum()
    assert (
        set(picked.fields())
        == set(scan.fields())
        == {"reflectance", "label", "raw_label", "instance"}
    )
    assert picked.boxes is scan.boxes
    several = Boxes(
        boxes(3).values, ("Car", "Van", "Cyclist"), dont_care=np.ones((2, 4))
    )
    some = several[[True, False, True]]
    assert (some.names, len(some.dont_care), some.occlusion.tolist()) == (
        ("Car", "Cyclist"),
        2,
        [-1, -1],
    )


def test_mismatched_shapes_and_invalid_boxes_are_refused() -> None:
    scan = random_scan(presets()["town"], 10)
    with pytest.raises(DataError, match=r"points of shape \(10, 2\)"):
        Scan(scan.points[:, :2], scan.reflectance, scan.sensor)
    with pytest.raises(DataError, match=r"label has shape \(9,\)"):
        Scan(scan.points, scan.reflectance, scan.sensor, label=scan.label[:9])
    for wrong in ((3, 9), (7, 9), (14,)):
        with pytest.raises(
            DataError, match=r"boxes of the shape .*; expected \(M, 7\)"
        ):
            Boxes(np.ones(wrong, np.float32), ("Car",) * 3)
    with pytest.raises(DataError, match="2 names for 1 boxes"):
        Boxes(boxes(1).values, ("Car", "Car"))
    with pytest.raises(DataError, match="not positive"):
        Boxes(np.zeros((1, 7), np.float32), ("Car",))
    with pytest.raises(DataError, match=r"occlusion has shape \(2,\)"):
        Boxes(boxes(1).values, ("Car",), occlusion=np.zeros(2))
    for track in (np.array([1 << 40]), [1 << 40], [0.5]):
        with pytest.raises(DataError, match=f"instance {track[0]}; expected int32"):
            Boxes(boxes(1).values, ("Car",), instance=track)  # type: ignore[arg-type]


@pytest.mark.parametrize("taxonomy", TAXONOMIES, ids=lambda t: t.name)
def test_every_class_of_a_dataset_is_decoded_and_unknown_ones_are_refused(
    taxonomy: Taxonomy,
) -> None:
    ids = np.array(sorted(taxonomy.to_train))
    train = taxonomy.decode(ids)
    assert train.dtype == np.uint8 and np.all((train < 19) | (train == IGNORE))
    with pytest.raises(
        DataError,
        match=rf"here: unknown class ids \[{ids.max() + 1}\].*{taxonomy.name}",
    ):
        taxonomy.decode(np.array([ids.max() + 1]), "here")
    with pytest.raises(DataError, match="unknown class ids"):
        taxonomy.decode(np.array([-1]))
    if taxonomy.from_train is not None:
        assert set(taxonomy.from_train) <= set(taxonomy.to_train)


def test_semantic_kitti_labels_are_encoded_as_static_classes() -> None:
    every = np.array([*range(19), IGNORE], np.uint8)
    assert np.array_equal(SEMANTIC_KITTI.decode(SEMANTIC_KITTI.encode(every)), every)
    assert SEMANTIC_KITTI.decode(np.array([252, 259, 60, 1])).tolist() == [
        0,
        4,
        8,
        IGNORE,
    ]
    assert SEMANTIC_KITTI.encode(np.array([0, 8, IGNORE], np.uint8)).tolist() == [
        10,
        40,
        0,
    ]
    with pytest.raises(DataError, match=r"train ids \[19\]"):
        SEMANTIC_KITTI.encode(np.array([19], np.uint8))
    with pytest.raises(DataError, match="no table"):
        NUSCENES.encode(every)


def test_kitti360_merges_only_motorcyclists_and_trunks() -> None:
    back = KITTI360.decode(KITTI360.encode(np.arange(19, dtype=np.uint8)))
    assert {NAMES[i] for i in range(19) if back[i] != i} == {"motorcyclist", "trunk"}
    assert COLOURS.shape == (19, 3) and len({tuple(c) for c in COLOURS}) == 19


@pytest.mark.parametrize("kind", [DataError, ConfigError, FileError, LibraryError])
def test_errors_state_input_expectation_and_hint_and_can_be_copied(kind: type) -> None:
    # As pickling would rebuild it.
    error = copy.copy(kind("a.bin is cut", "whole points", "Copy it again."))
    assert str(error) == "a.bin is cut; expected whole points. Copy it again."
    assert isinstance(error, LidarSynthError) and isinstance(
        error, ValueError | OSError
    )
