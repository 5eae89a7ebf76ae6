"""Damaged files and impossible values in each format: each is refused by the name of its file."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import MAKERS, some_scan, write_all

from lidar_synth.errors import DataError
from lidar_synth.formats import RangeImages, open_scans
from lidar_synth.geometry.scan import Boxes
from lidar_synth.geometry.sensor import Sensor

DRIVE = "data_poses/2013_05_28_drive_0000_sync/poses.txt"


@pytest.mark.parametrize(
    ("layout", "file", "text", "message"),
    [
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car 0 0 1",
            "a line with 4 fields; expected 15 fields",
        ),
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car " + "x " * 14,
            "could not convert.*15 fields",
        ),
        (
            "kitti_object",
            "training/calib/000000.txt",
            "P2: 1 2 3",
            "has .*'P2': 3.*expected P2 with 12",
        ),
        (
            "semantic_kitti",
            "sequences/00/poses.txt",
            "1 0 0",
            "does not hold rows of 12 numbers",
        ),
        (
            "kitti360",
            "data_poses/2013_05_28_drive_0000_sync/poses.txt",
            "0 one",
            "does not hold rows of 13 numbers",
        ),
        (
            "kitti360",
            "calibration/perspective.txt",
            "P_rect_00: 1",
            "KeyError.*expected P_rect_00, R_rect_00",
        ),
        (
            "kitti360",
            "data_3d_bboxes/train/2013_05_28_drive_0000_sync.xml",
            "<a><b>",
            "no element|mismatched|unclosed",
        ),
        (
            "kitti_raw",
            "2011_09_26/2011_09_26_drive_0001_sync/tracklet_labels.xml",
            "<a>",
            "no element|tracklet",
        ),
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car 0 0 " + "nan " * 12,
            "line 1 has the values .*finite",
        ),
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car 0 9 " + "1 " * 12,
            "occlusion of 0 to 3",
        ),
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car 0 0 " + "0 " * 12,
            "a size above 0",
        ),
        (
            "kitti_object",
            "training/label_2/000000.txt",
            "Car 0 0 " + "1e30 " * 12,
            "finite numbers",
        ),
        (
            "semantic_kitti",
            "sequences/00/poses.txt",
            "1 0 0 0 0 2 0 0 0 0 1 0",
            "1 of 1 transforms are not rigid",
        ),
        ("semantic_kitti", "sequences/00/poses.txt", "inf " * 12, "not rigid"),
        (
            "semantic_kitti",
            "sequences/00/poses.txt",
            "1 0 0 0 0 1 0 0 0 0 1 0 " * 2,
            "rows of 12 numbers",
        ),
        (
            "semantic_kitti",
            "sequences/00/calib.txt",
            f"P2: {'1 ' * 12}\nTr: {'1 ' * 12}",
            "not rigid",
        ),
        ("kitti360", DRIVE, "7 " + "nan " * 12, "not rigid"),
        (
            "kitti360",
            DRIVE,
            "7.5 1 0 0 0 0 1 0 0 0 0 1 0",
            "invalid or repeated frame numbers",
        ),
        (
            "kitti360",
            DRIVE,
            "7 1 0 0 0 0 1 0 0 0 0 1 0\n" * 2,
            "invalid or repeated frame numbers",
        ),
        (
            "kitti360",
            "calibration/calib_cam_to_pose.txt",
            "image_00: " + "1 " * 11,
            "'image_00': 11",
        ),
        (
            "kitti360",
            "calibration/calib_cam_to_velo.txt",
            "1 0 0 0 0 1 0 0 0 0 0 0",
            "cam_to_velo: .*not rigid",
        ),
    ],
)
def test_damaged_text_files_are_named(
    tmp_path: Path, layout: str, file: str, text: str, message: str
) -> None:
    MAKERS[layout](tmp_path)
    assert (tmp_path / file).is_file()
    (tmp_path / file).write_text(text)
    folder = (
        Path(file).parent.name if file.startswith("calibration") else Path(file).name
    )
    with pytest.raises(DataError, match=f"{folder}.*({message})"):
        open_scans(tmp_path, layout=layout)[0]


@pytest.mark.parametrize(
    ("layout", "file", "old", "new", "message"),
    [
        (
            "kitti_raw",
            "tracklet_labels.xml",
            "<boost",
            '<?xml version="1.0" encoding="x"?><boost',
            "unknown encoding",
        ),
        (
            "kitti_raw",
            "tracklet_labels.xml",
            "<tx>10</tx>",
            "<tx>1e400</tx>",
            "a box of frame 1 with .*inf",
        ),
        (
            "kitti_raw",
            "tracklet_labels.xml",
            "<h>1.2</h>",
            "<h>0</h>",
            "size that is not positive",
        ),
        ("kitti360", "*.xml", "encoding='utf-8'", "encoding='x'", "unknown encoding"),
        (
            "kitti360",
            "*.xml",
            "<instanceId>",
            "<instanceId>99999999999",
            "greater than maximum",
        ),
        ("kitti360", "*.xml", "<data>", "<data>nan ", "cannot reshape|no boxes"),
        ("kitti_object", "calib/000000.txt", "R0_rect: 1", "R0_rect: 2", "not rigid"),
        (
            "kitti_object",
            "calib/000000.txt",
            "R0_rect: 1.0",
            "R0_rect: nan 1.0",
            "'R0_rect': 10",
        ),
    ],
)
def test_a_changed_value_is_refused_by_the_name_of_its_file(
    tmp_path: Path, layout: str, file: str, old: str, new: str, message: str
) -> None:
    MAKERS[layout](tmp_path)
    [path, *_] = sorted(tmp_path.rglob(file))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=f"{re.escape(path.name)}.*({message})"):
        list(open_scans(tmp_path, layout=layout))


def test_an_image_of_size_zero_is_refused(tmp_path: Path) -> None:
    """A camera's size comes from its picture's header, and a black picture of that size is written
    where none is."""
    write_all("kitti_object", tmp_path, [some_scan()])
    path = tmp_path / "training" / "image_2" / "000000.png"
    content = path.read_bytes()
    camera = open_scans(tmp_path).calibration(0)
    assert camera is not None and camera.image_size == (1242, 375)
    for width in (0, 2**31):
        path.write_bytes(content[:16] + width.to_bytes(4, "big") + content[20:])
        camera = open_scans(tmp_path).calibration(0)
        assert camera is not None and camera.image_size is None


def test_names_of_frames_stay_in_their_folder(tmp_path: Path) -> None:
    MAKERS["kitti_object"](tmp_path)
    (tmp_path / "ImageSets" / "train.txt").write_text("000000\n../velodyne/000001\n")
    with pytest.raises(
        DataError,
        match=r"train.txt lists '../velodyne/000001'; expected names of frames",
    ):
        open_scans(tmp_path, split="train")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("confidence", 1.5, "confidence from .* to 1.5"),
        ("confidence", np.nan, "confidence from nan"),
        ("pose", np.eye(4) * 2, "its pose: 1 of 1 transforms are not rigid"),
    ],
)
@pytest.mark.parametrize("to", ["npz", "range", "webdataset"])
def test_impossible_values_of_a_scan_are_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    to: str,
    name: str,
    value: Any,
    message: str,
) -> None:
    # Another program's file.
    monkeypatch.setattr(
        "lidar_synth.formats.writer.check_scan", lambda scan, where: None
    )
    scan = some_scan()
    scan.confidence = np.ones(len(scan), np.float32)
    if name == "pose":
        scan.pose = value
    else:
        scan.confidence[:] = value
    write_all(to, tmp_path, [scan])
    with pytest.raises(DataError, match=message):
        open_scans(tmp_path)[0]


@pytest.mark.parametrize("name", ["truncation", "image_box", "alpha", "dont_care"])
def test_boxes_with_invalid_numbers_are_refused(name: str) -> None:
    with pytest.raises(DataError, match="non-finite"):
        Boxes(
            np.ones((1, 7)),
            ("Car",),
            **{name: np.full((1, 4) if "_" in name else 1, np.nan)},
        )


def test_cells_without_a_return_may_hold_anything(tmp_path: Path) -> None:
    """Others' range images have -1 or 255 there; cells with a return are checked."""
    sensor = Sensor("small", 4, 1, 80, rows=2, fov_up=3, fov_down=-25)
    image = np.stack([[[5, 0, 5, 5]] * 2, [[0.5, -1, 1, 0]] * 2]).astype("f4")
    np.save(tmp_path / "image.npy", image)
    found = RangeImages(tmp_path, sensor=sensor).image(0).reflectance
    assert found is not None and found.tolist() == [[0.5, 0, 1, 0]] * 2
    image[1, 0, 2] = 64.5
    np.save(tmp_path / "image.npy", image)
    with pytest.raises(
        DataError, match=r"image.npy: reflectance from 0.0 to 64.5; expected 0 to 1"
    ):
        RangeImages(tmp_path, sensor=sensor).image(0)


