"""Labels of KITTI-360's scans, recovered from accumulated clouds of the town, whose labels are
known."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lidar_synth import KITTI360, MixedScans, open_scans
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.formats.kitti360 import (
    LABELLED,
    boxes_path,
    confidence_path,
    label_file,
    labels_folder,
    scans_folder,
)
from lidar_synth.formats.kitti360_boxes import read_boxes
from lidar_synth.formats.kitti360_poses import (
    imu_from_sensor,
    read_calibration,
    read_poses,
)
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.kitti360 import labels as kitti360_labels
from lidar_synth.lab.kitti360.accumulated import (
    PROPERTIES,
    find_windows,
    read_cloud,
    write_cloud,
)
from lidar_synth.lab.kitti360.labels import label_scans, plan_labels
from lidar_synth.lab.kitti360.recovery import ego_motion, undo_ego_motion
from lidar_synth.lab.kitti360.report import LabelReport
from lidar_synth.lab.town import Town, export_town
from lidar_synth.lab.town.accumulate import STEP, windows_of

DRIVE = "2013_05_28_drive_0004_sync"
SCANS = 20


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("embreex")
    out = tmp_path_factory.mktemp("k360") / "town"
    sensor = replace(load_sensor("hdl64e_kitti360"), name="coarse", columns=256)
    export_town(
        Town(3, sensor, SCANS),
        out,
        "kitti360",
        camera=False,
        accumulate=True,
        progress=False,
    )
    return out


@pytest.fixture(scope="module")
def labelled(
    root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, LabelReport]:
    out = tmp_path_factory.mktemp("labels")
    return out, label_scans(root, out, against=root, progress=False)


@pytest.fixture
def copy(root: Path, tmp_path: Path) -> Path:
    """A copy of the dataset, without labels per scan, that a test may change; its scans are
    links."""
    out = tmp_path / "town"
    shutil.copytree(root / "data_3d_raw", out / "data_3d_raw", copy_function=os.link)
    for name in ("data_poses", "calibration", "data_3d_bboxes", "data_3d_semantics"):
        shutil.copytree(root / name, out / name)
    return out


def shares(report: LabelReport, part: int) -> NDArray[np.float64]:
    """Share covered, share right of these, and the same of moving cars, in frames of one remainder
    by ``STEP``."""
    rows = [c for name, c in report.compared.items() if int(name[-10:]) % STEP == part]
    known, covered, right, cars, seen, good = np.sum(rows, axis=0)
    assert len(rows) == SCANS / STEP and cars > 100
    return np.array([covered / known, right / covered, seen / cars, good / seen])


@pytest.mark.parametrize("part", range(STEP), ids=["accumulated", "not accumulated"])
def test_labels_of_the_town_are_recovered(
    labelled: tuple[Path, LabelReport], part: int
) -> None:
    covered, right, cars_covered, cars_right = shares(labelled[1], part)
    assert covered > 0.9 and right > 0.97
    assert cars_covered > 0.9 and cars_right > 0.9 and cars_covered * cars_right > 0.9


def test_confidence_tells_wrong_labels_from_right_ones(
    root: Path, labelled: tuple[Path, LabelReport]
) -> None:
    confidence = []
    right = []
    for truth, scan in zip(
        KITTI360(root), KITTI360(root, labels=labelled[0]), strict=True
    ):
        assert (
            scan.confidence is not None
            and scan.label is not None
            and truth.label is not None
        )
        known = (scan.label != 255) & (truth.label != 255)
        confidence.append(scan.confidence[known])
        right.append((scan.label == truth.label)[known])
        assert not scan.confidence[scan.raw_label == 0].any()
    sure = np.concatenate(confidence) > 0.8
    assert np.concatenate(right)[sure].mean() > max(
        0.99, np.concatenate(right)[~sure].mean() + 0.03
    )


def test_a_segmenter_gets_only_scans_with_labels(
    root: Path, labelled: tuple[Path, LabelReport]
) -> None:
    moved = label_file(labelled[0], DRIVE, f"{5:010d}")
    moved.rename(labelled[0] / "kept")  # type: ignore[union-attr]
    scans = KITTI360(root, labels=labelled[0])
    (labelled[0] / "kept").rename(labels_folder(labelled[0], DRIVE) / f"{5:010d}.label")
    assert len(scans) == SCANS - 1 and f"{DRIVE}/{5:010d}" not in scans.ids
    assert all(scan.label is not None for scan in scans)
    assert MixedScans(scans, ratio=0)[0]["label"].max() < 256
    with pytest.raises(DataError, match="lidar-synth label kitti360"):
        KITTI360(root, labels=root / "calibration")


@pytest.mark.parametrize("in_place", [False, True])
def test_the_path_of_labels_opens_the_labelled_scans(
    in_place: bool, copy: Path, labelled: tuple[Path, LabelReport]
) -> None:
    out = copy if in_place else copy.parent / "labels"
    shutil.copytree(labelled[0] / LABELLED, out / LABELLED)
    if in_place:  # as another program leaves them
        (out / LABELLED / "report.json").unlink()
    (labels_folder(out, DRIVE) / f"{5:010d}.label").unlink()
    names = [f"{DRIVE}/{i:010d}" for i in range(SCANS) if i != 5]
    for path in (out / LABELLED,) if in_place else (out / LABELLED, out):
        scans = open_scans(path, split="r2flow/train")
        assert list(scans.ids) == names and scans[0].confidence is not None
        assert open_scans(scans.root).ids == scans.ids and scans[0].pose is not None
    assert len(open_scans(copy)) == SCANS
    with pytest.raises(ConfigError, match="open the folder that lidar-synth label"):
        project(open_scans(copy)[5], channels=["label"])


def test_labels_of_a_dataset_that_has_moved_say_so(tmp_path: Path) -> None:
    (tmp_path / LABELLED).mkdir()
    (tmp_path / LABELLED / "report.json").write_text('{"root": "elsewhere"}')
    with pytest.raises(DataError, match="elsewhere has no drive.*has moved"):
        open_scans(tmp_path)


def test_labels_that_were_compared_are_kept_without(
    root: Path, labelled: tuple[Path, LabelReport], tmp_path: Path
) -> None:
    out, first = labelled
    shutil.copytree(out, tmp_path / "labels")
    assert label_scans(root, tmp_path / "labels", progress=False).kept == 2
    again = label_scans(root, tmp_path / "labels", against=root, progress=False)
    assert again.kept == 2 and again.to_dict() == first.to_dict()


@pytest.mark.slow
def test_a_rerun_repeats_only_what_is_missing_or_changed(
    copy: Path, tmp_path: Path
) -> None:
    out = tmp_path / "labels"
    first = label_scans(copy, out, progress=False)
    assert first.kept == 0 and first.labelled == {DRIVE: SCANS}
    content = {p: p.read_bytes() for p in sorted(out.rglob("*.label"))}
    label_file(out, DRIVE, f"{0:010d}").unlink()  # type: ignore[union-attr]
    again = label_scans(copy, out, jobs=2, progress=False)
    assert again.kept == 1 and again.to_dict() == first.to_dict()
    assert {p: p.read_bytes() for p in sorted(out.rglob("*.label"))} == content
    confidence = confidence_path(out, DRIVE, f"{0:010d}")
    lost = confidence.read_bytes()
    confidence.unlink()
    assert label_scans(copy, out, progress=False).kept == 1
    assert confidence.read_bytes() == lost
    poses = copy / "data_poses" / DRIVE / "poses.txt"
    poses.write_text(poses.read_text() + "\n")
    assert label_scans(copy, out, progress=False).kept == 0
    mounted = next((copy / "calibration").glob("calib_cam_to_velo*.txt"))
    mounted.write_text(mounted.read_text() + "\n")
    assert label_scans(copy, out, progress=False).kept == 0
    _beside(copy)
    with pytest.raises(DataError, match="do not lie on"):
        label_scans(copy, out, progress=False)
    assert len(list(out.rglob("*.label"))) <= SCANS // 4  # no labels of the run before


def _shorten(copy: Path) -> None:
    """Keep the first four scans."""
    for path in sorted(scans_folder(copy, DRIVE).iterdir())[4:]:
        path.unlink()


def _turned(copy: Path) -> None:
    _change_poses(
        copy,
        lambda frame, pose: (
            pose
            @ np.array([(0.9, -0.43589, 0, 0), (0.43589, 0.9, 0, 0), *np.eye(4)[2:]])
        ),
    )


def _beside(copy: Path) -> None:
    _change_poses(
        copy, lambda frame, pose: pose + np.array([[0, 0, 0, 1.5]] * 2 + [[0] * 4] * 2)
    )


def _elsewhere(copy: Path) -> None:
    _change_poses(
        copy,
        lambda frame, pose: pose + np.array([[0, 0, 0, 700.0]] * 2 + [[0] * 4] * 2),
    )


def _torn(copy: Path) -> None:
    _change_poses(
        copy,
        lambda frame, pose: (
            pose + np.array([[0, 0, 0, 1e5 * (frame % 2)], *[[0] * 4] * 3])
        ),
    )


def _change_poses(
    copy: Path, change: Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
) -> None:
    path = copy / "data_poses" / DRIVE / "poses.txt"
    lines = np.loadtxt(path)
    for line in lines:
        pose = np.vstack([line[1:].reshape(3, 4), (0, 0, 0, 1)])
        line[1:] = change(int(line[0]), pose)[:3].ravel()
    np.savetxt(path, lines)


@pytest.mark.parametrize(
    "change", [_turned, _beside, _elsewhere, _torn], ids=lambda f: f.__name__.strip("_")
)
def test_wrong_poses_are_an_error_and_write_no_labels(
    copy: Path, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    change(copy)
    with pytest.raises(
        DataError, match="do not lie on its accumulated clouds|spread over"
    ):
        label_scans(copy, tmp_path / "labels", progress=False)
    assert len(list((tmp_path / "labels").rglob("*.label"))) <= SCANS // 4


WRONG = {
    "0.4 m high": (0, 0, 0.4, 0),
    "1 m along": (1, 0, 0, 0),
    "0.3 m aside": (0, 0.3, 0, 0),
    "2 degrees": (0, 0, 0, 2),
}
"""Errors of all poses of a drive in the sensor's frame: metres, and degrees of yaw."""


