"""The bank of objects: what it takes from scans, and its objects pasted into others."""

from dataclasses import fields, replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from banks import add_stray
from box_scenes import CAR, HEIGHT, car, cast
from hypothesis import given
from pasting import assert_nothing_shares_a_ray

from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI, TRAIN_ID
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import KITTIObject, SemanticKITTI
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.overlap import count_overlapping, find_overlapping
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.town import Town
from lidar_synth.labels import ObjectBank, instances_of, objects_of, paste
from lidar_synth.labels.boxes import (
    box_frame,
    grow_box,
    join_boxes,
    turn_boxes,
)
from lidar_synth.labels.ground import ground_under
from lidar_synth.labels.merge import merge_scans


@pytest.fixture(scope="module")
def town() -> Town:
    return Town(3, scans=60)


@pytest.fixture(scope="module")
def scans(town: Town) -> list[Scan]:
    return [town[i] for i in (0, 25, 45)]


@pytest.fixture(scope="module")
def bank(scans: list[Scan]) -> ObjectBank:
    return ObjectBank.from_scans(scans, least=8)


@pytest.mark.slow
def test_objects_are_their_instances(scans: list[Scan], bank: ObjectBank) -> None:
    """The town's boxes are so tight that noise sticks out of them: they grow by a little, and hold
    nearly all of it."""
    assert len(bank) > 20 and (bank.counts >= 8).all()
    for index in range(len(bank)):
        found = bank[index]
        [scan] = [s for s in scans if s.id == found.scan.id]
        assert (
            scan.boxes is not None
            and scan.instance is not None
            and found.scan.boxes is not None
        )
        box = scan.boxes.values[bank.number[index]]
        instance = scan.instance == scan.boxes.instance[bank.number[index]]
        assert found.scan.boxes.contain(found.scan.points).all()
        assert (found.box[3:6] >= box[3:6]).all() and (
            found.box[3:6] - box[3:6]
        ).max() < 0.35
        assert np.isin(
            found.scan.points[:, 0].round(3), scan.points[instance][:, 0].round(3)
        ).all()
        assert len(found.scan) >= 0.7 * instance.sum()


@pytest.mark.parametrize("scans", [None, [0]])
def test_objects_are_not_of_a_path(scans: list[int] | None) -> None:
    with pytest.raises(ConfigError, match="str as a source of scans"):
        ObjectBank.from_scans("scans", scans=scans)  # type: ignore[arg-type]


def test_a_bank_with_a_stray_array_is_read(bank: ObjectBank, tmp_path: Path) -> None:
    bank.save(tmp_path / "objects.npz")
    add_stray(tmp_path / "objects.npz")
    assert len(ObjectBank.load(tmp_path / "objects.npz")) == len(bank)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points", np.inf),
        ("points", 1e30),
        ("ground", np.nan),
        ("reflectance", -5),
        ("label", 19),
        ("box_values", 1e30),
    ],
)
def test_a_bank_with_values_that_no_scan_may_hold_is_refused(
    bank: ObjectBank, tmp_path: Path, name: str, value: float
) -> None:
    bank.save(tmp_path / "objects.npz")
    arrays = dict(np.load(tmp_path / "objects.npz"))
    arrays[name].flat[3] = value
    np.savez(tmp_path / "objects.npz", **arrays)
    with pytest.raises(DataError, match=r"objects\.npz.*a bank of objects"):
        ObjectBank.load(tmp_path / "objects.npz")


def test_a_bank_of_other_types_is_refused(bank: ObjectBank) -> None:
    with pytest.raises(DataError, match="float64"):
        replace(bank, reflectance=bank.reflectance.astype(np.float64))