@pytest.mark.parametrize("kind", ["npz", "npy", "pcd", "ply", "png", "mcap"])
def test_damaged_files_with_a_header(tmp_path: Path, kind: str) -> None:
    scan = some_scan()
    if kind == "npy":
        path = tmp_path / "scan.npy"
        np.save(path, np.column_stack([scan.points, scan.reflectance]))
    else:
        [path] = write_all(kind, tmp_path, [scan])
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"not what the name says"):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=re.escape(path.name)):
            open_scans(path)[0]


def test_arrays_that_are_not_scans_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.npz"
    scan = some_scan()
    write_all("npz", tmp_path, [scan])
    good = dict(np.load(tmp_path / "000000.npz"))
    for change, message in (
        ({"points": good["points"].astype(str)}, "points is <U32; expected numbers"),
        ({"label": good["label"] + 0.5}, "whole numbers that uint8 can hold"),
        ({"points": np.where(np.arange(3) == 1, np.nan, good["points"])}, "NaN"),
        ({"reflectance": good["reflectance"] * 255}, r"expected values in \[0, 1\]"),
        ({"reflectance": good["reflectance"][1:]}, "one per point"),
        ({"sensor": np.array("{}")}, "sensor|missing"),
        (
            {"label": np.full(len(scan), 19, "u1")},
            r"labels \[19\]; expected train ids 0..18",
        ),
    ):
        np.savez(path, **(good | change))
        with pytest.raises(DataError, match=f"scan.npz.*{message}"):
            open_scans(path)[0]
    np.savez(
        path, **{name: values for name, values in good.items() if name != "sensor"}
    )
    with pytest.raises(
        DataError, match="scan.npz: it has no sensor: give one, --sensor"
    ):
        open_scans(path)[0]
    assert len(open_scans(path, sensor="hdl64e_kitti")[0]) == len(scan)
    np.savez(path, points=good["points"], intensity=good["reflectance"])
    with pytest.raises(DataError, match="holds points, intensity; expected points, re"):
        open_scans(path, sensor="hdl64e_kitti")[0]
    np.savez(path, points=np.array([{"a": 1}], object), reflectance=[0])
    with pytest.raises(DataError, match="none of them pickled"):
        open_scans(path)[0]


