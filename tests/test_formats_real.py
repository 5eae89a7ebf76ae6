"""Readers and writers on real scans: what the datasets' own files hold, and that nothing is lost on
the way back."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import (
    KITTI360,
    WRITERS,
    KITTIObject,
    KITTIRaw,
    NuScenes,
    SemanticKITTI,
    open_scans,
)
from lidar_synth.formats.kitti360 import SPLITS
from lidar_synth.formats.kitti_labels import boxes_to_camera
from lidar_synth.formats.range_images import RangeImages
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Boxes, Scan

DRIVE = "2013_05_28_drive_0000_sync"


def scan_files(real: Path) -> Iterator[tuple[str, Scan]]:
    """(path in the manifest, scan) of every scan in a dataset's own format."""
    for scan in KITTI360(real / "kitti360", sensor="hdl64e_kitti360"):
        drive, frame = scan.id.split("/")
        yield f"kitti360/data_3d_raw/{drive}/velodyne_points/data/{frame}.bin", scan
    for scan in SemanticKITTI(real / "semantic_kitti"):
        sequence, frame = scan.id.split("/")
        yield f"semantic_kitti/sequences/{sequence}/velodyne/{frame}.bin", scan
    for folder, reduced in (("velodyne", False), ("velodyne_reduced", True)):
        for scan in KITTIObject(real / "kitti_object", reduced=reduced):
            part, frame = scan.id.split("/")
            yield f"kitti_object/{part}/{folder}/{frame}.bin", scan
    for scan in KITTIRaw(real / "kitti_raw"):
        drive, frame = scan.id.split("/")
        yield f"kitti_raw/{drive[:10]}/{drive}/velodyne_points/data/{frame}.bin", scan


def facts(scan: Scan) -> dict[str, float]:
    """The columns of the manifest, from a scan as it was read."""
    x, y, z = scan.points.astype(np.float64).T
    distance = np.sqrt(x * x + y * y + z * z)
    elevation = np.degrees(np.arcsin(z / distance))
    return {
        "points": len(scan),
        "azimuth_degrees_covered": len(
            np.unique(np.floor(np.degrees(np.arctan2(y, x))) % 360)
        ),
        "elevation_min": elevation.min(),
        "elevation_max": elevation.max(),
        "elevation_p0.5": np.percentile(elevation, 0.5),
        "elevation_p99.5": np.percentile(elevation, 99.5),
        "range_min": distance.min(),
        "range_max": distance.max(),
        "reflectance_min": scan.reflectance.min(),
        "reflectance_max": scan.reflectance.max(),
        "reflectance_levels": len(np.unique(scan.reflectance)),
    }


def label_facts(scan: Scan) -> dict[str, float]:
    assert scan.raw_label is not None and scan.instance is not None
    return {
        "classes": len(np.unique(scan.raw_label & 0xFFFF)),
        "unlabelled_share": float(np.mean(scan.raw_label & 0xFFFF == 0)),
        "instances": len(np.unique(scan.instance[scan.instance > 0])),
    }


def test_every_scan_agrees_with_the_manifest(real_scans: Path) -> None:
    rows = {
        row["file"]: row for row in csv.DictReader((real_scans / "manifest.csv").open())
    }
    read = set()
    for path, scan in scan_files(real_scans):
        for column, value in facts(scan).items():
            assert value == pytest.approx(float(rows[path][column]), abs=0.0051), (
                f"{path}: {column}"
            )
        read.add(path)
        if scan.label is None:
            continue
        labels = path.replace("velodyne", "labels").replace(".bin", ".label")
        for column, value in label_facts(scan).items():
            assert value == pytest.approx(float(rows[labels][column]), abs=0.00051), (
                f"{labels}: {column}"
            )
        read.add(labels)
    # nuScenes' sweep is read without what stands at the sensor, so its row is checked below.
    assert read == {
        file
        for file in rows
        if file.endswith((".bin", ".label")) and not file.startswith("nuscenes")
    }


def test_every_dataset_is_recognised_by_its_root(real_scans: Path) -> None:
    found = {
        root.name: type(open_scans(root)).__name__
        for root in real_scans.iterdir()
        if root.is_dir()
    }
    assert found == {
        "kitti360": "KITTI360",
        "semantic_kitti": "SemanticKITTI",
        "kitti_object": "KITTIObject",
        "kitti_raw": "KITTIRaw",
        "nuscenes": "NuScenes",
    }
    assert isinstance(
        open_scans(real_scans / "semantic_kitti" / "range_images_64x1024"), RangeImages
    )
    assert isinstance(
        open_scans(real_scans / "nuscenes" / "range_images_32x1024"), RangeImages
    )


