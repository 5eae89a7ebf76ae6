"""Writing and reading back, in every layout and format."""

import json
import re
import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import random_scan
from layouts import MAKERS, WRITTEN_AS, some_camera, some_scan, write_all
from roundtrips import back, same

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.formats import (
    KITTI360,
    READERS,
    WRITERS,
    KITTIObject,
    SemanticKITTI,
    open_scans,
)
from lidar_synth.formats.cloud import LONGEST_PADDING, STORED
from lidar_synth.formats.png import RangePNG
from lidar_synth.formats.range_images import RangeImages
from lidar_synth.geometry.projection import locate, project, unproject
from lidar_synth.geometry.scan import SYNTHETIC, Boxes, Source
from lidar_synth.geometry.sensor import presets
from lidar_synth.viz.window import import_open3d


def _open3d_is_missing() -> bool:
    try:
        import_open3d()
    except LibraryError:
        return True
    return False


needs_open3d = pytest.mark.skipif(
    _open3d_is_missing(), reason="open3d or a system library behind it is missing"
)


POINT_LAYOUTS = [name for name in WRITERS if name not in ("range", "png", "cosmos")]


KEEP_FIELDS = ["kitti", "semantic_kitti", "pcd", "ply", "npz", "webdataset", "mcap"]
"""Formats that keep every label and instance bit for bit."""


def test_every_reader_and_writer_is_tested() -> None:
    assert set(WRITTEN_AS) == set(WRITERS) and set(MAKERS) == set(READERS)


@pytest.mark.slow
@pytest.mark.parametrize("to", POINT_LAYOUTS)
def test_points_are_read_back_bit_for_bit(tmp_path: Path, to: str) -> None:
    scans = [some_scan(i) for i in range(3)]
    write_all(to, tmp_path, scans)
    source = back(to, tmp_path)
    assert isinstance(source, Source) and len(source) == 3 and len(list(source)) == 3
    for expected, scan in zip(scans, source, strict=True):
        assert scan.points.tobytes() == expected.points.tobytes()
        assert scan.reflectance.tobytes() == expected.reflectance.tobytes()
    assert same(source[-1].points, scans[-1].points)
    with pytest.raises(IndexError):
        source[3]


@pytest.mark.parametrize("to", KEEP_FIELDS)
def test_labels_are_read_back_bit_for_bit(tmp_path: Path, to: str) -> None:
    scan = some_scan()
    write_all(to, tmp_path, [scan])
    read = back(to, tmp_path)[0]
    for name in ("label", "raw_label", "instance"):
        assert same(getattr(read, name), getattr(scan, name)), name
        assert getattr(read, name).dtype == getattr(scan, name).dtype


@pytest.mark.parametrize("to", ["pcd", "ply", "npz", "webdataset", "mcap"])
def test_every_field_of_boxes_is_read_back(tmp_path: Path, to: str) -> None:
    scan = some_scan()
    scan.boxes = Boxes(
        np.array([(8, 1, 0, 4, 2, 1.5, 0.1)]),
        ("Car",),
        truncation=np.array([0.3]),
        occlusion=np.array([2]),
        image_box=np.array([(1, 2, 30, 40.5)]),
        instance=np.array([7]),
        alpha=np.array([-0.2]),
        dont_care=np.array([(1, 2, 3, 4)]),
    )
    write_all(to, tmp_path, [scan])
    read = back(to, tmp_path)[0].boxes
    for field in fields(Boxes):
        sent = getattr(scan.boxes, field.name)
        assert same(np.asarray(getattr(read, field.name)), np.asarray(sent)), field.name


@pytest.mark.parametrize("to", ["pcd", "ply", "npz", "webdataset", "mcap"])
def test_every_field_of_a_point_is_read_back(tmp_path: Path, to: str) -> None:
    scan = some_scan()
    scan.ring = np.arange(len(scan), dtype=np.int16) % 64
    scan.confidence = (np.arange(len(scan), dtype=np.float32) / len(scan)).astype(
        np.float32
    )
    scan.time = scan.confidence / np.float32(10)
    assert scan.raw_label is not None
    scan.raw_label = scan.raw_label | np.uint32(1 << 31)
    write_all(to, tmp_path, [scan])
    read = back(to, tmp_path)[0]
    assert set(read.fields()) == set(scan.fields())
    for name, values in scan.fields().items():
        found = read.fields()[name]
        assert same(found, values) and found.dtype == values.dtype, name
        assert found.flags.writeable, name


