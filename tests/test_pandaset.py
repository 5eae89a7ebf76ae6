"""PandaSet: points, labels, boxes, poses and cameras of both sensors, and files that are not
PandaSet's."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pandaset_files import (
    CUBOIDS,
    drive,
    measured,
    write_pandaset,
    write_table,
    write_track,
)

from lidar_synth.datasets.classes import IGNORE, NAMES, PANDASET
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import WRITERS, PandaSet, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.formats.pandaset import CAMERAS
from lidar_synth.formats.pandaset_cuboids import BOXES
from lidar_synth.geometry.sensor import load_sensor


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pandaset")
    write_pandaset(folder)
    return folder


@pytest.mark.parametrize("sensor", ["pandar64", "pandar_gt"])
def test_points_are_as_they_were_measured(root: Path, sensor: str) -> None:
    for index, scan in enumerate(PandaSet(root, sensor=sensor)):
        expected, time = measured(index, sensor)
        assert scan.sensor == load_sensor(sensor) and scan.id == f"007/{index:02d}"
        assert np.allclose(scan.points, expected.points, atol=1e-4)
        assert np.allclose(scan.reflectance, expected.reflectance, atol=1e-6)
        assert np.allclose(scan.time, time, atol=1e-5)


def test_compensated_points_are_in_the_frame_of_the_pose(root: Path) -> None:
    """Both give the same points of the world; the compensated ones with one pose for all."""
    measured_scan = PandaSet(root)[1]
    scan = PandaSet(root, motion_compensated=True)[1]
    assert np.array_equal(scan.pose, measured_scan.pose) and np.array_equal(
        scan.ring, measured_scan.ring
    )
    far = np.linalg.norm(scan.points - measured_scan.points, axis=1)
    assert (
        far[abs(scan.time) < 0.001].max() < 0.3
        and 1 < far[scan.time < -0.09].max() < 15
    )
    at_the_end = np.argmin(abs(scan.time))
    world = scan.pose[:3, :3] @ scan.points[at_the_end] + scan.pose[:3, 3]
    assert np.linalg.norm(world - drive(3)[1][1][:3, 3]) < 200


def test_rings_are_the_nearest_beams(root: Path) -> None:
    scan = PandaSet(root)[0]
    elevation = np.degrees(
        np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    )
    beams = np.array(scan.sensor.elevations)
    assert (
        np.array_equal(scan.ring, abs(elevation[:, None] - beams).argmin(1))
        and scan.ring.dtype == np.int16
    )
    assert PandaSet(root, sensor="pandar_gt")[0].ring is None
    fewer = replace(load_sensor("pandar64"), elevations=beams[::2], azimuths=None)
    rings = PandaSet(root, sensor=fewer)[0].ring
    assert rings.max() < 32 and len(rings) == len(scan)


@pytest.mark.parametrize("sensor", ["pandar64", "pandar_gt"])
def test_labels_belong_to_their_points(root: Path, sensor: str) -> None:
    scan = PandaSet(root, sensor=sensor)[2]
    first, second = (len(measured(2, name)[0]) for name in ("pandar64", "pandar_gt"))
    classes = np.random.default_rng(2).integers(1, 43, first + second)
    raw = classes[:first] if sensor == "pandar64" else classes[first:]
    assert np.array_equal(scan.raw_label, raw) and scan.raw_label.dtype == np.uint32
    assert np.array_equal(scan.label, PANDASET.decode(raw))


def test_every_class_is_mapped() -> None:
    assert set(PANDASET.to_train) == set(range(43))
    names = {
        i: "" if train == IGNORE else NAMES[train]
        for i, train in PANDASET.to_train.items()
    }
    assert [
        names[i] for i in (5, 6, 7, 10, 12, 13, 14, 23, 25, 26, 31, 36, 39, 41)
    ] == [
        "vegetation",
        "terrain",
        "road",
        "road",
        "sidewalk",
        "car",
        "truck",
        "other-vehicle",
        "motorcycle",
        "bicycle",
        "person",
        "traffic-sign",
        "fence",
        "building",
    ]
    assert [i for i, name in names.items() if not name] == [
        0,
        1,
        2,
        3,
        4,
        24,
        32,
        33,
        34,
        37,
        40,
        42,
    ]


@pytest.mark.parametrize(
    ("sensor", "names"),
    [("pandar64", ("Car", "Pedestrian")), ("pandar_gt", ("Cyclist", "Truck"))],
)
def test_boxes_are_those_that_the_sensor_saw(
    root: Path, sensor: str, names: tuple[str, ...]
) -> None:
    boxes = PandaSet(root, sensor=sensor)[1].boxes
    assert (
        boxes.names == names
        and len(set(boxes.instance)) == len(names)
        and boxes.instance.min() >= 0
    )
    assert np.array_equal(
        boxes.instance, PandaSet(root, sensor=sensor)[2].boxes.instance
    )


@pytest.mark.parametrize("motion_compensated", [False, True])
def test_boxes_stand_where_they_do_in_the_world(
    root: Path, motion_compensated: bool
) -> None:
    """The front of a box, by its corners: PandaSet's boxes have their length along y before they
    are turned."""
    scan = PandaSet(root, motion_compensated=motion_compensated)[1]
    corners = (
        scan.boxes.corners().astype(np.float64) @ scan.pose[:3, :3].T + scan.pose[:3, 3]
    )
    for i, index in enumerate((0, 1)):
        row = {key: values[index] for key, values in CUBOIDS.items()}
        centre = np.array([row[f"position.{axis}"] for axis in "xyz"])
        ahead = np.array([-np.sin(row["yaw"]), np.cos(row["yaw"])])
        assert np.allclose(corners[i].mean(0), centre, atol=1e-4)
        front = corners[i][[0, 3, 4, 7]].mean(0)[:2] - centre[:2]
        # The sensor is tilted, boxes are not.
        assert np.allclose(front, ahead * row["dimensions.y"] / 2, atol=0.02)
        assert np.isclose(scan.boxes.values[i, 4], row["dimensions.x"])
        assert np.isclose(scan.boxes.values[i, 5], row["dimensions.z"])


def test_boxes_without_the_columns_of_some_sequences(tmp_path: Path) -> None:
    write_pandaset(tmp_path, 2)
    columns = {
        k: v
        for k, v in CUBOIDS.items()
        if "." not in k or k.startswith(("position", "dimensions"))
    }
    write_table(tmp_path / "007/annotations/cuboids/00.pkl.gz", columns)
    assert PandaSet(tmp_path)[0].boxes.names == ("Car", "Pedestrian", "Misc", "Truck")
    write_table(
        tmp_path / "007/annotations/cuboids/00.pkl.gz",
        {k: np.array(v)[:0] for k, v in columns.items()},
    )
    assert len(PandaSet(tmp_path)[0].boxes) == 0
    (tmp_path / "007/annotations/cuboids/00.pkl.gz").unlink()
    assert PandaSet(tmp_path)[0].boxes is None


def test_classes_of_boxes_have_names_of_kitti() -> None:
    kitti = {
        "Car",
        "Van",
        "Truck",
        "Pedestrian",
        "Person_sitting",
        "Cyclist",
        "Tram",
        "Misc",
        None,
    }
    assert set(BOXES.values()) <= kitti and len(BOXES) == 28
    assert (BOXES["Pickup Truck"], BOXES["Bus"], BOXES["Cones"]) == (
        "Truck",
        "Misc",
        None,
    )


def test_a_camera_sees_what_the_sensor_passes(root: Path) -> None:
    """A point that stands in the world appears where the camera's own pose puts it."""
    times, poses = drive(3)
    for compensated in (False, True):
        source = PandaSet(root, motion_compensated=compensated)
        scan = source[1]
        camera = source.calibration(1)
        assert camera.image_size == (1920, 1080) and camera.projection[0, 0] == 1970.0
        at = np.argmin(abs(scan.time - (0 if compensated else -0.05)))
        world = (
            PandaSet(root, motion_compensated=True)[1].points[at] @ scan.pose[:3, :3].T
            + scan.pose[:3, 3]
        )
        # The camera's poses are those of the vehicle here.
        expected = (np.linalg.inv(poses[1]) @ [*world, 1])[:3]
        found = (camera.camera_from_sensor @ [*scan.points[at], 1])[:3]
        assert np.allclose(found, expected, atol=0.3 if not compensated else 1e-3), (
            times[1]
        )