def test_a_bank_survives_the_disk(bank: ObjectBank, tmp_path: Path) -> None:
    bank.save(tmp_path / "objects.npz")
    again = ObjectBank.load(tmp_path / "objects.npz")
    assert (
        repr(again) == repr(bank)
        and again.sensor == bank.sensor
        and again.boxes.names == bank.boxes.names
    )
    for name in {f.name for f in fields(bank)} - {"sensor", "boxes"}:
        a = getattr(again, name)
        b = getattr(bank, name)
        assert a.dtype == b.dtype and np.array_equal(a, b)
    assert np.array_equal(again.boxes.occlusion, bank.boxes.occlusion)
    content = (tmp_path / "objects.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    with pytest.raises(DataError, match=r"cut\.npz.*expected arrays of numbers"):
        ObjectBank.load(tmp_path / "cut.npz")
    wanted = r"other\.npz.*a bank of objects \(lidar-synth-objects/2\)"
    with pytest.raises(DataError, match=wanted):
        ObjectBank.load(tmp_path / "other.npz")
    with pytest.raises(FileError, match="nowhere"):
        ObjectBank.load(tmp_path / "nowhere.npz")
    with pytest.raises(DataError, match="label has shape"):
        replace(bank, label=bank.label[1:])
    with pytest.raises(IndexError, match=f"object {len(bank)} of"):
        bank[len(bank)]


def test_a_bank_of_version_1_has_no_rings(bank: ObjectBank, tmp_path: Path) -> None:
    bank.save(tmp_path / "objects.npz")
    arrays = dict(np.load(tmp_path / "objects.npz"))
    del arrays["ring"]
    arrays["format"] = np.array("lidar-synth-objects/1")
    np.savez(tmp_path / "objects.npz", **arrays)
    old = ObjectBank.load(tmp_path / "objects.npz")
    assert old == replace(bank, ring=None) != bank and old[0].scan.ring is None


def test_a_raised_object_is_seen_by_the_lasers_of_its_new_place() -> None:
    scan = cast([car(9, 3)])
    [found] = objects_of(replace(scan, ring=assign_beams(scan).ring)).values()
    host = cast(ground=0.4 - HEIGHT)
    host.ring = assign_beams(host).ring
    pasted = paste(host, [found])
    assert (pasted.instance == 1).sum() > 50
    assert np.array_equal(pasted.ring, assign_beams(pasted).ring)


def test_a_bank_needs_boxes_and_one_sensor() -> None:
    with pytest.raises(DataError, match="no box with 5 points in 1 scans"):
        ObjectBank.from_scans([cast()])
    with pytest.raises(DataError, match="has no boxes"):
        objects_of(replace(cast(), boxes=None))
    mixed = [cast([car(8, 3)]), cast([car(8, 3)], sensor=presets()["os1_128"])]
    with pytest.raises(DataError, match=r"sensors \['os1_128', 'town'\]"):
        ObjectBank.from_scans(mixed)
    for wrong in ("folder", mixed[0]):
        with pytest.raises(ConfigError, match="as a source of scans"):
            ObjectBank.from_scans(wrong)  # type: ignore[arg-type]


def test_without_instances_an_object_is_what_stands_in_its_box() -> None:
    scan = cast([car(9, 3)])
    scan.boxes.values[0, 3:6] += 0.4  # as people draw them, with some road
    none = np.zeros(len(scan), np.int32)
    for bare in (
        replace(scan, instance=None),
        replace(scan, instance=none),
        replace(scan, instance=None, label=None),
    ):
        tracked = merge_scans(bare, []).instance == 1
        assert tracked.sum() == len(objects_of(bare)[0].scan)
        [found] = objects_of(bare).values()
        assert (found.scan.label == CAR).all()
        above = scan.points[scan.instance == 1][:, 2] > -HEIGHT + 0.1
        assert len(found.scan) == pytest.approx(above.sum(), rel=0.02)
        assert found.ground == pytest.approx(-HEIGHT, abs=0.02)
    scan.boxes = Boxes(scan.boxes.values, ("Misc",))
    [found] = objects_of(replace(scan, label=None)).values()
    assert (found.scan.label == IGNORE).all()


@pytest.mark.parametrize("by_class", [False, True])
def test_instances_serve_where_there_are_no_boxes(by_class: bool) -> None:
    """A parked car and a moving one may both be number 1 in a file of SemanticKITTI."""
    scan = replace(cast([car(9, 3), car(14, -5), car(40, 20)]), boxes=None)
    sizes = [(scan.instance == i).sum() for i in (1, 2, 3)]
    if by_class:
        moving = np.where(scan.instance == 2, 252, SEMANTIC_KITTI.encode(scan.label))
        scan.instance[scan.instance == 2] = 1
        raw = moving.astype(np.uint32) | scan.instance.astype(np.uint32) << 16
        scan.raw_label = raw
    found = instances_of(scan, least=20)
    assert sorted(len(o.scan) for o in found) == sorted(sizes)
    _, counts = np.unique(merge_scans(cast(), [scan]).instance, return_counts=True)
    assert sorted(counts[1:]) == sorted(sizes)
    pasted = paste(cast(), [o.turned(1.0) for o in found])
    assert pasted.boxes is not None and len(pasted.boxes) == 3
    assert_nothing_shares_a_ray(pasted, 1)
    assert instances_of(cast()) == []
    with pytest.raises(DataError, match="has no instances"):
        instances_of(replace(scan, instance=None))


@pytest.mark.parametrize("bare", [False, True])
def test_town_objects_in_a_town_scan(town: Town, bank: ObjectBank, bare: bool) -> None:
    host = town[32]
    if bare:
        host = replace(
            host, label=None, instance=None, boxes=None, raw_label=None, ring=None
        )
    rng = np.random.default_rng(5)
    first = (
        1
        if host.boxes is None
        else int(max(host.instance.max(), host.boxes.instance.max())) + 1
    )
    angles = rng.uniform(-np.pi, np.pi, len(bank))
    pasted = paste(
        host,
        [
            bank[i].turned(a)
            for i, a in zip(rng.permutation(len(bank)), angles, strict=True)
        ],
        count=12,
    )
    assert pasted.boxes is not None and (pasted.boxes.instance >= first).sum() >= 4
    assert_nothing_shares_a_ray(pasted, first)
    new = pasted.boxes[pasted.boxes.instance >= first]
    for box in new.values:
        ground = ground_under(host, box)
        assert ground is not None and abs(box[2] - box[5] / 2 - ground.height) < 0.35
    if bare:  # the objects' labels do not tell where the ground is
        unlabelled = replace(pasted, label=None)
        assert [ground_under(pasted, box) for box in pasted.boxes.values] == [
            ground_under(unlabelled, box) for box in pasted.boxes.values
        ]


@pytest.mark.slow
def test_real_objects_in_town_scans(real_scans: Path, town: Town) -> None:
    bank = ObjectBank.from_scans(KITTIObject(real_scans / "kitti_object", "trainval"))
    assert set(bank.boxes.names) >= {"Car", "Pedestrian", "Cyclist", "Van", "Truck"}
    assert set(bank.label.tolist()) <= {
        TRAIN_ID[n] for n in ("car", "truck", "person", "bicyclist")
    } | {IGNORE}
    placed = 0
    for index in (5, 32):
        host = replace(
            town[index], boxes=None, instance=None, raw_label=None, ring=None
        )
        rng = np.random.default_rng(index)
        pasted = paste(
            host,
            [bank[i].turned(rng.uniform(-3, 3)) for i in rng.permutation(len(bank))],
        )
        assert pasted.boxes is not None
        assert_nothing_shares_a_ray(pasted, 1)
        placed += len(pasted.boxes)
    assert placed >= 5


def test_real_instances_in_town_scans(real_scans: Path, town: Town) -> None:
    scan = SemanticKITTI(real_scans / "semantic_kitti", split="train")[0]
    pasted = paste(
        replace(town[5], boxes=None), [o.turned(0.5) for o in instances_of(scan, 20)]
    )
    assert pasted.boxes is not None and len(pasted.boxes) >= 2
    assert_nothing_shares_a_ray(pasted, int(town[5].instance.max()) + 1)


@given(st.integers(0, 200))
def test_boxes_overlap_where_a_point_lies_in_both(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = np.c_[
        rng.uniform(-4, 4, (5, 2)),
        np.zeros(5),
        rng.uniform(1, 6, (5, 2)),
        np.ones(5),
        rng.uniform(-4, 4, 5),
    ]
    values = values.astype(np.float32)
    grid = np.stack(
        np.meshgrid(np.linspace(-8, 8, 161), np.linspace(-8, 8, 161)), -1
    ).reshape(-1, 2)
    inside = Boxes(values, ("Car",) * 5).contain(
        np.c_[grid, np.zeros(len(grid))].astype(np.float32)
    )
    both = (inside[0] & inside[1:]).any(1)
    found = find_overlapping(values[0], values[1:])
    assert (both <= found).all()
    smaller = values[1:] - np.array([0, 0, 0, 0.4, 0.4, 0, 0], np.float32)
    assert (
        find_overlapping(values[0], smaller) <= both
    ).all()  # a corner may lie between the grid's points


def test_a_car_with_a_box_at_each_place_of_its_way_is_counted() -> None:
    """Four boxes 2 m apart along a way, a car parked 2.2 m beside it, and a van at the same place
    as that car."""
    rows = [[x, 0, 0, 4, 2, 1.5, 0] for x in (0, 2, 4, 6)]
    rows += [[2, 2.2, 0, 4, 2, 1.5, 0]] * 2
    names = ("Car",) * 5 + ("Van",)
    boxes = Boxes(np.array(rows, np.float32), names)
    assert count_overlapping(boxes) == 4
    assert count_overlapping(boxes[[0, 2, 4, 5]]) == 0


def test_boxes_grow_no_more_than_they_have_to() -> None:
    box = car(5, 5, 0.5)
    corners = Boxes(box, ("Car",)).corners()[0]
    assert np.allclose(grow_box(box, corners[:0]), box)
    out = box[:3] + (corners - box[:3]) * np.float32(1.02)
    larger = grow_box(box, out)
    assert Boxes(larger, ("Car",)).contain(out).all()
    assert np.allclose(larger[3:6], 1.02 * box[3:6] + 0.002, atol=1e-4)
    assert np.allclose(np.abs(box_frame(corners, box)), box[3:6] / 2, atol=1e-5)
    two = join_boxes([Boxes(box, ("Car",)), turn_boxes(Boxes(box, ("Van",)), 0.3)])
    assert two.names == ("Car", "Van") and two.values[1, 6] == pytest.approx(0.8)
