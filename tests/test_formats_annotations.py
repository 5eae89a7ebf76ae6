"""Cameras, poses, labels and boxes in each layout."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays
from layouts import (
    MAKERS,
    a_pose,
    nuscenes_arrays,
    some_boxes,
    some_camera,
    some_scan,
    write_all,
)
from roundtrips import back, same
from streets import CAMERA, kitti, street

from lidar_synth.datasets.classes import (
    IGNORE,
    KITTI360 as KITTI360_CLASSES,
    SEMANTIC_KITTI,
)
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import read_named_matrices, write_named_matrices
from lidar_synth.formats import KITTI360, WRITERS, KITTIObject, KITTIRaw, open_scans
from lidar_synth.formats.calibration import Calibration, ideal_camera, in_view
from lidar_synth.formats.camera_boxes import assumed_size
from lidar_synth.formats.convert import convert
from lidar_synth.formats.kitti360 import scans_folder
from lidar_synth.formats.point_labels import decode_labels, encode_labels
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.lab.proof.detection.study import with_boxes


def test_a_byte_order_mark_is_no_part_of_a_class(tmp_path: Path) -> None:
    write_all("kitti_object", tmp_path, [some_scan()])
    names = open_scans(tmp_path)[0].boxes.names
    path = tmp_path / "training/label_2/000000.txt"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert open_scans(tmp_path)[0].boxes.names == names


@pytest.mark.parametrize("to", ["semantic_kitti", "kitti_object", "kitti360"])
def test_the_camera_is_read_back(tmp_path: Path, to: str) -> None:
    camera = some_camera()
    scan = some_scan()
    picture = np.random.default_rng(0).integers(0, 256, (260, 700, 3), np.uint8)
    writer = WRITERS[to](tmp_path, calibration=camera)
    writer.write(scan, 0, image=picture)
    writer.finish()
    source = back(to, tmp_path)
    read = source.calibration(0)
    assert read is not None and read.image_size == (700, 260)
    np.testing.assert_allclose(
        read.image_from_sensor, camera.image_from_sensor, atol=1e-8
    )
    path = source[0].image_path
    assert path is not None
    from PIL import Image

    assert same(np.asarray(Image.open(path)), picture)
    # Once more, from what was read: the dataset's own matrices and the image go on as they are.
    WRITERS[to](tmp_path / "again").write(
        source[0], 0, name=source.ids[0], calibration=read
    )
    again = tmp_path / "again" / path.relative_to(tmp_path)
    assert again.read_bytes() == path.read_bytes()
    for file in (f for f in (tmp_path / "again").rglob("*.txt") if "calib" in str(f)):
        assert (
            file.read_text()
            == (tmp_path / file.relative_to(tmp_path / "again")).read_text()
        ), file


def test_every_camera_of_kitti360_is_written(tmp_path: Path) -> None:
    """Its own tools require four cameras; those that it has go on as they are."""
    write_all("kitti360", tmp_path / "a", [some_scan()], calibration=some_camera())
    folder = tmp_path / "a" / "calibration"
    mounts = read_named_matrices(folder / "calib_cam_to_pose.txt")
    assert list(mounts) == [f"image_0{k}" for k in range(4)]
    cameras = read_named_matrices(folder / "perspective.txt")
    names = {f"{kind}_rect_0{k}" for kind in "PRS" for k in range(2)}
    assert set(cameras) == names
    assert same(cameras["P_rect_01"], cameras["P_rect_00"])
    cameras |= {"P_rect_01": 2 * cameras["P_rect_01"], "K_01": np.eye(3).ravel()}
    write_named_matrices(folder / "perspective.txt", cameras)
    read = KITTI360(tmp_path / "a").calibration(0)
    write_all("kitti360", tmp_path / "b", [some_scan()], calibration=read)
    again = read_named_matrices(tmp_path / "b" / "calibration" / "perspective.txt")
    assert set(again) == {*names, "K_01"}
    assert all(same(again[name], values) for name, values in cameras.items())


@pytest.mark.parametrize("to", ["semantic_kitti", "kitti_object", "kitti360"])
def test_without_a_camera_an_ideal_forward_camera_is_written(
    tmp_path: Path, to: str
) -> None:
    write_all(to, tmp_path, [some_scan()])
    camera = back(to, tmp_path).calibration(0)
    assert camera is not None
    pixels, depth = camera.pixels(
        np.array([(10, 0, 0), (10, -1, 0), (10, 0, 1), (-10, 0, 0)], np.float32)
    )
    assert depth[0] == pytest.approx(10) and np.isnan(pixels[3]).all()
    assert pixels[1, 0] > pixels[0, 0] and pixels[2, 1] < pixels[0, 1]
    if camera.image_size is not None:
        np.testing.assert_allclose(pixels[0], np.array(camera.image_size) / 2)


@given(
    st.lists(st.sampled_from(sorted(SEMANTIC_KITTI.to_train)), min_size=1, max_size=20),
    st.integers(0, 0xFFFF),
)
def test_all_semantic_kitti_labels_are_preserved(
    classes: list[int], instance: int
) -> None:
    raw = np.array(classes, np.uint32) | np.uint32(instance << 16)
    known = decode_labels(raw, SEMANTIC_KITTI, "here")
    scan = Scan(
        np.ones((len(raw), 3), np.float32),
        np.zeros(len(raw), np.float32),
        some_scan().sensor,
        **known,
    )
    assert same(encode_labels(scan, SEMANTIC_KITTI), raw)
    # In another taxonomy the raw values mean nothing: the label is written, with the instance.
    other = encode_labels(scan, KITTI360_CLASSES)
    assert same(other >> 16, known["instance"])
    kept = KITTI360_CLASSES.decode((other & 0xFFFF).astype(np.uint16))
    expected = KITTI360_CLASSES.decode(KITTI360_CLASSES.encode(known["label"]))
    assert same(kept, expected)


@given(
    arrays.arrays(
        np.uint8, st.integers(1, 30), elements=st.sampled_from([*range(19), IGNORE])
    )
)
def test_labels_without_raw_values_are_written_as_static_classes(
    label: np.ndarray,
) -> None:
    scan = Scan(
        np.ones((len(label), 3), np.float32),
        np.zeros(len(label), np.float32),
        some_scan().sensor,
        label=label,
    )
    raw = encode_labels(scan, SEMANTIC_KITTI)
    assert same(decode_labels(raw, SEMANTIC_KITTI, "here")["label"], label)
    assert (raw[label == IGNORE] == 0).all() and raw.max() < 100


def test_a_changed_label_is_written() -> None:
    scan = some_scan()
    assert scan.label is not None
    scan.label = np.where(scan.label == 0, 8, scan.label).astype(np.uint8)
    raw = encode_labels(scan, SEMANTIC_KITTI)
    known = decode_labels(raw, SEMANTIC_KITTI, "here")
    assert same(known["label"], scan.label) and same(known["instance"], scan.instance)
    raw[-2:] = 252 | 7 << 16, 60
    scan = replace(scan, **decode_labels(raw, SEMANTIC_KITTI, "here"))
    assert scan.label is not None
    scan.label[0] = 8 - scan.label[0] % 2  # only this point's changes
    assert same(encode_labels(scan, SEMANTIC_KITTI)[1:], raw[1:])
    scan.label = scan.label % 3
    scan.instance = np.full(len(scan), 70_000, np.int32)
    with pytest.raises(DataError, match="instances from 70000 to 70000.*0..65535"):
        encode_labels(scan, SEMANTIC_KITTI)


def test_kitti360_labels_in_both_encodings(tmp_path: Path) -> None:
    scan = some_scan()
    write_all("kitti360", tmp_path, [scan])
    read = back("kitti360", tmp_path)[0]
    assert (
        read.label is not None and scan.label is not None and scan.instance is not None
    )
    assert same(
        read.label, KITTI360_CLASSES.decode(KITTI360_CLASSES.encode(scan.label))
    )
    ids = KITTI360_CLASSES.encode(scan.label)
    assert same(
        read.instance, np.where(scan.instance > 0, ids * 1000 + scan.instance, 0)
    )
    [path] = tmp_path.glob("data_3d_semantics_scan/*/labels/*.label")
    path.unlink()
    recovered = np.where(np.arange(len(scan)) % 7 == 0, -1, ids).astype("<i2")
    recovered.tofile(path.with_suffix(".bin"))
    again = back("kitti360", tmp_path)[0]
    assert again.label is not None and (again.label[::7] == IGNORE).all()
    assert same(again.label[recovered >= 0], read.label[recovered >= 0])
    path.with_suffix(".bin").unlink()
    assert back("kitti360", tmp_path)[0].label is None


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_kitti_label_lines_are_boxes_and_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    from lidar_synth.formats.kitti_labels import (
        boxes_from_camera,
        boxes_to_camera,
        read_label_2,
        write_label_2,
    )

    boxes = some_boxes(seed)
    camera = some_camera()
    floor, size, turn = boxes_to_camera(boxes.values, camera)
    again = boxes_from_camera(floor, size, turn, camera)
    np.testing.assert_allclose(again[:, :6], boxes.values[:, :6], atol=1e-4)
    np.testing.assert_allclose(np.cos(again[:, 6] - boxes.values[:, 6]), 1, atol=1e-5)
    path = tmp_path_factory.mktemp("labels") / "a.txt"
    write_label_2(path, boxes, camera)
    text = path.read_text()
    read = read_label_2(path, camera)
    assert (
        (read.image_box[:, :2] >= 0) & (read.image_box[:, 2:] <= np.array([699, 259]))
    ).all()
    assert ((read.truncation >= 0) & (read.truncation <= 1)).all()
    write_label_2(path, read, camera)
    assert path.read_text() == text


def test_a_kitti_label_line_by_hand(tmp_path: Path) -> None:
    """An ideal camera: 1 m right, 2 m down, 10 m ahead is the floor's middle; rotation_y = 0 looks
    to the right."""
    from lidar_synth.formats.calibration import ideal_camera
    from lidar_synth.formats.kitti_labels import read_label_2

    path = tmp_path / "a.txt"
    path.write_text(
        "Car 0.25 2 -0.10 10.00 20.00 30.00 40.00 1.50 1.60 4.00 1.00 2.00 10.00 0.00\n"
    )
    boxes = read_label_2(path, ideal_camera(700, (1200, 370)))
    np.testing.assert_allclose(
        boxes.values, [(10, -1, -2 + 0.75, 4, 1.6, 1.5, -np.pi / 2)], atol=1e-6
    )
    assert (boxes.names, boxes.truncation[0], boxes.occlusion[0]) == (("Car",), 0.25, 2)
    assert same(boxes.image_box, [(10, 20, 30, 40)]) and boxes.alpha[0] == np.float32(
        -0.1
    )


def test_pose_files_by_hand(tmp_path: Path) -> None:
    """Two metres ahead: along the camera's z in SemanticKITTI; KITTI-360's IMU has its y to the
    right and z down."""
    scan = some_scan()
    scan.pose = np.eye(4)
    scan.pose[0, 3] = 2
    for to in ("semantic_kitti", "kitti360"):
        write_all(to, tmp_path / to, [scan])
    line = np.loadtxt(tmp_path / "semantic_kitti" / "sequences" / "00" / "poses.txt")
    np.testing.assert_allclose(line, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 2], atol=1e-12)
    folder = tmp_path / "kitti360" / "data_poses" / "2013_05_28_drive_0000_sync"
    np.testing.assert_allclose(
        np.loadtxt(folder / "poses.txt"),
        [0, 1, 0, 0, 2, 0, -1, 0, 0, 0, 0, -1, 0],
        atol=1e-12,
    )
    camera = [0, 0, 0, 1, 2, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]
    np.testing.assert_allclose(
        np.loadtxt(folder / "cam0_to_world.txt"), camera, atol=1e-12
    )


def test_kitti_object_lists_boxes_in_the_cameras_view(tmp_path: Path) -> None:
    values = [
        (20, 0, -1, 4, 2, 1.5, 0),
        (-20, 0, -1, 4, 2, 1.5, 0),
        (20, 40, -1, 4, 2, 1.5, 0),
        (1.5, 1, -1, 6, 2, 1.5, 0),
    ]
    scan = some_scan()
    scan.boxes = Boxes(
        np.array(values),
        ("Car", "Car", "Van", "Truck"),
        dont_care=np.array([(1, 2, 30, 40)], np.float32),
    )
    write_all("kitti_object", tmp_path, [scan], calibration=some_camera())
    read = KITTIObject(tmp_path, "train")[0].boxes
    assert (
        read is not None
        and read.names == ("Car", "Truck")  # which the camera's plane cuts
        and same(read.dont_care, [(1, 2, 30, 40)])
        and read.occlusion.tolist() == [0, 0]
    )
    assert read.truncation[0] == 0 and 0.9 < read.truncation[1] <= 1
    np.testing.assert_allclose(read.values[0], values[0], atol=0.02)
    assert [scan.id for scan in KITTIObject(tmp_path, "trainval")] == [
        "training/000000"
    ]
    scan.boxes = Boxes(np.zeros((0, 7)), (), dont_care=scan.boxes.dont_care)
    write_all("kitti_object", tmp_path, [scan], calibration=some_camera())
    read = KITTIObject(tmp_path)[0].boxes
    assert read is not None and len(read) == 0 and len(read.dont_care) == 1
    with pytest.raises(ConfigError, match="split 'val'.*there is no"):
        KITTIObject(tmp_path, "val")


def test_a_detector_gets_scans_with_boxes_in_the_view(tmp_path: Path) -> None:
    root = kitti(tmp_path / "k", 3)
    (root / "training" / "label_2" / "000001.txt").unlink()
    scans = KITTIObject(root)
    cropped = scans.with_boxes()
    assert cropped.ids == ("training/000000", "training/000002")
    assert len(scans) == 3 and scans.beyond_view and not cropped.beyond_view
    for whole, part in ((scans[0], cropped[0]), (scans[2], cropped[1])):
        assert same(part.points, in_view(whole, CAMERA).points)
        assert 0 < len(part) < len(whole)
    for path in (root / "training" / "label_2").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="without boxes"):
        scans.with_boxes()


@pytest.mark.parametrize("picture", [".png", ".jpg", None])
def test_the_view_of_another_camera_is_not_taken_for_kittis(
    tmp_path: Path, picture: str | None
) -> None:
    """Its size is that of its images, also if those are JPEG; without any, its projection tells
    it."""
    from PIL import Image

    width = (
        1920 if picture is None else 1800
    )  # the principal point is not in the centre
    camera = replace(ideal_camera(1000.0, (1920, 1080)), image_size=(width, 1080))
    write_all("kitti_object", tmp_path / "own", [street(0)], calibration=camera)
    image = tmp_path / "own/training/image_2/000000.png"
    if picture == ".jpg":
        Image.open(image).save(image.with_suffix(".jpg"))
    if picture != ".png":
        image.unlink()
    source = KITTIObject(tmp_path / "own")
    [whole] = source
    [cropped] = source.with_boxes()
    assert same(cropped.points, in_view(whole, camera).points)
    convert(source, WRITERS["kitti_object"](tmp_path / "again"), progress=False)
    again = open_scans(tmp_path / "again").calibration(0)
    assert again is not None and again.image_size == (width, 1080)
    boxes = (f"{n}/training/label_2/000000.txt" for n in ("own", "again"))
    assert len({(tmp_path / path).read_text() for path in boxes}) == 1


@pytest.mark.parametrize(
    ("centre", "size"),
    [
        ((609.6, 172.9), (1242, 375)),
        ((602.0, 183.0), (1242, 375)),
        ((320, 240), (640, 480)),
    ],
)
def test_the_size_of_an_image_follows_from_the_projection(
    centre: tuple[float, float], size: tuple[int, int]
) -> None:
    projection = np.array(
        [(700, 0, centre[0], 0), (0, 700, centre[1], 0), (0, 0, 1, 0)]
    )
    assert assumed_size(Calibration(projection, np.eye(4))) == size
    projection[:2, 2] = 0
    with pytest.raises(DataError, match="principal point of P2: an image of"):
        assumed_size(Calibration(projection, np.eye(4)))


def test_a_detector_gets_drives_with_tracklets_in_the_view(tmp_path: Path) -> None:
    drive = MAKERS["kitti_raw"](tmp_path)[0].parents[2]
    cropped = KITTIRaw(tmp_path).with_boxes()
    with pytest.raises(DataError, match="without calibration"):
        cropped[0]
    to_camera = CAMERA.camera_from_sensor
    write_named_matrices(
        drive.parent / "calib_velo_to_cam.txt",
        {"R": to_camera[:3, :3], "T": to_camera[:3, 3]},
    )
    write_named_matrices(
        drive.parent / "calib_cam_to_cam.txt",
        {
            "R_rect_00": np.eye(3),
            "P_rect_02": CAMERA.projection,
            "S_rect_02": np.array(CAMERA.image_size),
        },
    )
    scans = KITTIRaw(tmp_path)
    assert scans.beyond_view and not cropped.beyond_view
    assert with_boxes(scans).options == cropped.options != scans.options
    assert cropped.ids == scans.ids
    for whole, part in zip(scans, cropped, strict=True):
        assert same(part.points, in_view(whole, CAMERA).points)
        assert 0 < len(part) < len(whole)
    assert [len(scan.boxes or ()) for scan in cropped] == [0, 1, 1]
    (drive / "tracklet_labels.xml").unlink()
    with pytest.raises(DataError, match="without boxes"):
        scans.with_boxes()


def test_an_object_that_the_images_edge_cuts_is_in_view() -> None:
    """KITTI labels it: without its box, its points would be background."""
    edge = 10 * CAMERA.projection[0, 2] / CAMERA.projection[0, 0]
    scan = some_scan()
    scan = Scan(
        np.array([(10, edge - 0.1, 0), (10, edge + 0.5, 0)], np.float32),
        np.zeros(2, np.float32),
        scan.sensor,
        boxes=Boxes(
            np.array([(10, edge + d, 0, 4, 2, 2, 0) for d in (0.5, 3)]), ("Car", "Van")
        ),
    )
    part = in_view(scan, CAMERA)
    assert len(part) == 1
    assert part.boxes is not None and part.boxes.names == ("Car",)


def test_the_drives_of_shuffled_frames_are_the_devkits(tmp_path: Path) -> None:
    root = kitti(tmp_path / "k", 3)
    assert KITTIObject(root).drives is None
    (root / "mapping").mkdir()
    rows = [f"2011_09_26 2011_09_26_drive_{i:04d}_sync 0000000001" for i in (1, 2, 3)]
    (root / "mapping" / "train_mapping.txt").write_text("\n".join(rows))
    (root / "mapping" / "train_rand.txt").write_text("3,1,2")
    drives = [f"2011_09_26_drive_{i:04d}_sync" for i in (3, 1, 2)]
    assert KITTIObject(root).drives == tuple(drives)
    (root / "mapping" / "train_rand.txt").write_text("3,1,9")
    with pytest.raises(DataError, match=r"mapping.*devkit"):
        _ = KITTIObject(root).drives


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_kitti360_boxes_survive_the_conversion_to_the_world_frame(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    root = tmp_path_factory.mktemp("boxes")
    scans = [some_scan(seed + i, count=40) for i in range(2)]
    write_all("kitti360", root, scans, calibration=some_camera())
    for scan, expected in zip(KITTI360(root), scans, strict=True):
        assert scan.boxes is not None and expected.boxes is not None
        np.testing.assert_allclose(
            scan.boxes.values[:, :6], expected.boxes.values[:, :6], atol=1e-4
        )
        np.testing.assert_allclose(
            np.cos(scan.boxes.values[:, 6] - expected.boxes.values[:, 6]), 1, atol=1e-6
        )
        assert scan.boxes.names == expected.boxes.names
        assert (scan.boxes.instance % 1000 == expected.boxes.instance).all()
    again = list(KITTI360(root))
    write_all("kitti360", root / "again", again)
    for scan, expected in zip(KITTI360(root / "again"), again, strict=True):
        assert (
            scan.boxes is not None
            and expected.boxes is not None
            and same(scan.instance, expected.instance)
        )
        assert (
            same(scan.boxes.instance, expected.boxes.instance)
            and (scan.boxes.instance >= 1000).all()
        )


def test_static_kitti360_boxes_are_listed_near_their_window(tmp_path: Path) -> None:
    from lidar_synth.formats.kitti360_boxes import MARGIN, read_boxes

    entry = (
        "<object{0}><index>{0}</index><label>{1}</label>{2}<instanceId>7</instanceId>"
        "<start_frame>500</start_frame><end_frame>700</end_frame><timestamp>{3}</timestamp>"
        "<transform><rows>4</rows><cols>4</cols><dt>d</dt>"
        "<data>0 -2 0 10 4 0 0 0 0 0 1.5 0 0 0 0 1</data></transform>"
        "<vertices><data>{4}</data></vertices></object{0}>"
    )
    cube = " ".join(
        str(v) for corner in np.ndindex(2, 2, 2) for v in np.array(corner) - 0.5
    )
    objects = [
        entry.format(1, "car", "<semanticId>13</semanticId>", -1, cube),
        entry.format(2, "building", "<semanticId>11</semanticId>", -1, cube),
        entry.format(3, "pedestrian", "", 600, cube),
    ]
    path = tmp_path / "drive.xml"
    path.write_text(f"<opencv_storage>{''.join(objects)}</opencv_storage>")
    boxes = read_boxes(path)
    assert boxes.at(600, np.eye(4), 80).names == ("Car", "Pedestrian")
    np.testing.assert_allclose(
        boxes.at(600, np.eye(4), 80).values[0],
        (10, 0, 0, 4, 2, 1.5, np.pi / 2),
        atol=1e-6,
    )
    assert boxes.at(600, np.eye(4), 80).instance.tolist() == [26007, 24007]
    assert boxes.at(700 + MARGIN, np.eye(4), 80).names == ("Car",)
    assert len(boxes.at(600, a_pose(), 80)) == 0  # none is near
    assert boxes.at(701 + MARGIN, np.eye(4), 80) is None  # not known


def test_boxes_of_kitti360_are_known_where_the_car_stands_still_and_in_windows_alone(
    tmp_path: Path,
) -> None:
    scans = [replace(some_scan(i, count=40), pose=a_pose(0)) for i in range(4)]
    scans[1].boxes = Boxes(np.zeros((0, 7)), ())
    write_all("kitti360", tmp_path, scans, calibration=some_camera())
    poses = tmp_path / "data_poses" / "2013_05_28_drive_0000_sync" / "poses.txt"
    first, *left_out, last = poses.read_text().splitlines(True)
    assert len(left_out) == 2
    poses.write_text(first + "1000" + last.removeprefix("3"))
    files = scans_folder(tmp_path, poses.parent.name)
    (files / "0000000003.bin").rename(files / "0000001000.bin")
    *near, far = KITTI360(tmp_path)
    np.testing.assert_allclose([scan.pose for scan in near], [scans[0].pose] * 3)
    assert [scan.boxes is not None and len(scan.boxes) for scan in near] == [
        len(scans[0].boxes),  # type: ignore[arg-type]
        0,
        len(scans[2].boxes),  # type: ignore[arg-type]
    ]
    assert far.pose is not None and far.boxes is None


def test_positions_of_kitti_tracklets_are_centres_of_the_floor(tmp_path: Path) -> None:
    MAKERS["kitti_raw"](tmp_path)
    first, second, third = (scan.boxes for scan in open_scans(tmp_path))
    assert (
        first is not None
        and len(first) == 0
        and second is not None
        and third is not None
    )
    assert third.names == ("Person_sitting",)
    np.testing.assert_allclose(
        third.values[0], (10, 1, -0.9, 0.9, 0.8, 1.2, 5 - 2 * np.pi), atol=1e-5
    )
    assert (third.occlusion[0], third.truncation[0], third.instance[0]) == (1, 0, 1)


def test_versions_of_nuscenes_that_were_not_downloaded_do_not_matter(
    tmp_path: Path,
) -> None:
    """lidarseg's archive has a table of each version."""
    MAKERS["nuscenes"](tmp_path)
    (tmp_path / "v1.0-test").mkdir()
    (tmp_path / "v1.0-test" / "lidarseg.json").write_text("[]")
    assert all(scan.label is not None for scan in open_scans(tmp_path))
    (tmp_path / "v1.0-mini" / "sample_data.json").unlink()
    with pytest.raises(FileError, match="sample_data"):
        open_scans(tmp_path)


def test_nuscenes_labels_are_dropped_with_their_points(tmp_path: Path) -> None:
    from lidar_synth.datasets.classes import NUSCENES

    MAKERS["nuscenes"](tmp_path)
    for i, scan in enumerate(open_scans(tmp_path)):
        points, classes = nuscenes_arrays(seed=i)
        kept = np.linalg.norm(points[:, :3], axis=1) >= 1
        assert 0 < kept.sum() < len(points)
        assert same(
            scan.points,
            np.column_stack([points[kept, 1], -points[kept, 0], points[kept, 2]]),
        )
        assert same(scan.ring, 31 - points[kept, 4]) and same(
            scan.label, NUSCENES.decode(classes[kept])
        )