def test_sequences_and_cameras_are_chosen(tmp_path: Path) -> None:
    write_pandaset(tmp_path, 2)
    (tmp_path / "007").rename(tmp_path / "019")
    write_pandaset(tmp_path, 3)
    assert PandaSet(tmp_path).ids == ("007/00", "007/01", "007/02", "019/00", "019/01")
    with pytest.raises(DataError, match="has no sequence 019; expected some of none"):
        PandaSet(tmp_path / "019", sequences=("019",))
    assert (
        PandaSet(tmp_path, sequences=("019",)).ids
        == open_scans(tmp_path / "019").ids
        == ("019/00", "019/01")
    )
    with pytest.raises(
        DataError, match="has no sequence 020; expected some of 007, 019"
    ):
        PandaSet(tmp_path, sequences=("020",))
    with pytest.raises(
        ConfigError, match="camera 'front'.*'front_camera', 'front_left_camera'"
    ):
        PandaSet(tmp_path, camera="front")
    back = PandaSet(tmp_path, camera=CAMERAS[-1])
    assert back.calibration(0) is None and back[0].image_path is None
    image = tmp_path / "007/camera/back_camera/00.jpg"
    image.parent.mkdir()
    image.write_bytes(b"")
    assert back[0].image_path == image
    with pytest.raises(
        DataError,
        match="expected PandaSet's sequences.* timestamps.json, annotations and cameras$",
    ):
        PandaSet(tmp_path / "007" / "camera")