@pytest.mark.parametrize("error", WRONG)
def test_scans_off_the_clouds_are_laid_onto_them(
    copy: Path,
    root: Path,
    labelled: tuple[Path, LabelReport],
    tmp_path: Path,
    error: str,
) -> None:
    _shorten(copy)
    x, y, z, yaw = WRONG[error]
    c = np.cos(np.radians(yaw))
    s = np.sin(np.radians(yaw))
    wrong = np.array([(c, -s, 0, x), (s, c, 0, y), (0, 0, 1, z), (0, 0, 0, 1)])
    mount = imu_from_sensor(read_calibration(root))
    _change_poses(copy, lambda frame, pose: pose @ mount @ wrong @ np.linalg.inv(mount))
    report = label_scans(copy, tmp_path / "labels", against=root, progress=False)
    assert report.labelled == {DRIVE: 4} and report.misfits == {DRIVE: []}
    assert len(report.moved[DRIVE]) == 4 and np.allclose(
        report.moved[DRIVE], np.hypot(x, y) + z, atol=0.15
    )
    assert labelled[1].moved == {DRIVE: []}
    before = [labelled[1].compared[name] for name in report.compared]
    known, covered, right = np.sum(list(report.compared.values()), axis=0)[:3]
    assert np.allclose(
        (covered / known, right / known),
        np.sum(before, axis=0)[1:3] / known,
        atol=0.005,
    )