def test_kitti360_poses_are_those_of_camera_0(real_scans: Path) -> None:
    """poses.txt with the calibration has to agree with cam0_to_world.txt, which the dataset made
    from it."""
    source = KITTI360(real_scans / "kitti360")
    camera = source.calibration(0)
    assert camera is not None and camera.image_size == (1408, 376)
    lines = np.loadtxt(
        real_scans / "kitti360" / "data_poses" / DRIVE / "cam0_to_world.txt"
    )
    expected = {
        f"{DRIVE}/{int(line[0]):010d}": line[1:].reshape(4, 4) for line in lines
    }
    posed = [scan for scan in source if scan.pose is not None]
    assert {scan.id for scan in posed} == set(expected) and len(posed) == 11
    for scan in posed:
        assert scan.pose is not None
        np.testing.assert_allclose(
            scan.pose @ camera.sensor_from_camera, expected[scan.id], atol=2e-3
        )


def test_kitti360_points_fall_into_the_image(real_scans: Path) -> None:
    source = KITTI360(real_scans / "kitti360")
    for index, scan in enumerate(source):
        camera = source.calibration(index)
        assert (
            camera is not None
            and camera.image_size is not None
            and scan.image_path is not None
        )
        pixels, _ = camera.pixels(scan.points)
        inside = ((pixels >= 0) & (pixels < camera.image_size)).all(axis=1)
        assert 25_300 <= inside.sum() <= 27_900


@pytest.mark.parametrize(
    ("frame", "filled"),
    [
        (100, 11),
        (360, 5),
        (570, 1),
        (729, 3),
        (947, 8),
        (1134, 7),
        (1461, 10),
        (1597, 6),
        (1866, 0),
        (2449, 137),
        (2903, 3),
        (2939, 4),
    ],
)
def test_kitti360_boxes_of_cars_contain_their_points(
    real_scans: Path, frame: int, filled: int
) -> None:
    """The boxes there are corners in camera 0's frame, which the calibration has to bring into the
    sensor's."""
    source = KITTI360(real_scans / "kitti360")
    camera = source.calibration(0)
    assert camera is not None
    to_sensor = camera.matrices["cam_to_velo"].reshape(3, 4)
    objects = json.loads(
        (
            real_scans / "kitti360" / "bboxes_3D_cam0" / f"BBoxes_{frame}.json"
        ).read_text()
    )
    corners = (
        np.array([o["corners_cam0"] for o in objects]) @ to_sensor[:, :3].T
        + to_sensor[:, 3]
    )
    centre = corners.mean(axis=1)
    # The corners' principal axes are the box's: length first, then width, then height.
    _, _, axes = np.linalg.svd(corners - centre[:, None])
    size = 2 * np.abs(np.einsum("bcx,bax->bca", corners - centre[:, None], axes)).max(
        axis=1
    )
    upright = np.argmax(np.abs(axes[:, :, 2]), axis=1)
    flat = np.array([[a for a in range(3) if a != up] for up in upright])
    rows = np.arange(len(axes))
    ahead = axes[rows, flat[:, 0]]
    values = np.column_stack(
        [
            centre,
            size[rows, flat[:, 0]],
            size[rows, flat[:, 1]],
            size[rows, upright],
            np.arctan2(ahead[:, 1], ahead[:, 0]),
        ]
    )
    near = np.linalg.norm(centre, axis=1) < 60
    [scan] = [s for s in source if s.id.endswith(f"{frame:010d}")]
    counts = (
        Boxes(values[near], ["Car"] * int(near.sum()))
        .contain(scan.points, above_floor=0.3)
        .sum(axis=1)
    )
    assert abs(int((counts >= 10).sum()) - filled) <= (1 if filled < 100 else 3)


OBJECT_COUNTS = {
    "training/000000": [307],
    "training/000001": [69, 9, 17],
    "training/000008": [1425, 1457, 821, 556, 35, 142],
    "training/000114": [313, 136, 174, 370, 105, 120, 139, 32, 29, 19, 44, 0],
    "training/000623": [5186, 945, 2216, 303, 26, 142, 50, 0],
    "training/001206": [919, 4936, 12618, 2245, 151, 135, 80, 82],
}
"""Points at least 0.3 m above the floor of each labelled box, counted in the camera's frame, where
it was labelled."""