def test_scans_of_a_sequence_are_written_beside_it(tmp_path: Path) -> None:
    write_pandaset(tmp_path, 2)
    [sequence] = [path for path in tmp_path.iterdir() if path.is_dir()]
    report = convert(
        PandaSet(sequence), WRITERS["npz"](tmp_path / "out"), progress=False
    )
    assert report.written == 2


def test_a_sequence_without_labels(tmp_path: Path) -> None:
    write_pandaset(tmp_path, 2)
    for path in (tmp_path / "007/annotations/semseg").iterdir():
        path.unlink()
    with pytest.raises(FileError, match="semseg/00.pkl.gz cannot be read"):
        PandaSet(tmp_path)[0]
    (tmp_path / "007/annotations/semseg").rmdir()
    scan = PandaSet(tmp_path)[0]
    assert scan.label is None and scan.raw_label is None


def rewrite(path: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        file = folder / path
        file.write_text(json.dumps(change(json.loads(file.read_text()))))

    return apply


def retable(path: str, columns: dict[str, Any]) -> Callable[[Path], None]:
    return lambda folder: write_table(folder / path, columns)


POINTS = {
    "x": [1.0] * 3,
    "y": [2.0] * 3,
    "z": [1.0] * 3,
    "i": [9.0] * 3,
    "t": [1.5e9] * 3,
    "d": [0] * 3,
}
NUMBERS = {"w": 0, "x": 0, "y": 0, "z": 0}
BOX = {key: values[:1] for key, values in CUBOIDS.items()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            rewrite("lidar/poses.json", lambda poses: poses[:1]),
            "poses.json.*another number of poses",
        ),
        (
            rewrite("lidar/poses.json", lambda poses: [poses[0]] * 2 + [7]),
            "poses.json.*a pose of type int",
        ),
        (
            rewrite("lidar/poses.json", lambda poses: [{"position": 0}] * 3),
            "poses.json.*no numbers.*'w'",
        ),
        (
            rewrite(
                "lidar/poses.json",
                lambda poses: [p | {"heading": NUMBERS | {"w": 2}} for p in poses],
            ),
            "poses.json.*a heading of length 2; expected a unit quaternion",
        ),
        (
            rewrite(
                "lidar/poses.json",
                lambda poses: [
                    p | {"position": NUMBERS | {"x": float("nan")}} for p in poses
                ],
            ),
            "poses.json.*something else than finite numbers",
        ),
        (
            rewrite("lidar/timestamps.json", lambda times: times[::-1]),
            "poses.json.*timestamps that do not increase",
        ),
        (
            rewrite("lidar/timestamps.json", lambda times: [t + 60 for t in times]),
            "00.pkl.gz: times .* expected -1",
        ),
        (
            rewrite("lidar/timestamps.json", lambda times: "now"),
            "poses.json.*another number of poses",
        ),
        (
            lambda folder: (folder / "lidar/poses.json").unlink(),
            "poses.json cannot be read",
        ),
        (
            lambda folder: (
                write_track(folder / "lidar", *(v[:2] for v in drive(2)))
                or (folder / "lidar/00.pkl.gz").rename(folder / "lidar/05.pkl.gz")
            ),
            "frame '0[25]', but 2 poses",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"d": [1] * 3}),
            "00.pkl.gz holds no points",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"i": [9.0, 400.0, 1.0]}),
            r"to 400; expected values in \[0, 255\]",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"x": [1.0, np.nan, 1.0]}),
            "1 of 3 points are NaN or infinite",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"x": [1.0, 1e9, 1.0]}),
            r"a coordinate of 9[.\d]+e\+08 m",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"t": [1.5e9, np.nan, 1.5e9]}),
            "times from nan s",
        ),
        (
            retable("lidar/00.pkl.gz", POINTS | {"x": ["a", "b", "c"]}),
            "00.pkl.gz.*x of type object",
        ),
        (
            retable("lidar/00.pkl.gz", {"x": [1.0]}),
            "00.pkl.gz has no column y, z, i, t, d",
        ),
        (
            retable("annotations/semseg/00.pkl.gz", {"class": [13]}),
            "has 1 labels, .*00.pkl.gz has",
        ),
        (
            retable("annotations/semseg/00.pkl.gz", {"class": [43] * 800}),
            "800 labels|unknown class ids",
        ),
        (
            retable("annotations/semseg/00.pkl.gz", {"class": [1.0] * 800}),
            "columns class of type float64",
        ),
        (
            retable("annotations/cuboids/00.pkl.gz", BOX | {"label": ["Cat"]}),
            "boxes of class .'Cat'.",
        ),
        (
            retable("annotations/cuboids/00.pkl.gz", BOX | {"yaw": [np.inf]}),
            "00.pkl.gz: boxes with a non-finite value",
        ),
        (
            retable("annotations/cuboids/00.pkl.gz", BOX | {"dimensions.x": [0.0]}),
            "size that is not positive",
        ),
        (
            retable("annotations/cuboids/00.pkl.gz", BOX | {"yaw": ["1"]}),
            "columns yaw of type object",
        ),
    ],
)
def test_files_that_are_not_pandasets(
    tmp_path: Path, change: Callable[[Path], Any], message: str
) -> None:
    write_pandaset(tmp_path)
    change(tmp_path / "007")
    with pytest.raises((DataError, FileError), match=message):
        list(PandaSet(tmp_path))


