"""Conversion: everything arrives, reruns do what is missing, bad scans are named."""

import os
import re
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
from banks import some_image, write_bank
from blocks import record
from conversions import a_sequence, app
from layouts import MAKERS, WRITTEN_AS, some_camera, some_scan, write_all
from typer.testing import CliRunner

from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.claims import claim
from lidar_synth.formats import READERS, WRITERS, open_scans
from lidar_synth.formats.as_sensor import AsSensor
from lidar_synth.formats.convert import SETTINGS, Report, _settings, convert
from lidar_synth.formats.kitti_object import KITTIObjectWriter
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor, presets
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.noise import keyed_rng


def files(root: Path) -> dict[str, bytes]:
    """All but the note of what a folder was filled from."""
    paths = (p for p in root.rglob("*") if p.is_file() and p.name != SETTINGS)
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in paths}


@pytest.mark.slow
@pytest.mark.parametrize("to", WRITERS)
@pytest.mark.parametrize("layout", READERS)
def test_every_layout_becomes_every_format(
    tmp_path: Path, layout: str, to: str
) -> None:
    MAKERS[layout](tmp_path / "in")
    source = open_scans(tmp_path / "in", layout=layout)
    if to == "kitti_object" and source[0].boxes is None:
        with pytest.raises(
            DataError, match=r"has no boxes; expected .*label_2.*semantic_kitti"
        ):
            convert(source, WRITERS[to](tmp_path / "out"), progress=False)
        assert set(files(tmp_path / "out")) == set()
        return
    report = convert(source, WRITERS[to](tmp_path / "out"), progress=False)
    assert report == Report(written=3)
    result = open_scans(tmp_path / "out")
    assert type(result) is READERS[WRITTEN_AS[to]] and len(result) == 3
    for expected, scan in zip(source, result, strict=True):
        expected = (
            unproject(project(expected, scan.sensor))
            if to in ("range", "png", "cosmos")
            else expected
        )
        atol = scan.sensor.range_max / 65535 if to == "png" else 0  # a step of 16 bits
        np.testing.assert_allclose(scan.points, expected.points, atol=atol)
        np.testing.assert_allclose(scan.reflectance, expected.reflectance, atol=atol)


def test_a_rerun_writes_only_missing_scans(tmp_path: Path) -> None:
    MAKERS["kitti360"](tmp_path / "in")
    read: list[int] = []

    class Watched(READERS["kitti360"]):  # type: ignore[misc]
        def read(self, index: int) -> Scan:
            read.append(index)
            return super().read(index)

    writer = WRITERS["semantic_kitti"](tmp_path / "out")
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(
        written=3
    )
    whole = files(tmp_path / "out")
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(kept=3)
    assert read == [0, 1, 2] and files(tmp_path / "out") == whole
    writer.path(1, "00/000001").unlink()
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(
        written=1, kept=2
    )
    assert read == [0, 1, 2, 1] and files(tmp_path / "out") == whole


def test_a_resumed_run_writes_the_same_files(tmp_path: Path) -> None:
    """Interrupted before the folder's own files are written; the next run has to write all frames'
    poses and boxes."""
    MAKERS["kitti360"](tmp_path / "in")
    source = open_scans(tmp_path / "in")
    convert(source, WRITERS["kitti360"](tmp_path / "once"), progress=False)

    class Interrupted(READERS["kitti360"]):  # type: ignore[misc]
        def read(self, index: int) -> Scan:
            if index == 2:
                raise KeyboardInterrupt
            return super().read(index)

    writer = WRITERS["kitti360"](tmp_path / "twice")
    with pytest.raises(KeyboardInterrupt):
        convert(Interrupted(tmp_path / "in"), writer, progress=False)
    assert not (
        tmp_path / "twice" / "data_poses" / "2013_05_28_drive_0000_sync" / "poses.txt"
    ).exists()
    assert convert(
        source, WRITERS["kitti360"](tmp_path / "twice"), progress=False
    ) == Report(written=1, kept=2)
    assert files(tmp_path / "twice") == files(tmp_path / "once")
    assert [
        scan.pose is not None and scan.boxes is not None
        for scan in open_scans(tmp_path / "twice")
    ] == [True] * 3