@pytest.mark.parametrize(
    ("suffix", "header"),
    [
        (
            ".pcd",
            "# .PCD v.7\nVERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 "
            "1 1 1\nWIDTH 2\n"
            "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n",
        ),
        (
            ".ply",
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float "
            "y\nproperty float z\n"
            "property float intensity\nend_header\n",
        ),
    ],
)
@pytest.mark.parametrize(
    "name", ["intensity", "Intensity", "i", "remission", "scalar_Intensity"]
)
def test_clouds_of_other_programs(
    tmp_path: Path, suffix: str, header: str, name: str
) -> None:
    path = tmp_path / f"scan{suffix}"
    header = header.replace("intensity", name)
    path.write_text(f"{header}1 2 3 51\n-4 5 6 255\n")
    scan = READERS["folder"](path, reflectance_max=255)[0]
    assert same(scan.points, [(1, 2, 3), (-4, 5, 6)])
    np.testing.assert_allclose(scan.reflectance, [0.2, 1])
    path.write_text(f"{header}1 2 3 51\n")
    with pytest.raises(DataError, match="is truncated"):
        open_scans(path)[0]


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_zeros_after_the_points_of_a_cloud_are_ignored(
    tmp_path: Path, encoding: str
) -> None:
    """Earlier versions of PCL write a page of memory more than the points take."""
    [path] = write_all("pcd", tmp_path, [some_scan()])
    scan = open_scans(path)[0]
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    if encoding == "binary_compressed":
        width = len(body) // len(scan)
        records = np.frombuffer(body, np.uint8).reshape(-1, width)
        sizes = re.search(rb"^SIZE (.*)$", head, re.M)
        assert sizes is not None
        ends = np.cumsum([int(size) for size in sizes[1].split()])[:-1]
        plain = b"".join(part.tobytes() for part in np.split(records, ends, axis=1))
        parts = [plain[i : i + 32] for i in range(0, len(plain), 32)]
        packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    head += f"DATA {encoding}\n".encode()
    for tail in (b"", bytes(4000), bytes(LONGEST_PADDING)):
        path.write_bytes(head + body + tail)
        assert same(open_scans(path)[0].points, scan.points)
    for tail in (bytes(LONGEST_PADDING + 1), bytes(100) + b"1"):
        path.write_bytes(head + body + tail)
        with pytest.raises(DataError, match="more than its header declares"):
            open_scans(path)[0]


@needs_open3d
@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".pcd", {}),
        (".pcd", {"compressed": True}),
        (".pcd", {"write_ascii": True}),
        (".ply", {}),
        (".ply", {"write_ascii": True}),
    ],
)
def test_clouds_that_open3d_wrote(
    tmp_path: Path, suffix: str, options: dict[str, bool]
) -> None:
    """Earlier versions of this package wrote PCD and PLY by open3d, with these names and types."""
    open3d = import_open3d()
    scan = some_scan()
    path = tmp_path / f"scan{suffix}"
    scan.confidence = scan.reflectance[::-1].copy()
    cloud = open3d.t.geometry.PointCloud()
    cloud.point["positions"] = open3d.core.Tensor(scan.points)
    cloud.point["intensity"] = open3d.core.Tensor(scan.reflectance[:, None].copy())
    for name, values in scan.fields().items():
        if name in STORED:
            cloud.point[name] = open3d.core.Tensor(values.astype(STORED[name])[:, None])
    open3d.t.io.write_point_cloud(str(path), cloud, **options)
    read = open_scans(path)[0]
    atol = 2e-6 if "write_ascii" in options else 0  # its decimals
    np.testing.assert_allclose(
        read.points, scan.points, rtol=1e-5 if atol else 0, atol=atol
    )
    for name in ("reflectance", "confidence"):
        np.testing.assert_allclose(
            read.fields()[name], scan.fields()[name], rtol=0, atol=atol
        )
    for name in ("label", "raw_label", "instance"):
        assert same(read.fields()[name], scan.fields()[name]), name
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(DataError, match="is truncated|numbers in each line"):
        open_scans(path)[0]