def test_frames_without_window_or_pose_are_counted(copy: Path, tmp_path: Path) -> None:
    first, _ = find_windows(copy, DRIVE)
    first.static.unlink()  # frames 0 to 7 are in no other window
    poses = copy / "data_poses" / DRIVE / "poses.txt"
    poses.write_text(
        "".join(line for line in poses.open() if int(line.split()[0]) not in (12, 13))
    )
    plan = plan_labels(copy)
    assert (
        plan.outside == {DRIVE: 8}
        and plan.without_pose == {DRIVE: 2}
        and plan.frames == SCANS - 10
    )
    report = label_scans(copy, tmp_path, progress=False)
    assert report.labelled == {DRIVE: SCANS - 10}
    assert {int(p.stem) for p in tmp_path.rglob("*.label")} == {*range(8, SCANS)} - {
        12,
        13,
    }


def test_moving_cars_without_accumulated_points_get_the_class_of_their_boxes(
    root: Path, copy: Path, tmp_path: Path
) -> None:
    for window in find_windows(copy, DRIVE):
        assert window.dynamic is not None
        window.dynamic.unlink()
    report = label_scans(copy, tmp_path, against=root, progress=False)
    for part in range(STEP):
        *_, cars_covered, cars_right = shares(report, part)
        assert cars_covered > 0.6 and cars_right > 0.9