@pytest.mark.slow
def test_processes_write_the_same_files(tmp_path: Path) -> None:
    write_all(
        "semantic_kitti", tmp_path / "in", [some_scan(i, count=80) for i in range(12)]
    )
    source = open_scans(tmp_path / "in")
    convert(source, WRITERS["kitti360"](tmp_path / "one"), progress=False)
    assert convert(
        source, WRITERS["kitti360"](tmp_path / "two"), jobs=2, progress=False
    ) == Report(written=12)
    assert (
        files(tmp_path / "one") == files(tmp_path / "two")
        and len(files(tmp_path / "one")) > 24
    )


@pytest.mark.parametrize("fields", [(), ("reflectance", "label")])
def test_a_bank_becomes_semantic_kitti_with_a_label_file_for_every_scan(
    tmp_path: Path, fields: tuple[str, ...]
) -> None:
    """A trainer reads a missing ``.label`` as some class; a bank without labels gets 0, unlabelled,
    everywhere."""
    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)], fields=fields)
    bank = open_scans(tmp_path / "bank")
    convert(bank, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    for index, scan in enumerate(bank):
        raw = np.fromfile(
            tmp_path / "out" / "sequences" / "00" / "labels" / f"{index:06d}.label",
            "<u4",
        )
        assert len(raw) == len(scan) and (scan.label is None) == ("label" not in fields)
        known = (
            np.full(len(scan), IGNORE, np.uint8) if scan.label is None else scan.label
        )
        assert (
            np.array_equal(raw, SEMANTIC_KITTI.encode(known))
            and (raw[known == IGNORE] == 0).all()
        )
        assert raw.any() == ("label" in fields)


def test_a_bank_has_no_boxes_for_kitti_objects(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)])
    call = [str(tmp_path / "bank"), str(tmp_path / "out"), "--to", "kitti_object"]
    result = CliRunner().invoke(app, call)
    assert isinstance(result.exception, DataError)
    assert re.search(
        r"scan 'small/5/0' has no boxes; .*Write it as semantic_kitti",
        str(result.exception),
    )
    result = CliRunner().invoke(app, [*call, "--on-bad", "skip"])
    assert "0 scans written, 0 were there already, 3 skipped" in result.output
    assert not list(tmp_path.rglob("*.bin"))
    # which has no label_2
    writer = KITTIObjectWriter(tmp_path / "testing", part="testing")
    assert convert(open_scans(tmp_path / "bank"), writer, progress=False) == Report(
        written=3
    )


@pytest.mark.slow
@pytest.mark.parametrize(("jobs", "policy"), [(1, "error"), (1, "skip"), (2, "skip")])
def test_bad_scans_stop_the_run_or_are_named(
    tmp_path: Path, jobs: int, policy: str
) -> None:
    paths = MAKERS["folder"](tmp_path / "in")
    paths[0].write_bytes(b"cut")
    writer = WRITERS["npz"](tmp_path / "out")
    source = open_scans(tmp_path / "in", layout="folder", on_bad=policy)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="000000.bin is 3 bytes long"):
        convert(source, writer, progress=False)
    report = convert(source, writer, jobs=jobs, on_bad="skip", progress=False)
    assert (
        list(report.skipped) == ["000000"]
        and "is 3 bytes long" in report.skipped["000000"]
    )
    assert report.written == 2 and not writer.complete(0, "000000")


def test_a_scan_that_the_format_cannot_hold_is_skipped(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(2)]
    scans[0].raw_label, scans[0].instance = (
        None,
        np.full(len(scans[0]), 1 << 17, np.int32),
    )
    with pytest.raises(DataError, match="instances from 131072"):
        convert(scans, WRITERS["kitti"](tmp_path / "out"), progress=False)
    report = convert(
        scans, WRITERS["kitti"](tmp_path / "out"), on_bad="skip", progress=False
    )
    assert report.written == 1 and list(report.skipped) == ["0"]