@pytest.mark.parametrize("reduced", [False, True])
def test_kitti_boxes_hold_their_points(real_scans: Path, reduced: bool) -> None:
    source = KITTIObject(real_scans / "kitti_object", "trainval", reduced=reduced)
    for index, scan in enumerate(source):
        camera = source.calibration(index)
        assert scan.boxes is not None and camera is not None
        floor, size, turn = boxes_to_camera(scan.boxes.values, camera)
        points = (
            scan.points @ camera.camera_from_sensor[:3, :3].T
            + camera.camera_from_sensor[:3, 3]
        )
        for box in range(len(scan.boxes)):
            right, down, ahead = (points - floor[box]).T
            along = right * np.cos(turn[box]) - ahead * np.sin(turn[box])
            across = right * np.sin(turn[box]) + ahead * np.cos(turn[box])
            height, width, length = size[box]
            inside = (
                (abs(along) <= length / 2)
                & (abs(across) <= width / 2)
                & (-down >= 0.3)
                & (-down <= height)
            )
            assert int(inside.sum()) == pytest.approx(
                OBJECT_COUNTS[scan.id][box], abs=1
            )
        # In the sensor's frame the boxes stand upright against another axis, about a degree off.
        upright = scan.boxes.contain(scan.points, above_floor=0.3).sum(axis=1)
        np.testing.assert_allclose(upright, OBJECT_COUNTS[scan.id], rtol=0.05, atol=5)


def test_kitti_label_files_are_written_back_as_they_were(
    real_scans: Path, tmp_path: Path
) -> None:
    for reduced in (False, True):
        source = KITTIObject(real_scans / "kitti_object", reduced=reduced)
        writer = WRITERS["kitti_object"](tmp_path)
        for index, scan in enumerate(source):
            writer.write(
                scan, index, name=scan.id, calibration=source.calibration(index)
            )
            for folder in (
                ("label_2", "calib") if scan.id.startswith("training") else ("calib",)
            ):
                path = Path(
                    *scan.id.split("/")[:1], folder, f"{scan.id.split('/')[1]}.txt"
                )
                assert (tmp_path / path).read_text().strip() == (
                    real_scans / "kitti_object" / path
                ).read_text().strip()
    writer.finish()
    assert (tmp_path / "ImageSets" / "test.txt").read_text() == "000007\n"


def test_kitti_tracklets_hold_their_points(real_scans: Path) -> None:
    by_drive = {
        scan.id.split("/")[0]: scan for scan in KITTIRaw(real_scans / "kitti_raw")
    }
    boxes = by_drive["2011_09_26_drive_0001_sync"].boxes
    assert boxes is not None
    assert boxes.names == ("Car", "Car", "Car", "Tram", "Car")
    counts = boxes.contain(
        by_drive["2011_09_26_drive_0001_sync"].points, above_floor=0.15
    ).sum(axis=1)
    assert counts.tolist() == [589, 69, 46, 12, 15]
    assert by_drive["2011_09_30_drive_0027_sync"].boxes is None


def test_nuscenes_is_turned_into_the_packages_frame(real_scans: Path) -> None:
    """Its own boxes, turned by the same axes, have to hold the number of points that nuScenes
    states."""
    [scan] = NuScenes(real_scans / "nuscenes")
    assert len(scan) == 34_688 - 8_029 and scan.ring is not None
    elevation = np.degrees(
        np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    )
    medians = [np.median(elevation[scan.ring == ring]) for ring in range(32)]
    assert medians == sorted(medians, reverse=True)
    assert (medians[0], medians[-1]) == pytest.approx((10.7, -30.6), abs=0.1)
    assert np.array_equal(scan.reflectance * 255, np.round(scan.reflectance * 255))
    info = json.loads((real_scans / "nuscenes" / "info.json").read_text())["data_list"][
        0
    ]["instances"]
    x, y, z, length, width, height, yaw = np.array([i["bbox_3d"] for i in info]).T
    boxes = Boxes(
        np.column_stack([y, -x, z, length, width, height, yaw - np.pi / 2]),
        ["Car"] * len(x),
    )
    stated = np.array([i["num_lidar_pts"] for i in info])
    found = boxes.contain(scan.points).sum(axis=1)
    assert (found == stated).sum() == 61 and np.abs(found - stated).max() <= 16


