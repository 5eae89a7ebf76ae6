"""Whatever a writer takes, the reader of its format takes, and finds what was written."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing.checks import flaws
from layouts import some_boxes, some_scan
from roundtrips import back

from lidar_synth.errors import DataError, LidarSynthError
from lidar_synth.formats import WRITERS
from lidar_synth.formats.kitti360_boxes import read_boxes, write_boxes
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import CAUSES, Boxes, Scan

LOSSLESS = ("npz", "pcd", "ply", "webdataset", "mcap")
"""Formats that keep every field of a point."""

WRONG: dict[str, list[Any]] = {
    "points": [np.nan, np.inf, -np.inf, 1e30, 2e5, 1e300],
    "reflectance": [np.nan, -0.01, 1.01, 255, 1e30],
    "label": [19, 254, 261, -1, 1 << 40],
    "raw_label": [-1, 1 << 32, 300, (1 << 16) + 10],
    "instance": [-1, 1 << 16, (1 << 32) + 7, 1 << 31],
    "ring": [70_000, -1, 1 << 15],
    "confidence": [np.nan, -0.1, 1.5],
    "time": [np.nan, np.inf, 1e30, 61.0],
}
"""Values that a field can, or cannot, hold."""

KINDS = ("f8", "i8", "u1", "f4", "i4", "bool", "complex128", "U8", "O")


def complete() -> Scan:
    """A scan with every field of a point."""
    scan = some_scan(count=80)
    rng = np.random.default_rng(0)
    ring = rng.integers(0, 64, len(scan)).astype(np.int16)
    time, confidence = rng.uniform(-0.1, 0.1, (2, len(scan))).astype(np.float32)
    cause = rng.integers(0, len(CAUSES), len(scan)).astype(np.uint8)
    confidence = np.abs(confidence)
    return replace(scan, ring=ring, time=time, confidence=confidence, cause=cause)


def changed(scan: Scan, **fields: Any) -> Scan:
    """The scan with fields that are set after it was made, which nothing has checked yet."""
    scan = copy(scan)
    vars(scan).update(fields)
    return scan


def with_value(scan: Scan, name: str, value: Any) -> Scan:
    """The scan with one value of a field replaced, in a type that holds it."""
    values = getattr(scan, name)
    wide = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
    wide[len(wide) // 2] = value
    return changed(scan, **{name: wide})


def distorted(rng: np.random.Generator) -> Scan:
    """A scan with a few faults, of which some are none for some formats."""
    scan = complete()
    names = [n for n in WRONG if rng.random() < 0.7]
    scan = replace(
        scan, **{n: None for n in WRONG if n not in ("points", "reflectance", *names)}
    )
    for _ in range(rng.integers(1, 3)):
        scan = FAULTS[rng.integers(len(FAULTS))](scan, rng)
    return scan


def _value(scan: Scan, rng: np.random.Generator) -> Scan:
    known = [
        n
        for n in WRONG
        if getattr(scan, n) is not None
        and getattr(scan, n).dtype.kind in "iuf"
        and len(scan)
    ]
    name = known[rng.integers(len(known))] if known else "points"
    return (
        with_value(scan, name, WRONG[name][rng.integers(len(WRONG[name]))])
        if known
        else scan
    )


def _kind(scan: Scan, rng: np.random.Generator) -> Scan:
    name = list(WRONG)[rng.integers(len(WRONG))]
    values = getattr(scan, name)
    return (
        scan
        if values is None
        else changed(scan, **{name: values.astype(KINDS[rng.integers(len(KINDS))])})
    )


def _empty(scan: Scan, rng: np.random.Generator) -> Scan:
    return scan[:0]


def _out_of_view(scan: Scan, rng: np.random.Generator) -> Scan:
    return replace(scan, points=scan.points * np.float32(1e3))


def _pose(scan: Scan, rng: np.random.Generator) -> Scan:
    poses = (
        np.full((4, 4), np.nan),
        np.eye(3),
        2 * np.eye(4),
        np.diag([1.0, 1, -1, 1]),
        np.eye(4) * 1j,
        np.eye(4)[:3],
    )
    return changed(scan, pose=poses[rng.integers(len(poses))])


def _boxes(scan: Scan, rng: np.random.Generator) -> Scan:
    boxes = some_boxes(count=3)
    names = [
        "Car",
        ("Person (sitting)", "", "a b", "DontCare", "-", "x\ny", "Bus", "Voiture é")[
            rng.integers(8)
        ],
        "Van",
    ]
    instance = np.array(
        [0, (1 << 31) - 1, -5, 26_001, 999_999][rng.integers(5)], np.int32
    ) + np.zeros(3, np.int32)
    occlusion = np.full(3, rng.integers(-3, 6), np.int8)
    truncation = np.full(3, (-1, 0.5, 7, -9)[rng.integers(4)], np.float32)
    image_box = np.full((3, 4), (-1, 0, 1e9)[rng.integers(3)], np.float32)
    fields = {
        "instance": instance,
        "occlusion": occlusion,
        "truncation": truncation,
        "image_box": image_box,
    }
    return replace(scan, boxes=Boxes(boxes.values, tuple(names), **fields))


def _origin(scan: Scan, rng: np.random.Generator) -> Scan:
    wrong: list[Any] = [
        {"seed": np.int64(3)},
        {"seed": np.nan},
        {"a": [1]},
        {1: "a"},
        {"a": "x" * 10**5},
    ]
    return replace(
        scan,
        domain=int(rng.integers(-1, 3)),
        provenance=wrong[rng.integers(len(wrong))],
    )


FAULTS: list[Callable[[Scan, np.random.Generator], Scan]] = [
    *[_value] * 4,
    *[_kind] * 2,
    _empty,
    _out_of_view,
    _pose,
    *[_boxes] * 2,
    _origin,
]


def check_read(to: str, root: Path, scan: Scan) -> None:
    """Read back what was written, and compare it."""
    source = back(to, root)
    found = source[0]
    assert not list(flaws(found))
    if to in LOSSLESS:
        for name, values in scan.fields().items():
            assert np.array_equal(getattr(found, name), values), name
        assert np.array_equal(found.points, scan.points.astype(np.float32))
    elif to not in ("png", "range", "cosmos"):
        assert np.array_equal(found.points, scan.points.astype(np.float32))
    else:
        assert len(found) == project(found).mask.sum() > 0
    if scan.boxes is not None and to in ("npz", "range"):
        assert found.boxes is not None and found.boxes.names == scan.boxes.names


@pytest.mark.parametrize("to", WRITERS)
def test_what_is_written_is_read(to: str, tmp_path: Path) -> None:
    taken = refused = 0
    for case in range(120):
        writer = WRITERS[to](tmp_path / str(case))  # type: ignore[call-arg]
        try:
            scan = distorted(np.random.default_rng(case))
            writer.write(scan, 0)
        except LidarSynthError:
            refused += 1
            assert not writer.complete(0)
            continue
        writer.finish()
        taken += 1
        check_read(to, tmp_path / str(case), scan)
    assert taken > 5 and refused > 50


@pytest.mark.parametrize("to", WRITERS)
@pytest.mark.parametrize(
    "fault",
    [
        lambda scan: with_value(scan, "points", np.nan),
        lambda scan: with_value(scan, "points", 1e30),
        lambda scan: with_value(scan, "label", 261),
        lambda scan: with_value(scan, "instance", (1 << 32) + 7),
        lambda scan: with_value(scan, "ring", 70_000),
        lambda scan: with_value(scan, "time", 1e30),
        lambda scan: scan[:0],
    ],
    ids=[
        "nan",
        "1e30 m",
        "label 261",
        "instance 2^32 + 7",
        "ring 70,000",
        "time 1e30",
        "empty",
    ],
)
def test_no_writer_takes_what_readers_refuse(
    to: str, fault: Callable[[Scan], Scan], tmp_path: Path
) -> None:
    writer = WRITERS[to](tmp_path)  # type: ignore[call-arg]
    with pytest.raises(DataError):
        writer.write(fault(complete()), 0)
    assert not writer.complete(0)


def test_labels_of_another_integer_type_become_pictures(tmp_path: Path) -> None:
    scan = some_scan()
    assert scan.label is not None
    for kind in (np.int64, np.uint8):
        WRITERS["png"](tmp_path / str(kind)).write(
            replace(scan, label=scan.label.astype(kind)), 0
        )  # type: ignore[call-arg]
    wide, own = (back("png", tmp_path / str(kind))[0] for kind in (np.int64, np.uint8))
    assert np.array_equal(wide.label, own.label)  # type: ignore[arg-type]


def test_an_odd_timestamp_in_existing_boxes_is_named(tmp_path: Path) -> None:
    path = tmp_path / "drive.xml"
    path.write_text("<a><object0><timestamp>soon</timestamp></object0></a>")
    with pytest.raises(DataError, match="soon.*data_3d_bboxes"):
        write_boxes(path, {0: (some_boxes(), np.eye(4))})


@pytest.mark.parametrize("known", [(), (1, 2), (26_001, 26_004), (5_001, 999)])
def test_a_kitti360_box_of_unknown_instance_gets_a_free_one(
    tmp_path: Path, known: tuple[int, ...]
) -> None:
    instance = np.int32((-1, -1, -1, -1, *known))
    names = ("Car", "Tram", "Car", "Car", "Car", "Tram")[: len(instance)]
    values = np.tile(np.float32([10, 2, -1, 4, 2, 1.6, 0]), (len(instance), 1))
    path = tmp_path / "drive.xml"
    write_boxes(path, {0: (Boxes(values, names, instance=instance), np.eye(4))})
    read = read_boxes(path).instances.tolist()
    assert len(set(read)) == len(instance)
    assert all(each // 1000 in (26, 31) for each in read[:4])
    assert [each % 1000 for each in read[4:]] == [each % 1000 for each in known]


def test_boxes_are_no_larger_than_a_lidar_sees() -> None:
    with pytest.raises(DataError, match=r"1e\+30"):
        Boxes(np.array([[10, 2, -1, 4, 1e30, 1.6, 0]], np.float32), ("Car",))