def test_a_full_target_stops_the_run_for_every_policy(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(FileError, match="cannot be written"):
        convert(
            [some_scan()],
            WRITERS["npz"](tmp_path / "out"),
            on_bad="skip",
            progress=False,
        )
    for jobs in (0, 1.5):
        message = f"jobs {jobs}; expected a whole number, 1 or more"
        with pytest.raises(ConfigError, match=message):
            convert([some_scan()], WRITERS["npz"](tmp_path / "out"), jobs=jobs)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", presets())
def test_conversion_to_another_sensor(tmp_path: Path, name: str) -> None:
    scan = record(load_sensor("hdl64e_kitti"))
    sensor = load_sensor(name)
    report = convert([scan], WRITERS["npz"](tmp_path), as_sensor=sensor, progress=False)
    read = open_scans(tmp_path)[0]
    expected = Transfer(sensor)(scan, keyed_rng(0, 0))
    assert read.sensor == sensor and np.array_equal(read.points, expected.points)
    assert all(
        np.array_equal(read.fields()[k], v)
        for k, v in expected.fields().items()
        if k != "time"
    )
    assert np.array_equal(read.pose, scan.pose) and read.boxes is not None
    assert report.seen == [Transfer(sensor).cast(scan).seen]


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Three scans of a drive, with poses and a camera."""
    scans = [record(load_sensor("hdl64e_semantic_kitti"), at=1.0 * i) for i in range(3)]
    write_all("semantic_kitti", tmp_path / "drive", scans, calibration=some_camera())
    return tmp_path / "drive"


def test_poses_and_calibration_move_with_the_mount(tmp_path: Path, drive: Path) -> None:
    """A point of the street has the same pixel and the same place in the world before and after."""
    before = open_scans(drive)
    transfer = Transfer(load_sensor("hdl32e_nuscenes"), Mount(0.3, 4.0))
    out = WRITERS["semantic_kitti"](tmp_path / "out")
    report = convert(
        before, out, as_sensor=AsSensor(transfer, sweeps=1), progress=False
    )
    assert report.written == 3 and "times.txt" in report.left_out[0]
    after = open_scans(out.root)
    corners = record(before.sensor).boxes.corners()[0]
    moved = transfer.mount.points(corners)
    for a, b in zip(
        before.calibration(0).pixels(corners),
        after.calibration(0).pixels(moved),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-2)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(b.pose, a.pose @ transfer.mount.matrix, atol=1e-5)
    alone = convert(
        before,
        WRITERS["semantic_kitti"](tmp_path / "alone"),
        as_sensor=transfer,
        progress=False,
    )
    assert alone.written == 3
    assert all(
        len(a) < len(b)
        for a, b in zip(open_scans(tmp_path / "alone"), after, strict=True)
    )


@pytest.fixture
def dataset(tmp_path: Path) -> Iterator[Path]:
    MAKERS["kitti360"](tmp_path / "in")
    yield tmp_path / "in"


def test_the_command(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = [
        "--to",
        "range",
        "--as-sensor",
        "os1_128",
        "--mount",
        "0.1,2",
        "--sweeps",
        "1",
        "--like",
        str(drive),
    ]
    result = CliRunner().invoke(app, [str(drive), str(out), *options])
    assert result.exit_code == 0, result.output
    assert "3 scans written, 0 were there already, 0 skipped" in result.output
    assert "of the field of view of os1_128 was seen" in result.output
    assert open_scans(out)[0].sensor == load_sensor("os1_128")
    result = CliRunner().invoke(app, [str(drive), str(out), *options])
    assert "0 scans written, 3 were there already, 0 skipped" in result.output


def test_the_command_leaves_unreadable_scans_out_of_what_it_reads_beside_each(
    drive: Path, tmp_path: Path
) -> None:
    sorted(drive.rglob("*.bin"))[-1].write_bytes(b"cut")
    options = ["--to", "range", "--as-sensor", "os1_128", "--sweeps", "1"]
    options += ["--like", str(tmp_path / "like"), "--on-bad", "skip"]
    write_all("npz", tmp_path / "like", [record(load_sensor("os1_128"))])
    with pytest.warns(UserWarning, match="skipped scan"):
        result = CliRunner().invoke(app, [str(drive), str(tmp_path / "out"), *options])
    assert result.exit_code == 0, result.output
    assert "2 scans written, 0 were there already, 1 skipped" in result.output


WRONG = {
    "--mount without a sensor": (["--mount", "0,0"], "mount without --as-sensor"),
    "a mount of one number": (
        ["--as-sensor", "os1_128", "--mount", "0.1"],
        "--mount 0.1; expected metres and degrees",
    ),
    "an impossible mount": (
        ["--as-sensor", "os1_128", "--mount", "9,0"],
        "at most 5 m",
    ),
    "fewer than no sweeps": (["--as-sensor", "os1_128", "--sweeps", "-1"], "sweeps -1"),
    "noise of metres": (
        ["--as-sensor", "os1_128", "--range-noise", "2"],
        "range_noise=2",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options_of_another_sensor(
    drive: Path, tmp_path: Path, case: str
) -> None:
    options, message = WRONG[case]
    with pytest.raises(ConfigError, match=message):
        CliRunner().invoke(
            app,
            [str(drive), str(tmp_path / "out"), "--to", "kitti", *options],
            catch_exceptions=False,
        )
    assert not (tmp_path / "out").exists()


def test_the_command_prints_skipped_scans_with_reasons(
    dataset: Path, tmp_path: Path
) -> None:
    [*_, path] = sorted(dataset.rglob("*.bin"))
    path.write_bytes(b"cut")
    result = CliRunner().invoke(
        app, [str(dataset), str(tmp_path / "out"), "--to", "kitti", "--on-bad", "skip"]
    )
    assert (
        result.exit_code == 0
        and "2 scans written, 0 were there already, 1 skipped" in result.output
    )
    assert (
        "skipped 2013_05_28_drive_0000_sync/0000000002: " in result.output
        and "is 3 bytes long" in result.output
    )


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--to", "pdc"], "--to 'pdc'; expected one of 'kitti'"),
        (["--to", "kitti", "--split", "train"], "KITTI-360 split 'train'"),
        (["--to", "kitti", "--sensor", "hdl64"], "sensor 'hdl64'; expected one of"),
        (["--to", "kitti", "--on-bad", "ignore"], "on_bad='ignore'"),
    ],
)
def test_the_error_of_a_wrong_call_names_the_right_one(
    dataset: Path, tmp_path: Path, options: list[str], error: str
) -> None:
    result = CliRunner().invoke(app, [str(dataset), str(tmp_path / "out"), *options])
    assert isinstance(result.exception, ConfigError) and error in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_filled_from_something_else_is_refused(tmp_path: Path) -> None:
    """Not: the old scans kept, and passed off as the new ones."""
    for name in "ab":
        MAKERS["kitti360"](tmp_path / name)
    a = open_scans(tmp_path / "a")
    b = open_scans(tmp_path / "b")
    out = WRITERS["npz"](tmp_path / "out")
    convert(a, out, progress=False)
    before = files(out.root)
    with pytest.raises(
        ConfigError, match=r"out was filled with .*/a.*expected .*/b.*another folder"
    ):
        convert(b, out, progress=False)
    with pytest.raises(ConfigError, match="os1_128"):
        convert(a, out, as_sensor=load_sensor("os1_128"), progress=False)
    assert files(out.root) == before
    assert convert(a, out, progress=False) == Report(kept=3)
    (out.root / SETTINGS).write_text("{")
    with pytest.raises(DataError, match="damaged"):
        convert(a, out, progress=False)


def test_another_bank_in_the_place_of_the_first_one_is_refused(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_bank(tmp_path / "bank", [some_image(seed)])
        refused = pytest.raises(ConfigError, match="was filled with {'options': {'bank")
        with refused if seed else nullcontext():
            out = WRITERS["npz"](tmp_path / "out")
            convert(open_scans(tmp_path / "bank"), out, progress=False)


def test_other_options_of_the_reader_do_not_keep_the_old_scans(tmp_path: Path) -> None:
    values = np.full((20, 4), 5, "<f4")
    (tmp_path / "in").mkdir()
    (values * [1, 1, 0, 10]).astype("<f4").tofile(tmp_path / "in" / "a.bin")
    out = WRITERS["npz"](tmp_path / "out")
    changed = WRITERS["npz"](tmp_path / "changed")
    convert(open_scans(tmp_path / "in", reflectance_max=65535), out, progress=False)
    with pytest.raises(
        ConfigError,
        match="was filled with .*reflectance_max.*65535.*choose another folder",
    ):
        convert(open_scans(tmp_path / "in", reflectance_max=255), out, progress=False)
    target = load_sensor("vlp16")
    mistaken = open_scans(tmp_path / "in", reflectance_max=255, sensor="vlp16")
    claim(
        changed.root / SETTINGS,
        _settings(mistaken, changed, AsSensor(Transfer(target)), False),
    )
    with pytest.raises(ConfigError, match="was filled with"):
        convert(
            open_scans(tmp_path / "in", reflectance_max=255),
            changed,
            as_sensor=target,
            progress=False,
        )


@pytest.mark.parametrize(
    ("layout", "chosen"),
    [
        ("pandaset", {"motion_compensated": True}),
        ("pandaset", {"camera": "back_camera"}),
        ("semantic_kitti", {"taxonomy": replace(SEMANTIC_KITTI, to_train={0: IGNORE})}),
        ("kitti360", {"labels": "labels"}),
        ("mcap", {"topic": "/points"}),
    ],
)
def test_an_option_that_changes_the_scans_is_not_resumed_over(
    layout: str, chosen: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    MAKERS[layout](tmp_path / "in")
    if layout == "kitti360":
        copytree(tmp_path / "in", tmp_path / "labels")
    plain: Any = READERS[layout]
    out = WRITERS["npz"](tmp_path / "out")
    claim(out.root / SETTINGS, _settings(plain(tmp_path / "in"), out, None, False))
    with pytest.raises(ConfigError, match=f"was filled with.*'{next(iter(chosen))}'"):
        convert(plain(tmp_path / "in", **chosen), out, progress=False)


def test_a_folder_is_not_converted_into_itself(tmp_path: Path) -> None:
    write_all("kitti", tmp_path, [some_scan(0)])
    before = files(tmp_path)
    for out in (tmp_path, tmp_path / "below"):  # where a second call would read it
        with pytest.raises(
            ConfigError, match="inside of .*; expected a folder outside"
        ):
            convert(open_scans(tmp_path), WRITERS["kitti"](out), progress=False)
    assert files(tmp_path) == before and not (tmp_path / SETTINGS).exists()


def test_scans_of_others_in_the_folder_are_not_adopted(tmp_path: Path) -> None:
    write_all("semantic_kitti", tmp_path / "in", [some_scan(0)])
    write_all("kitti", tmp_path / "mine", [some_scan(1)])
    before = files(tmp_path / "mine")
    with pytest.raises(ConfigError, match=r"mine holds files .*\.bin; expected a new"):
        convert(
            open_scans(tmp_path / "in"),
            WRITERS["kitti"](tmp_path / "mine"),
            progress=False,
        )
    assert files(tmp_path / "mine") == before


def five_fields(folder: Path, *counts: int) -> Path:
    """Files of five numbers per point, whose sizes show it with an odd number of points."""
    folder.mkdir()
    for index, count in enumerate(counts):
        np.tile(np.float32([9, 9, 0, 0.5, 0.1]), (count, 1)).tofile(
            folder / f"{index}.bin"
        )
    return folder


@pytest.mark.parametrize("policy", ["error", "skip"])
def test_a_run_that_wrote_nothing_can_be_corrected(tmp_path: Path, policy: Any) -> None:
    root = five_fields(tmp_path / "in", 21, 23)
    out = WRITERS["npz"](tmp_path / "out")
    with suppress(DataError):
        convert(open_scans(root), out, on_bad=policy, progress=False)
    assert files(out.root) == {} and not (out.root / SETTINGS).exists()
    assert convert(open_scans(root, fields=5), out, progress=False) == Report(written=2)


def test_a_run_that_wrote_a_scan_or_was_not_the_first_keeps_its_settings(
    tmp_path: Path,
) -> None:
    scans = [some_scan(0), some_scan(1)]
    out = WRITERS["kitti_object"](tmp_path)
    scans[1].boxes = None
    with pytest.raises(DataError, match="has no boxes"):
        convert(scans, out, progress=False)
    with pytest.raises(ConfigError, match="was filled with .*KITTIObjectWriter"):
        convert(scans, WRITERS["semantic_kitti"](tmp_path), progress=False)
    [
        path.unlink()
        for path in tmp_path.rglob("*")
        if path.is_file() and path.name != SETTINGS
    ]
    # beside another run, which has not written a scan yet
    with pytest.raises(DataError, match="has no boxes"):
        convert(scans[::-1], out, progress=False)
    assert (tmp_path / SETTINGS).is_file()


@pytest.mark.parametrize(
    "options", [{}, {"tr": False}, {"calib": False}, {"times": False}]
)
def test_side_files_of_semantic_kitti_are_carried_and_never_invented(
    tmp_path: Path, options: dict[str, bool]
) -> None:
    given = a_sequence(tmp_path / "in", **options)
    source = open_scans(tmp_path / "in")
    report = convert(
        source, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False
    )
    there = {path.name: path.read_bytes() for path in given.glob("*.txt")}
    written = tmp_path / "out" / "sequences" / "07"
    assert {path.name: path.read_bytes() for path in written.glob("*.txt")} == there
    lacking = {"calib.txt", "poses.txt", "times.txt"} - set(there)
    assert len(report.left_out) == len(lacking)
    assert all(
        f"sequences/07/{name}" in what
        for name, what in zip(sorted(lacking), report.left_out, strict=True)
    )
    for expected, scan in zip(source, open_scans(tmp_path / "out"), strict=True):
        assert np.array_equal(scan.points, expected.points)
        assert (
            (scan.pose is None)
            == (expected.pose is None)
            == (options in ({"tr": False}, {"calib": False}))
        )
        assert scan.pose is None or np.array_equal(scan.pose, expected.pose)


def test_scans_that_get_other_numbers_do_not_get_side_files_of_others(
    tmp_path: Path,
) -> None:
    given = a_sequence(tmp_path / "in")
    given.rename(given.with_name("seven"))
    report = convert(
        open_scans(tmp_path / "in"),
        WRITERS["semantic_kitti"](tmp_path / "out"),
        progress=False,
    )
    assert report.left_out == [
        "calibration, poses and times of sequence seven: its scans are renumbered",
    ]
    assert not (tmp_path / "out" / "sequences" / "00" / "times.txt").exists()
    assert np.allclose(
        open_scans(tmp_path / "out")[1].pose, open_scans(tmp_path / "in")[1].pose
    )


def test_the_command_reports_what_was_left_out(tmp_path: Path) -> None:
    a_sequence(tmp_path / "in", times=False)
    result = CliRunner().invoke(
        app, [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "semantic_kitti"]
    )
    assert (
        result.exit_code == 0
        and f"left out sequences/07/times.txt: {tmp_path / 'in'} has none"
        in result.output
    )


@pytest.mark.skipif(os.name == "nt", reason="files are not locked on Windows")
@pytest.mark.parametrize("to", ["webdataset", "kitti360"])
def test_a_second_conversion_into_the_folder_waits_its_turn(
    tmp_path: Path, to: str
) -> None:
    MAKERS["kitti360"](tmp_path / "in")
    first = open_scans(tmp_path / "in")
    out = tmp_path / "out"

    class Meanwhile(READERS["kitti360"]):  # type: ignore[misc]
        def read(self, index: int) -> Scan:
            with pytest.raises(ConfigError, match="in which another process works"):
                convert(first, WRITERS[to](out), progress=False)
            return super().read(index)

    report = convert(Meanwhile(tmp_path / "in"), WRITERS[to](out), progress=False)
    assert report.written == 3 and len(open_scans(out)) == 3
    assert convert(first, WRITERS[to](out), progress=False).kept == 3