def test_empty_dynamic_clouds_are_read_as_in_the_dataset(copy: Path) -> None:
    window = find_windows(copy, DRIVE)[0]
    assert window.dynamic is not None
    write_cloud(window.dynamic, {name: np.zeros(0) for name in PROPERTIES})
    assert len(read_cloud(window.dynamic)) == 0 and window.dynamic.stat().st_size < 400


def _skewed(
    points: NDArray[np.float32], motion: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Points as a sensor measures them that moves while it turns: the inverse of
    ``undo_ego_motion``."""
    raw = points.astype(np.float64)
    for _ in range(20):
        raw -= undo_ego_motion(raw, motion) - points
    return raw.astype(np.float32)


@pytest.mark.slow
def test_scans_measured_while_driving_are_recognised_and_labelled(
    root: Path, copy: Path, tmp_path: Path
) -> None:
    poses = read_poses(root, DRIVE, read_calibration(root))
    for frame in range(SCANS):
        path = scans_folder(copy, DRIVE) / f"{frame:010d}.bin"
        scan = np.fromfile(path, np.float32).reshape(-1, 4)
        scan[:, :3] = _skewed(scan[:, :3], ego_motion(poses, frame))
        path.unlink()  # a link to the original
        scan.tofile(path)
    report = label_scans(copy, tmp_path, against=root, progress=False)
    records = [
        json.loads(p.read_text())
        for p in (tmp_path / "data_3d_semantics_scan" / DRIVE / "windows").iterdir()
    ]
    assert all(record["turns"] for record in records)
    for part in range(STEP):
        covered, right, *_ = shares(report, part)
        assert covered > 0.9 and right > 0.97


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def _without_confidence(path: Path) -> None:
    path.write_bytes(
        path.read_bytes().replace(b"float confidence", b"float visibility")
    )


def _unknown_class(path: Path) -> None:
    values = {
        n: np.array(read_cloud(path)[n]) for n in read_cloud(path).dtype.names or ()
    }
    values["semantic"][5] = 99
    write_cloud(path, values)


def _huge_instance(path: Path) -> None:
    values = {
        n: np.array(read_cloud(path)[n]) for n in read_cloud(path).dtype.names or ()
    }
    values["instance"][5] = 1 << 20
    write_cloud(path, values)


def _text(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"binary_little_endian", b"ascii"))


def _twice(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"uchar red", b"uchar blue"))


def _many(path: Path) -> None:
    head, mark, rest = path.read_bytes().partition(b"element vertex ")
    path.write_bytes(head + mark + b"9" + rest)


def _misnamed(path: Path) -> None:
    path.rename(path.with_name("9_2.ply"))


DAMAGES = [
    _truncated,
    _without_confidence,
    _unknown_class,
    _huge_instance,
    _text,
    _twice,
    _many,
    _misnamed,
]


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda f: f.__name__.strip("_"))
def test_a_damaged_cloud_is_named(
    copy: Path, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    damage(find_windows(copy, DRIVE)[0].static)
    with pytest.raises(DataError, match=r"static/.*\.ply"):
        label_scans(copy, tmp_path / "labels", progress=False)


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("data_3d_semantics", "Accumulated Point Clouds"),
        ("data_poses", "poses.txt"),
        ("calibration", "calibration/"),
    ],
)
def test_a_missing_part_of_the_dataset_is_named(
    copy: Path, tmp_path: Path, missing: str, message: str
) -> None:
    shutil.rmtree(copy / missing)
    with pytest.raises(DataError, match=message):
        label_scans(copy, tmp_path / "labels", progress=False)


def test_a_run_that_ended_before_its_first_record_is_resumed(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _shorten(copy)
    write = kitti360_labels.write_labels
    written = []

    def full(path: Path, values: NDArray[np.uint32]) -> None:
        if len(written) == 2:
            raise FileError(f"{path} cannot be written", "a disk with free space")
        written.append(path)
        write(path, values)

    monkeypatch.setattr(kitti360_labels, "write_labels", full)
    with pytest.raises(FileError):
        label_scans(copy, tmp_path / "labels", progress=False)
    monkeypatch.undo()
    assert len(list((tmp_path / "labels").rglob("*.label"))) == 2
    assert not list((tmp_path / "labels").rglob("*.json"))
    assert label_scans(copy, tmp_path / "labels", progress=False).labelled == {DRIVE: 4}


def test_a_file_in_place_of_the_output_is_named(root: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(FileError, match=r"out.*cannot be made"):
        label_scans(root, tmp_path / "out", progress=False)


def test_labels_from_elsewhere_are_not_overwritten(root: Path) -> None:
    with pytest.raises(ConfigError, match="from elsewhere"):
        label_scans(root, root, progress=False)


def test_confidence_of_another_scan_is_refused(
    root: Path, labelled: tuple[Path, LabelReport], tmp_path: Path
) -> None:
    shutil.copytree(labelled[0], tmp_path / "labels")
    path = confidence_path(tmp_path / "labels", DRIVE, f"{3:010d}")
    path.write_bytes(path.read_bytes()[1:])
    scans = KITTI360(root, labels=tmp_path / "labels")
    assert scans[2].confidence is not None
    with pytest.raises(DataError, match="confidence"):
        scans[3]


def test_windows_overlap_and_stay_in_their_stretch() -> None:
    assert windows_of(Town(0, scans=45)) == [
        (0, 11),
        (8, 19),
        (20, 31),
        (28, 39),
        (40, 44),
    ]


def test_clouds_hold_every_second_frame_within_reach(root: Path) -> None:
    boxes = boxes_path(root, DRIVE)
    assert boxes is not None and len(read_boxes(boxes).instances)
    for window in find_windows(root, DRIVE):
        assert window.dynamic is not None
        moving = read_cloud(window.dynamic)
        assert set(moving["timestamp"].tolist()) <= set(
            range(window.first, window.last + 1, STEP)
        )
        static = read_cloud(window.static)
        points = np.column_stack([static[axis] for axis in "xyz"])
        assert (
            len(np.unique(np.floor(points / 0.02), axis=0))
            > 0.98 * len(points)
            > 10_000
        )
        assert set(np.unique(static["instance"] // 1000)) <= set(
            np.unique(static["semantic"])
        ) | {0}


@pytest.mark.parametrize(
    ("layout", "scans", "interval"),
    [("semantic_kitti", 5, 0.4), ("kitti360", 2001, 0.4), ("kitti360", 2000, 4.0)],
)
def test_what_cannot_be_accumulated_is_refused(
    layout: str, scans: int, interval: float, tmp_path: Path
) -> None:
    town = Town(0, scans=scans, interval=interval)
    with pytest.raises(ConfigError, match="accumulated"):
        export_town(town, tmp_path, layout, accumulate=True)


def test_the_command_prints_a_report(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dry = ["label", "kitti360", str(root), str(tmp_path), "--dry-run"]
    run(dry)
    assert f"{SCANS} scans in 2 windows" in capsys.readouterr().out
    run([*dry, "--json"])
    assert json.loads(capsys.readouterr().out) == {"scans": SCANS, "windows": 2}
    assert not list(tmp_path.iterdir())
    run(["label", "kitti360", str(root), str(tmp_path), "--against", str(root)])
    text = capsys.readouterr().out
    assert f"{SCANS} scans labelled" in text and "right" in text and "building" in text
    run(
        [
            "label",
            "kitti360",
            str(root),
            str(tmp_path),
            "--against",
            str(root),
            "--json",
        ]
    )
    report = json.loads(capsys.readouterr().out)
    stored = json.loads(
        (tmp_path / "data_3d_semantics_scan" / "report.json").read_text()
    )
    assert stored.pop("root") == str(root.resolve())
    assert (
        report == stored
        and report["shares"]["right"] > 0.97
        and report["frames"]["labelled"] == {DRIVE: SCANS}
    )
    with pytest.raises(LidarSynthError):
        run(["label", "kitti", str(root), str(tmp_path)])


def run(words: list[str]) -> None:
    """Run a command of ``lidar-synth`` in this process."""
    app(words, standalone_mode=False)