@needs_open3d
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_open3d_reads_our_clouds(tmp_path: Path, suffix: str) -> None:
    open3d = import_open3d()
    scan = some_scan()
    [path] = write_all(suffix[1:], tmp_path, [scan])
    cloud = open3d.t.io.read_point_cloud(str(path))
    assert same(cloud.point["positions"].numpy(), scan.points)
    for name in ("intensity", "label", "instance"):
        expected = scan.fields()["reflectance" if name == "intensity" else name]
        assert same(cloud.point[name].numpy()[:, 0].astype(expected.dtype), expected), (
            name
        )


def test_npz_preserves_all_fields(tmp_path: Path) -> None:
    scan = some_scan(sensor="os1_128")
    scan.domain = 1
    scan.id = "somewhere"
    write_all("npz", tmp_path, [scan])
    read = back("npz", tmp_path)[0]
    assert (
        read.sensor == scan.sensor and read.domain == 1 and same(read.pose, scan.pose)
    )
    assert read.boxes is not None and scan.boxes is not None
    for field in fields(Boxes):
        assert same(getattr(read.boxes, field.name), getattr(scan.boxes, field.name)), (
            field.name
        )


def test_a_scan_without_labels_still_gets_a_label_file_of_semantic_kitti(
    tmp_path: Path,
) -> None:
    scan = some_scan()
    scan.label = scan.raw_label = scan.instance = None
    write_all("semantic_kitti", tmp_path, [scan])
    read = back("semantic_kitti", tmp_path)[0]
    assert read.raw_label is not None and (read.raw_label == 0).all()
    assert read.label is not None and (read.label == IGNORE).all()


@pytest.mark.parametrize("sensor", ["hdl64e_kitti", "os1_128", "hdl32e_nuscenes"])
def test_range_images_are_read_back_in_every_cell(tmp_path: Path, sensor: str) -> None:
    scan = some_scan(sensor=sensor)
    image = project(scan)
    write_all("range", tmp_path, [scan])
    source = back("range", tmp_path)
    assert isinstance(source, RangeImages)
    read = source.image(0)
    assert read.sensor == image.sensor and same(read.range, image.range)
    assert set(read.channels) == set(image.channels)
    assert all(
        same(read.channels[name], values) for name, values in image.channels.items()
    )
    again = source[0]
    assert same(again.pose, scan.pose) and again.boxes is not None
    assert same(project(again).mask, image.mask) and same(
        project(again).label, image.label
    )


@pytest.mark.parametrize("sensor", ["hdl64e_kitti", "os1_128"])
def test_png_loses_only_what_is_documented(tmp_path: Path, sensor: str) -> None:
    scan = some_scan(sensor=sensor)
    image = project(scan)
    [path] = write_all("png", tmp_path, [scan])
    for source in (back("png", tmp_path), open_scans(path)):
        assert isinstance(source, RangePNG)
        read = source.image(0)
        assert (
            read.sensor == image.sensor
            and same(read.mask, image.mask)
            and same(read.label, image.label)
        )
        half_a_step = image.sensor.range_max / 65535 / 2
        assert np.abs(
            read.range - image.range
        ).max() <= half_a_step * 1.001 + np.spacing(image.range.max())
        assert read.reflectance is not None and image.reflectance is not None
        assert np.abs(read.reflectance - image.reflectance).max() <= 8e-6
        assert same(source[0].label, project(scan).label[image.mask])  # type: ignore[index]