def test_arrays_of_other_types_are_converted(tmp_path: Path) -> None:
    scan = some_scan()
    assert scan.label is not None
    grey = np.round(scan.reflectance * 255).astype(np.uint8)
    np.savez(
        tmp_path / "a.npz",
        points=scan.points.astype(np.float64),
        reflectance=grey,
        label=scan.label.astype(np.int64),
    )
    read = open_scans(tmp_path, sensor=scan.sensor, reflectance_max=255)[0]
    assert read.points.dtype == np.float32 and np.array_equal(read.points, scan.points)
    assert np.allclose(read.reflectance, grey / 255)
    assert read.label is not None and read.label.dtype == np.uint8
    assert np.array_equal(read.label, scan.label)


def test_a_range_image_of_another_sensor(tmp_path: Path) -> None:
    for to in ("range", "png"):
        write_all(to, tmp_path / to, [some_scan()])
        with pytest.raises(
            DataError, match="made for sensor 'hdl64e_kitti', not for 'os1_128'"
        ):
            open_scans(tmp_path / to, sensor="os1_128")[0]
    np.save(tmp_path / "image.npy", np.ones((32, 1024), "f4"))
    with pytest.raises(DataError, match=r"shape \(32, 1024\); expected \(64, 1024\)"):
        open_scans(tmp_path / "image.npy", sensor="hdl64e_kitti")[0]


@pytest.mark.parametrize("unit", [1000, 500, 100])
def test_a_range_image_in_another_unit(tmp_path: Path, unit: int) -> None:
    distance = unit * np.random.default_rng(0).uniform(2, 60, (64, 1024))
    np.save(tmp_path / "image.npy", distance.astype(np.uint16))
    with pytest.raises(DataError, match="exceed the 80 m of 'hdl64e_kitti'.*unit"):
        open_scans(tmp_path / "image.npy", sensor="hdl64e_kitti")[0]


def test_points_with_many_columns_are_no_image(tmp_path: Path) -> None:
    scan = some_scan()
    points = np.column_stack([scan.points, scan.reflectance, *[scan.reflectance] * 60])
    np.save(tmp_path / "a.npy", points[:, :9])
    assert np.array_equal(open_scans(tmp_path)[0].points, scan.points)
    np.save(tmp_path / "a.npy", points)
    with pytest.raises(DataError, match=r"\(566, 64\); expected .*--layout folder"):
        open_scans(tmp_path)[0]
    assert len(open_scans(tmp_path, layout="folder")[0]) == len(scan)