def test_bad_points_are_dropped_with_their_labels(tmp_path: Path) -> None:
    write_pandaset(tmp_path, 2)
    write_table(tmp_path / "007/lidar/00.pkl.gz", POINTS | {"x": [1.0, np.nan, 3.0]})
    write_table(tmp_path / "007/annotations/semseg/00.pkl.gz", {"class": [7, 13, 41]})
    source = PandaSet(tmp_path, on_bad="drop-points")
    assert source[0].raw_label.tolist() == [7, 41] and source.dropped == {"007/00": 1}


@pytest.mark.parametrize("index", [0, 1])
def test_real_frames_agree_with_their_reference(
    labelled_scans: Path, index: int
) -> None:
    """The reference was computed by other code, and its beams lie on Hesai's table."""
    folder = labelled_scans / "pandaset"
    source = open_scans(folder / "as_published")
    assert isinstance(source, PandaSet) and source.ids == ("002/00", "002/40")
    scan = source[index]
    expected = np.load(folder / "sensor_frame" / f"{source.ids[index][-2:]}.npz")
    assert np.abs(scan.points - expected["points"]).max() < 1e-4
    assert np.array_equal(np.round(scan.reflectance * 255), expected["reflectance"])
    assert np.array_equal(scan.ring, expected["ring"]) and np.array_equal(
        scan.raw_label, expected["label"]
    )
    assert np.allclose(scan.time, expected["time"])
    kept = np.array([BOXES[name] is not None for name in expected["box_names"]])
    assert np.allclose(scan.boxes.values, expected["boxes"][kept], atol=1e-4)
    assert scan.boxes.names == tuple(
        BOXES[name] for name in expected["box_names"][kept]
    )
    elevation = np.degrees(
        np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    )
    off = abs(elevation - np.array(scan.sensor.elevations)[scan.ring])
    assert (off < 0.05).mean() > 0.99
    compensated = PandaSet(folder / "as_published", motion_compensated=True)[index]
    assert np.abs(compensated.points - scan.points).max() > (0.3 if index else 0.001)