def test_range_images_of_other_code_are_read_as_they_are(real_scans: Path) -> None:
    source = open_scans(real_scans / "semantic_kitti" / "range_images_64x1024")
    assert isinstance(source, RangeImages)
    image = source.image(0)
    stack = np.load(
        real_scans / "semantic_kitti" / "range_images_64x1024" / "00_000000.npz"
    )["image"]
    assert image.mask.sum() == 51_770 and np.array_equal(image.range, stack[..., 4])
    assert image.reflectance is not None and np.array_equal(
        image.reflectance, stack[..., 3]
    )
    [own] = [
        s for s in SemanticKITTI(real_scans / "semantic_kitti") if s.id == "00/000000"
    ]
    scan = source[0]
    assert np.isin(
        scan.points.view("V12"), np.ascontiguousarray(own.points).view("V12")
    ).all()
    assert scan.label is not None and own.label is not None
    assert set(np.unique(scan.label)) <= set(np.unique(own.label))


@pytest.mark.parametrize("name", ["train_0", "val_25611"])
def test_range_images_of_nuscenes_are_turned(real_scans: Path, name: str) -> None:
    path = real_scans / "nuscenes" / "range_images_32x1024" / f"{name}.npz"
    source = open_scans(path, sensor="hdl32e_nuscenes")
    assert isinstance(source, RangeImages)
    image = source.image(0)
    scan = source[0]
    assert (
        image.mask.sum() == len(scan) == {"train_0": 25_175, "val_25611": 19_304}[name]
    )
    assert image.label is None
    # Spherical projection on the package's own grid finds the columns where the file has them.
    own = project(scan, source.sensor).mask.sum(axis=0)
    shifted = [
        np.abs(own - np.roll(image.mask.sum(axis=0), s)).sum() for s in range(-512, 512)
    ]
    assert abs(int(np.argmin(shifted)) - 512) <= 1
    with pytest.raises(DataError, match="Another convention may fit"):
        RangeImages(path)[0]


@pytest.mark.parametrize(
    "to", ["kitti", "semantic_kitti", "kitti_object", "kitti360", "npz"]
)
def test_real_scans_survive_every_lossless_layout(
    real_scans: Path, tmp_path: Path, to: str
) -> None:
    source = SemanticKITTI(real_scans / "semantic_kitti")
    # Without boxes, scans are no training scans of a detector.
    writer = WRITERS[to](
        tmp_path, **({"part": "testing"} if to == "kitti_object" else {})
    )
    picked = [i for i, name in enumerate(source.ids) if name[:2] in ("04", "06")]
    for index in picked:
        writer.write(
            source[index],
            index,
            name=source.ids[index],
            calibration=source.calibration(index),
        )
    writer.finish()
    back = open_scans(tmp_path)
    assert len(back) == len(picked)
    for scan, index in zip(back, picked, strict=True):
        expected = source[index]
        assert np.array_equal(scan.points, expected.points)
        assert np.array_equal(scan.reflectance, expected.reflectance)
        if to in ("kitti", "semantic_kitti", "npz"):
            assert np.array_equal(scan.raw_label, expected.raw_label)
            assert np.array_equal(scan.instance, expected.instance)
            assert np.array_equal(scan.label, expected.label)
        if to == "semantic_kitti":
            folder = real_scans / "semantic_kitti" / "sequences"
            for path in ("labels/{}.label", "velodyne/{}.bin"):
                file = Path(scan.id[:2], path.format(scan.id[3:]))
                assert (tmp_path / "sequences" / file).read_bytes() == (
                    folder / file
                ).read_bytes()


def test_moving_classes_and_instances_are_kept_apart(real_scans: Path) -> None:
    moving = [
        s
        for s in SemanticKITTI(real_scans / "semantic_kitti")
        if s.raw_label is not None and ((s.raw_label & 0xFFFF) >= 252).any()
    ]
    assert moving
    for scan in moving:
        assert scan.raw_label is not None and scan.label is not None
        assert (scan.label[(scan.raw_label & 0xFFFF) == 252] == 0).all()
        assert (scan.label[(scan.raw_label & 0xFFFF) == 0] == IGNORE).all()


def test_a_split_that_is_not_there_is_named(real_scans: Path) -> None:
    with pytest.raises(
        DataError, match=r"no sequence of split 'val' \(it has 00, 01, 03"
    ):
        SemanticKITTI(real_scans / "semantic_kitti", "val")
    with pytest.raises(
        DataError, match=rf"no drive of split 'lidm/val' \(it has {DRIVE}\)"
    ):
        KITTI360(real_scans / "kitti360", "lidm/val")
    with pytest.raises(ConfigError, match="'train'.*'r2flow/train'"):
        KITTI360(real_scans / "kitti360", "train")
    for split in ("r2flow/test", "lidm/train", "lidm-camera/train", "all"):
        assert split in SPLITS and len(KITTI360(real_scans / "kitti360", split)) == 12