@pytest.mark.parametrize("convention", ["kitti", "nuscenes"])
def test_range_images_with_six_values_per_cell(tmp_path: Path, convention: str) -> None:
    """As other codes keep them: x, y, z, reflectance, range and class; nuScenes' turned by a
    quarter."""
    sensor = {"kitti": "hdl64e_semantic_kitti", "nuscenes": "hdl32e_nuscenes"}[
        convention
    ]
    scan = some_scan(sensor=sensor)
    index = locate(scan.points, scan.sensor).point
    values = np.column_stack(
        [scan.points, scan.reflectance, np.zeros(len(scan)), scan.label + np.uint8(1)]
    )
    stack = np.where(index[..., None] >= 0, values[index], 0).astype(np.float32)
    if convention == "nuscenes":
        x, y, z, reflectance, _, _ = np.moveaxis(
            np.roll(stack, -stack.shape[1] // 4, axis=1), -1, 0
        )
        stack = np.stack([-y, x, z, reflectance * 255, z, z], -1)
    stack[..., 4] = np.linalg.norm(stack[..., :3], axis=-1)
    np.savez(tmp_path / "a.npz", image=stack)
    source = open_scans(tmp_path, sensor=sensor)
    assert isinstance(source, RangeImages)
    image = source.image(0)
    expected = project(scan)
    assert same(image.mask, expected.mask) and same(
        source[0].points, scan.points[index[index >= 0]]
    )
    assert (
        (image.label is None)
        if convention == "nuscenes"
        else same(image.label, expected.label)
    )
    assert image.reflectance is not None and expected.reflectance is not None
    np.testing.assert_allclose(image.reflectance, expected.reflectance, atol=1e-6)
    stack[..., 4] += 1
    np.savez(tmp_path / "a.npz", image=stack)
    with pytest.raises(DataError, match="x, y, z and range of a cell differ by 1 m"):
        source[0]


@pytest.mark.parametrize("shape", ["(H, W)", "(2, H, W)"])
def test_range_images_as_plain_arrays(tmp_path: Path, shape: str) -> None:
    image = project(some_scan())
    stack = (
        image.range
        if shape == "(H, W)"
        else np.stack([image.range, image.channels["reflectance"]])
    )
    np.save(tmp_path / "image.npy", stack)
    source = open_scans(tmp_path, sensor="hdl64e_kitti")
    assert isinstance(source, RangeImages) and same(source.image(0).range, image.range)
    assert len(source[0]) == image.mask.sum()


def test_range_images_have_the_sensor_and_the_origin_beside_them(
    tmp_path: Path,
) -> None:
    scan = some_scan(sensor="os1_64")
    image = project(scan)
    np.save(tmp_path / "image.npy", image.range)
    said = {
        "format": "lidar-synth-scans/1",
        "sensor": "os1_64",
        "origins": [{"domain": "synthetic"}],
    }
    (tmp_path / "scans.json").write_text(json.dumps(said))
    for source in (open_scans(tmp_path), open_scans(tmp_path, sensor="os1_64")):
        [read] = source
        assert (read.sensor.name, read.domain) == ("os1_64", SYNTHETIC)
        assert np.abs(read.points - unproject(image).points).max() < 1e-4
    with pytest.warns(UserWarning, match="says that its scans are of sensor 'os1_64'"):
        assert open_scans(tmp_path, sensor="hdl64e_kitti").sensor.name == "hdl64e_kitti"


@pytest.mark.parametrize("to", ["npz", "range", "webdataset"])
def test_fields_of_other_types_are_written_in_those_of_files(
    tmp_path: Path, to: str
) -> None:
    """Reflectances divided by 255 in numpy are float64. Projection takes points in float32 only."""
    scan = some_scan()
    kind = np.float32 if to == "range" else np.float64
    wide = replace(
        scan,
        points=scan.points.astype(kind),
        reflectance=scan.reflectance.astype(np.float64),
        label=scan.label.astype(np.int64),
        raw_label=None,
    )
    write_all(to, tmp_path / "wide", [wide])
    write_all(to, tmp_path / "same", [replace(scan, raw_label=None)])
    [a], [b] = open_scans(tmp_path / "wide"), open_scans(tmp_path / "same")
    assert (
        same(a.points, b.points)
        and same(a.reflectance, b.reflectance)
        and same(a.label, b.label)
    )
    with pytest.raises(
        DataError, match="label holds 300; expected whole numbers that uint8 can hold"
    ):
        write_all(to, tmp_path / "bad", [replace(wide, label=np.full(len(scan), 300))])


def test_npy_and_other_fields_in_a_folder(tmp_path: Path) -> None:
    scan = some_scan()
    values = np.column_stack(
        [scan.points, scan.reflectance * 255, np.zeros(len(scan))]
    ).astype(np.float32)
    (tmp_path / "npy").mkdir()
    np.save(tmp_path / "npy" / "a.npy", values)
    values.tofile(tmp_path / "b.bin")
    for source in (
        READERS["folder"](tmp_path / "npy", reflectance_max=255),
        READERS["folder"](tmp_path / "b.bin", fields=5, reflectance_max=255),
    ):
        assert same(source[0].points, scan.points)
        np.testing.assert_allclose(source[0].reflectance, scan.reflectance, atol=1e-7)


@pytest.mark.parametrize("to", ["kitti", "mcap", "range"])
def test_links_to_folders_are_followed_but_not_in_circles(
    tmp_path: Path, to: str
) -> None:
    write_all(to, tmp_path / "real", [some_scan()])
    folder = tmp_path / "in"
    (folder / "a").mkdir(parents=True)
    for link, target in (
        (folder / "b", tmp_path / "real"),
        (folder / "circle", folder),
        (folder / "a" / "up", tmp_path),
        (folder / "a" / "missing", tmp_path / "missing"),
        (tmp_path / "real" / "back", folder / "a"),
    ):
        link.symlink_to(target)
    source = open_scans(folder)
    assert type(source) is READERS[WRITTEN_AS[to]]
    assert source.ids == ("b/000000",)


def beside_clouds(root: Path, name: str, content: bytes) -> Path:
    """A folder of PCD files beside which another file lies."""
    write_all("pcd", root / "clouds", [some_scan()])
    (root / name).write_bytes(content)
    return root


@pytest.mark.parametrize(
    ("name", "content"),
    [("backup.tar", bytes(10240)), ("index.json", b'{"frames": [1]}')],
)
def test_a_file_beside_clouds_does_not_decide_the_layout(
    tmp_path: Path, name: str, content: bytes
) -> None:
    assert open_scans(beside_clouds(tmp_path, name, content)).ids == ("clouds/000000",)


def test_clouds_are_no_range_images(tmp_path: Path) -> None:
    root = beside_clouds(tmp_path, "x", b"")
    np.save(root / "a_poses.npy", np.zeros((10, 4, 4)))
    with pytest.raises(ConfigError, match=r"holds .npy and .pcd files.*the folder of"):
        open_scans(root)


@pytest.mark.parametrize("to", WRITERS)
def test_a_writer_recognises_complete_scans_and_leaves_no_other_files(
    tmp_path: Path, to: str
) -> None:
    writer = WRITERS[to](tmp_path)
    assert not writer.complete(0)
    for index in range(2):
        writer.write(some_scan(index), index)
    assert writer.complete(0) and writer.complete(1) and not writer.complete(2)
    writer.finish()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    writer.finish()
    assert files == {
        path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize("to", ["semantic_kitti", "kitti360"])
def test_a_folder_that_grows_keeps_its_poses_and_boxes(tmp_path: Path, to: str) -> None:
    scans = [some_scan(i) for i in range(4)]
    for part in ((2, 0), (1, 3, 0)):
        writer = WRITERS[to](tmp_path, calibration=some_camera())
        for index in part:
            writer.write(scans[index], index)
        writer.finish()
    for expected, scan in zip(scans, back(to, tmp_path), strict=True):
        assert scan.pose is not None and expected.pose is not None
        np.testing.assert_allclose(scan.pose, expected.pose, atol=1e-8)
        if to == "kitti360":
            assert scan.boxes is not None and expected.boxes is not None
            assert scan.boxes.names == expected.boxes.names


def test_frames_without_a_pose_are_nan_in_semantic_kitti(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(3)]
    scans[1].pose = None
    writer = WRITERS["semantic_kitti"](tmp_path)
    for index, frame in ((0, 0), (1, 2), (2, 4)):
        writer.write(scans[index], index, name=f"05/{frame:06d}")
    writer.finish()
    lines = np.loadtxt(tmp_path / "sequences" / "05" / "poses.txt")
    assert np.isfinite(lines).all(axis=1).tolist() == [True, False, False, False, True]
    assert not (
        tmp_path / "sequences" / "05" / "times.txt"
    ).exists()  # nobody knows them
    assert [scan.pose is None for scan in SemanticKITTI(tmp_path)] == [
        False,
        True,
        False,
    ]


def test_splits(tmp_path: Path) -> None:
    writer = WRITERS["semantic_kitti"](tmp_path)
    for sequence in ("00", "08", "11"):
        writer.write(some_scan(count=40), 0, name=f"{sequence}/000000")
    found = {
        split: [i[:2] for i in SemanticKITTI(tmp_path, split).ids]
        for split in ("train", "val", "test", "all")
    }
    assert found == {
        "train": ["00"],
        "val": ["08"],
        "test": ["11"],
        "all": ["00", "08", "11"],
    }
    writer = WRITERS["kitti360"](tmp_path / "kitti360")
    for drive in range(11):
        writer.write(
            some_scan(count=40), 0, name=f"2013_05_28_drive_{drive:04d}_sync/0000000000"
        )
    by_split = {
        split: [int(i[17:21]) for i in KITTI360(tmp_path / "kitti360", split).ids]
        for split in (
            "r2flow/train",
            "r2flow/test",
            "lidm/train",
            "lidm/val",
            "lidm-camera/train",
        )
    }
    assert by_split == {
        "r2flow/train": [3, 4, 5, 6, 7, 9, 10],
        "r2flow/test": [0, 2],
        "lidm/train": [0, 2, 4, 5, 6, 7, 8, 9, 10],
        "lidm/val": [3],
        "lidm-camera/train": [0, 4, 5, 6, 7, 8, 9, 10],
    }


@pytest.mark.parametrize("below", ["sequences", "sequences/00", "moved"])
def test_sequences_keep_their_labels_wherever_they_are_opened(
    tmp_path: Path, below: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = [some_scan(i, count=40) for i in range(2)]
    write_all("semantic_kitti", tmp_path, scans)
    if below == "moved":
        (tmp_path / "sequences" / "00").rename(tmp_path / "moved")
        (tmp_path / "moved" / "calib.txt").unlink()
    monkeypatch.chdir(tmp_path / below)
    for root in (tmp_path / below, Path()):
        read = open_scans(root)
        assert type(read) is SemanticKITTI
        sequence = "moved" if below == "moved" else "00"
        assert read.ids == (f"{sequence}/000000", f"{sequence}/000001")
        assert same(read[1].label, scans[1].label)
    assert type(open_scans(tmp_path / below / "..")) is SemanticKITTI


def test_drives_of_kitti360_are_not_those_of_kitti_raw(tmp_path: Path) -> None:
    """Their folders are alike; the sensors and the recordings are others."""
    write_all("kitti360", tmp_path, [some_scan()])
    assert type(open_scans(tmp_path)) is KITTI360
    raw = tmp_path / "data_3d_raw"
    for root in (raw, raw / "2013_05_28_drive_0000_sync"):
        with pytest.raises(DataError, match="Give the folder that holds data_3d_raw"):
            open_scans(root)


def test_image_sets_choose_the_frames(tmp_path: Path) -> None:
    write_all("kitti_object", tmp_path, [some_scan(i, count=40) for i in range(3)])
    (tmp_path / "ImageSets" / "val.txt").write_text("000001\n")
    assert KITTIObject(tmp_path, "val").ids == ("training/000001",)
    assert len(KITTIObject(tmp_path, "train")) == len(KITTIObject(tmp_path, "all")) == 3


def test_names_are_kept_where_a_layout_can_keep_them(tmp_path: Path) -> None:
    frame = "2013_05_28_drive_0003_sync/0000000042"
    found = {
        to: WRITERS[to](tmp_path).path(7, frame).relative_to(tmp_path).as_posix()
        for to in WRITERS
    }
    assert found == {
        "kitti": f"{frame}.bin",
        "semantic_kitti": "sequences/03/velodyne/000042.bin",
        "kitti_object": "training/velodyne/000007.bin",
        "kitti360": f"data_3d_raw/{frame.replace('/', '/velodyne_points/data/')}.bin",
        "range": f"{frame}.npz",
        "pcd": f"{frame}.pcd",
        "ply": f"{frame}.ply",
        "npz": f"{frame}.npz",
        "png": f"range/{frame.replace('/', '_')}.png",
        "webdataset": f".lidar_synth/000000007/{frame}.tar",
        "mcap": f"{frame}.mcap",
        "cosmos": f"{frame}.safetensors",
    }
    assert WRITERS["kitti360"](tmp_path).path(7, "03/000042") == WRITERS["kitti360"](
        tmp_path
    ).path(7, frame)
    assert (
        WRITERS["semantic_kitti"](tmp_path, sequence="21").path(7, "my_scan").stem
        == "000007"
    )  # type: ignore[call-arg]


def test_a_folder_of_npz_files_has_the_sensor_stored_in_them(tmp_path: Path) -> None:
    sensor = presets()["os1_128"]
    WRITERS["npz"](tmp_path).write(random_scan(sensor, 500, seed=0), 0)
    assert open_scans(tmp_path).sensor == sensor
    (tmp_path / "000000.npz").write_bytes(b"")
    # What is wrong is said when it is read.
    assert open_scans(tmp_path).sensor.name == "hdl64e_kitti"