def test_the_preset_has_the_beams_of_the_table(labelled_scans: Path) -> None:
    table = np.loadtxt(
        labelled_scans / "pandaset" / "pandar64_elevations.csv",
        delimiter=",",
        skiprows=1,
    )
    sensor = load_sensor("pandar64")
    assert sensor.elevations == tuple(table[:, 1]) and sensor.azimuths == tuple(
        table[:, 2]
    )


def test_azimuths_and_firings_of_the_preset_agree_with_the_times(
    labelled_scans: Path,
) -> None:
    """A point's azimuth is that of its firing, which turns 0.2 degrees, and its laser's offset."""
    scan = open_scans(labelled_scans / "pandaset" / "as_published")[0]
    sensor = scan.sensor
    azimuth = -np.arctan2(scan.points[:, 1], scan.points[:, 0])
    offset = np.radians(sensor.azimuths)[scan.ring]
    residual = np.exp(1j * (azimuth - offset - 20 * np.pi * scan.time))
    spread = np.degrees(np.std(np.angle(residual / residual.mean())))
    unaware = np.exp(1j * (azimuth - 20 * np.pi * scan.time))
    assert spread < 0.25 < 2 < np.degrees(np.std(np.angle(unaware / unaware.mean())))
    one = np.sort((azimuth - offset)[scan.ring == 30])
    assert abs(np.degrees(np.median(np.diff(one))) - 360 / sensor.columns) < 1e-3


def test_the_forward_sensor_sees_ahead(labelled_scans: Path) -> None:
    scan = PandaSet(labelled_scans / "pandaset" / "as_published", sensor="pandar_gt")[1]
    assert len(scan) == 62089 and scan.ring is None
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    elevation = np.degrees(
        np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1))
    )
    assert abs(azimuth).max() < 32
    assert scan.sensor.down < elevation.min() and elevation.max() < scan.sensor.up
    near_road = scan.points[
        (scan.label == NAMES.index("road")) & (scan.points[:, 0] < 15)
    ]
    assert np.median(near_road[:, 2]) == pytest.approx(-2.05, abs=0.1)


@pytest.mark.parametrize("motion_compensated", [False, True])
def test_vehicles_project_into_the_image_where_their_boxes_do(
    labelled_scans: Path, motion_compensated: bool
) -> None:
    source = PandaSet(
        labelled_scans / "pandaset" / "as_published",
        motion_compensated=motion_compensated,
    )
    scan = source[1]
    camera = source.calibration(1)
    assert scan.image_path.name == "40.jpg"
    inside = scan.boxes.contain(scan.points)
    cars = [
        i
        for i, name in enumerate(scan.boxes.names)
        if name == "Car" and inside[i].sum() > 300
    ]
    shares = []
    for i in cars:
        corners, depth = camera.pixels(scan.boxes[[i]].corners()[0])
        pixels, _ = camera.pixels(scan.points[inside[i]])
        if (depth > 2).all():
            shares.append(
                ((pixels > corners.min(0) - 3) & (pixels < corners.max(0) + 3))
                .all(1)
                .mean()
            )
    assert len(shares) >= 3 and min(shares) > 0.97
