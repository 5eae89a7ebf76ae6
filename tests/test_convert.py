"""Conversion: everything arrives, reruns do what is missing, bad scans are named."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from banks import some_image, write_bank
from layouts import MAKERS, WRITTEN_AS, some_scan, write_all
from typer.testing import CliRunner

from lidar_synth.cli.convert import convert as command
from lidar_synth.datasets.classes import IGNORE, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import READERS, WRITERS, open_scans
from lidar_synth.formats.convert import SETTINGS, Report, convert, reproject
from lidar_synth.formats.domain import mark_synthetic
from lidar_synth.formats.kitti_object import KITTIObjectWriter
from lidar_synth.geometry.projection import project, unfold, unproject
from lidar_synth.geometry.scan import REAL, SYNTHETIC, RangeImage, Scan
from lidar_synth.geometry.sensor import load_sensor, presets

app = typer.Typer()
app.command()(command)


def files(root: Path) -> dict[str, bytes]:
    """All but the note of what a folder was filled from."""
    paths = (p for p in root.rglob("*") if p.is_file() and p.name != SETTINGS)
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in paths}


@pytest.mark.parametrize("to", WRITERS)
@pytest.mark.parametrize("layout", READERS)
def test_every_layout_becomes_every_format(tmp_path: Path, layout: str, to: str) -> None:
    MAKERS[layout](tmp_path / "in")
    source = open_scans(tmp_path / "in", layout=layout)
    if to == "kitti_object" and source[0].boxes is None:
        with pytest.raises(DataError, match=r"has no boxes; expected .*label_2.*semantic_kitti"):
            convert(source, WRITERS[to](tmp_path / "out"), progress=False)
        assert set(files(tmp_path / "out")) == set()
        return
    report = convert(source, WRITERS[to](tmp_path / "out"), progress=False)
    assert report == Report(written=3)
    result = open_scans(tmp_path / "out")
    assert type(result) is READERS[WRITTEN_AS[to]] and len(result) == 3
    for expected, scan in zip(source, result, strict=True):
        expected = reproject(expected, scan.sensor) if to in ("range", "png") else expected
        atol = 1e-3 if to == "png" else 0
        np.testing.assert_allclose(scan.points, expected.points, atol=atol)
        np.testing.assert_allclose(scan.reflectance, expected.reflectance, atol=atol)


def test_a_rerun_does_only_what_is_missing(tmp_path: Path) -> None:
    MAKERS["kitti360"](tmp_path / "in")
    read: list[int] = []

    class Watched(READERS["kitti360"]):  # type: ignore[misc]
        def read(self, index: int) -> Scan:
            read.append(index)
            return super().read(index)

    writer = WRITERS["semantic_kitti"](tmp_path / "out")
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(written=3)
    whole = files(tmp_path / "out")
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(kept=3)
    assert read == [0, 1, 2] and files(tmp_path / "out") == whole
    writer.path(1, "00/000001").unlink()
    assert convert(Watched(tmp_path / "in"), writer, progress=False) == Report(written=1, kept=2)
    assert read == [0, 1, 2, 1] and files(tmp_path / "out") == whole


def test_an_interrupted_run_goes_on_to_the_same_files(tmp_path: Path) -> None:
    """Interrupted before the folder's own files are written; the next run has to write all frames' poses and boxes."""
    MAKERS["kitti360"](tmp_path / "in")
    source = open_scans(tmp_path / "in")
    convert(source, WRITERS["kitti360"](tmp_path / "once"), progress=False)

    class Interrupted:
        def __len__(self) -> int:
            return 3

        def __getitem__(self, index: int) -> Scan:
            if index == 2:
                raise KeyboardInterrupt
            return source[index]

    writer = WRITERS["kitti360"](tmp_path / "twice", calibration=source.calibration(0))
    with pytest.raises(KeyboardInterrupt):
        convert(Interrupted(), writer, progress=False)
    assert not (tmp_path / "twice" / "data_poses" / "2013_05_28_drive_0000_sync" / "poses.txt").exists()
    assert convert(source, WRITERS["kitti360"](tmp_path / "twice"), progress=False) == Report(written=1, kept=2)
    assert files(tmp_path / "twice") == files(tmp_path / "once")
    assert [scan.pose is not None and scan.boxes is not None for scan in open_scans(tmp_path / "twice")] == [True] * 3


def test_processes_write_the_same_files(tmp_path: Path) -> None:
    write_all("semantic_kitti", tmp_path / "in", [some_scan(i, count=80) for i in range(12)])
    source = open_scans(tmp_path / "in")
    convert(source, WRITERS["kitti360"](tmp_path / "one"), progress=False)
    assert convert(source, WRITERS["kitti360"](tmp_path / "two"), jobs=2, progress=False) == Report(written=12)
    assert files(tmp_path / "one") == files(tmp_path / "two") and len(files(tmp_path / "one")) > 24


@pytest.mark.parametrize("fields", [(), ("reflectance", "label")])
def test_a_bank_becomes_semantic_kitti_with_a_label_file_for_every_scan(
    tmp_path: Path, fields: tuple[str, ...]
) -> None:
    """A trainer reads a missing ``.label`` as some class; a bank without labels gets 0, unlabelled, everywhere."""
    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)], fields=fields)
    bank = open_scans(tmp_path / "bank")
    convert(bank, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    for index, scan in enumerate(bank):
        raw = np.fromfile(tmp_path / "out" / "sequences" / "00" / "labels" / f"{index:06d}.label", "<u4")
        assert len(raw) == len(scan) and (scan.label is None) == ("label" not in fields)
        known = np.full(len(scan), IGNORE, np.uint8) if scan.label is None else scan.label
        assert np.array_equal(raw, SEMANTIC_KITTI.encode(known)) and (raw[known == IGNORE] == 0).all()
        assert raw.any() == ("label" in fields)


def test_a_bank_has_no_boxes_for_kitti_objects(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)])
    call = [str(tmp_path / "bank"), str(tmp_path / "out"), "--to", "kitti_object"]
    result = CliRunner().invoke(app, call)
    assert isinstance(result.exception, DataError)
    assert re.search(r"scan 'small/5/0' has no boxes; .*Write it as semantic_kitti", str(result.exception))
    result = CliRunner().invoke(app, [*call, "--on-bad", "skip"])
    assert "0 scans written, 0 were there already, 3 skipped" in result.output
    assert not list(tmp_path.rglob("*.bin"))
    writer = KITTIObjectWriter(tmp_path / "testing", part="testing")  # which has no label_2
    assert convert(open_scans(tmp_path / "bank"), writer, progress=False) == Report(written=3)


@pytest.mark.parametrize(("jobs", "policy"), [(1, "error"), (1, "skip"), (2, "skip")])
def test_bad_scans_stop_the_run_or_are_named(tmp_path: Path, jobs: int, policy: str) -> None:
    paths = MAKERS["folder"](tmp_path / "in")
    paths[0].write_bytes(b"cut")
    writer = WRITERS["npz"](tmp_path / "out")
    source = open_scans(tmp_path / "in", layout="folder", on_bad=policy)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="000000.bin is 3 bytes long"):
        convert(source, writer, progress=False)
    report = convert(source, writer, jobs=jobs, on_bad="skip", progress=False)
    assert list(report.skipped) == ["000000"] and "is 3 bytes long" in report.skipped["000000"]
    assert report.written == 2 and not writer.complete(0, "000000")


def test_a_scan_that_the_format_cannot_hold_is_skipped(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(2)]
    scans[0].raw_label, scans[0].instance = None, np.full(len(scans[0]), 1 << 17, np.int32)
    with pytest.raises(DataError, match="instances from 131072"):
        convert(scans, WRITERS["kitti"](tmp_path / "out"), progress=False)
    report = convert(scans, WRITERS["kitti"](tmp_path / "out"), on_bad="skip", progress=False)
    assert report.written == 1 and list(report.skipped) == ["0"]


def test_a_full_target_stops_the_run_whatever_the_policy(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(FileError, match="cannot be written"):
        convert([some_scan()], WRITERS["npz"](tmp_path / "out"), on_bad="skip", progress=False)
    with pytest.raises(ConfigError, match="0 jobs; expected at least 1"):
        convert([some_scan()], WRITERS["npz"](tmp_path / "out"), jobs=0)


@pytest.mark.parametrize("name", presets())
def test_another_sensor_sees_the_same_scan(tmp_path: Path, name: str) -> None:
    scan, sensor = some_scan(count=5000), load_sensor(name)
    convert([scan], WRITERS["npz"](tmp_path), as_sensor=sensor, progress=False)
    read = open_scans(tmp_path)[0]
    image = project(scan, sensor)
    assert read.sensor == sensor and len(read) == image.mask.sum() > 0
    again = project(read)
    assert np.array_equal(again.mask, image.mask)
    np.testing.assert_allclose(again.range, image.range, rtol=3e-7)
    assert all(np.array_equal(again.channels[k], image.channels[k]) for k in image.channels)
    assert np.array_equal(read.pose, scan.pose) and read.boxes is not None


@pytest.fixture
def dataset(tmp_path: Path) -> Iterator[Path]:
    MAKERS["kitti360"](tmp_path / "in")
    yield tmp_path / "in"


def test_the_command(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--to", "range", "--as-sensor", "os1_128", "--split", "r2flow/test"]
    result = CliRunner().invoke(app, [str(dataset), str(out), *options])
    assert result.exit_code == 0, result.output
    assert "3 scans written, 0 were there already, 0 skipped" in result.output
    assert open_scans(out)[0].sensor == load_sensor("os1_128")
    result = CliRunner().invoke(app, [str(dataset), str(out), *options])
    assert "0 scans written, 3 were there already, 0 skipped" in result.output


def test_the_command_prints_what_it_skipped_and_why(dataset: Path, tmp_path: Path) -> None:
    [*_, path] = sorted(dataset.rglob("*.bin"))
    path.write_bytes(b"cut")
    result = CliRunner().invoke(app, [str(dataset), str(tmp_path / "out"), "--to", "kitti", "--on-bad", "skip"])
    assert result.exit_code == 0 and "2 scans written, 0 were there already, 1 skipped" in result.output
    assert "skipped 2013_05_28_drive_0000_sync/0000000002: " in result.output and "is 3 bytes long" in result.output


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--to", "pdc"], "format 'pdc'; expected one of 'kitti'"),
        (["--to", "kitti", "--split", "train"], "KITTI-360 split 'train'"),
        (["--to", "kitti", "--sensor", "hdl64"], "sensor 'hdl64'; expected one of"),
        (["--to", "kitti", "--on-bad", "ignore"], "on_bad='ignore'"),
    ],
)
def test_a_wrong_call_says_what_is_right(dataset: Path, tmp_path: Path, options: list[str], error: str) -> None:
    result = CliRunner().invoke(app, [str(dataset), str(tmp_path / "out"), *options])
    assert isinstance(result.exception, ConfigError) and error in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_the_script_in_tools_is_the_command(tmp_path: Path) -> None:
    script = Path(__file__).parents[1] / "tools" / "convert.py"
    result = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0 and "--as-sensor" in result.stdout


def test_a_folder_filled_from_something_else_is_refused(tmp_path: Path) -> None:
    """Not: the old scans kept, and passed off as the new ones."""
    for name in "ab":
        MAKERS["kitti360"](tmp_path / name)
    a, b, out = open_scans(tmp_path / "a"), open_scans(tmp_path / "b"), WRITERS["npz"](tmp_path / "out")
    convert(a, out, progress=False)
    before = files(out.root)
    with pytest.raises(ConfigError, match=r"out was filled with .*/a.*expected .*/b.*another folder"):
        convert(b, out, progress=False)
    with pytest.raises(ConfigError, match="os1_128"):
        convert(a, out, as_sensor=load_sensor("os1_128"), progress=False)
    assert files(out.root) == before
    assert convert(a, out, progress=False) == Report(kept=3)
    (out.root / SETTINGS).write_text("{")
    with pytest.raises(DataError, match="damaged"):
        convert(a, out, progress=False)


def a_sequence(root: Path, *, tr: bool = True, calib: bool = True, times: bool = True) -> Path:
    """Three scans in KITTI's own odometry layout, with side files as they are there: F lines, exact text."""
    source = root / "sequences" / "07"
    write_all("semantic_kitti", root, [some_scan(i) for i in range(3)], sequence="07")
    [path.unlink() for path in source.glob("*.txt")]
    rows = [[700.0 + i, 0, 600, 5 * i, 0, 700, 180, 0.2, 0, 0, 1, 0.005] for i in range(4)]
    lines = [f"P{i}: {' '.join(f'{v:.9e}' for v in row)}" for i, row in enumerate(rows)]
    lines += ["Tr: 0 -1 0 0.05 0 0 -1 -0.08 1 0 0 -0.27"] if tr else []
    if calib:
        (source / "calib.txt").write_text("\n".join(lines) + "\n")
    if times:
        (source / "times.txt").write_text("0.000000e+00\n1.037359e-01\n2.073381e-01\n")
    (source / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 {i / 3!r}\n" for i in range(3)))
    return source


@pytest.mark.parametrize("options", [{}, {"tr": False}, {"calib": False}, {"times": False}])
def test_side_files_of_semantic_kitti_are_carried_and_never_invented(tmp_path: Path, options: dict[str, bool]) -> None:
    given = a_sequence(tmp_path / "in", **options)
    source = open_scans(tmp_path / "in")
    report = convert(source, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    there = {path.name: path.read_bytes() for path in given.glob("*.txt")}
    written = tmp_path / "out" / "sequences" / "07"
    assert {path.name: path.read_bytes() for path in written.glob("*.txt")} == there
    lacking = {"calib.txt", "poses.txt", "times.txt"} - set(there)
    assert len(report.left_out) == len(lacking)
    assert all(f"sequences/07/{name}" in what for name, what in zip(sorted(lacking), report.left_out, strict=True))
    for expected, scan in zip(source, open_scans(tmp_path / "out"), strict=True):
        assert np.array_equal(scan.points, expected.points)
        assert (scan.pose is None) == (expected.pose is None) == (options in ({"tr": False}, {"calib": False}))
        assert scan.pose is None or np.array_equal(scan.pose, expected.pose)


def test_scans_that_get_other_numbers_do_not_get_side_files_of_others(tmp_path: Path) -> None:
    given = a_sequence(tmp_path / "in")
    given.rename(given.with_name("seven"))
    report = convert(open_scans(tmp_path / "in"), WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    assert report.left_out == [
        "the calibration, poses and times of sequence seven: its scans get other numbers",
    ]
    assert not (tmp_path / "out" / "sequences" / "00" / "times.txt").exists()
    assert np.allclose(open_scans(tmp_path / "out")[1].pose, open_scans(tmp_path / "in")[1].pose)


def test_the_command_says_what_was_left_out(tmp_path: Path) -> None:
    a_sequence(tmp_path / "in", times=False)
    result = CliRunner().invoke(app, [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "semantic_kitti"])
    assert result.exit_code == 0 and f"left out sequences/07/times.txt: {tmp_path / 'in'} has none" in result.output


def rings_of(seed: int) -> Scan:
    """A scan on the beams of its sensor, ring by ring from straight ahead on."""
    sensor = load_sensor("hdl64e_kitti")
    rng, lasers = np.random.default_rng(seed), sensor.by_beams()
    distance = np.where(rng.random(lasers.shape) < 0.8, rng.uniform(5, 70, lasers.shape), 0).astype(np.float32)
    scan, row = unproject(RangeImage(distance, lasers)), np.nonzero(distance)[0]
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    return replace(scan[np.lexsort((azimuth, row))], sensor=sensor)


def test_unfolding_is_offered(tmp_path: Path) -> None:
    scans = [rings_of(i) for i in range(3)]
    write_all("kitti", tmp_path / "in", scans)
    options = [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "range", "--unfold"]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 0, result.output
    read = open_scans(tmp_path / "out")
    for scan, expected in zip(read, scans, strict=True):
        assert np.allclose(project(scan).range, unfold(expected).range, rtol=3e-7)
        assert np.array_equal(project(scan).sensor.row_elevations(), expected.sensor.laser_elevations)
    write_all("kitti", tmp_path / "shuffled", [scans[0][np.random.default_rng(0).permutation(len(scans[0]))]])
    with pytest.raises(DataError, match="ring by ring"):
        convert(open_scans(tmp_path / "shuffled"), WRITERS["npz"](tmp_path / "no"), unfold=True, progress=False)
    with pytest.raises(ConfigError, match="was filled with .*'unfold': True"):
        convert(open_scans(tmp_path / "in"), WRITERS["range"](tmp_path / "out"), progress=False)


def with_bad_points(path: Path) -> np.ndarray:
    """Make points 3, 5 and 8 of a ``.bin`` NaN or infinite; which are left."""
    points = np.fromfile(path, "<f4").reshape(-1, 4)
    points[3, 0], points[5, 2], points[8, 3] = np.nan, -np.inf, np.nan
    points.tofile(path)
    return np.isfinite(points).all(1)


@pytest.mark.parametrize("layout", ["kitti360", "semantic_kitti", "kitti_object", "kitti_raw", "folder", "nuscenes"])
def test_bad_points_are_dropped_with_their_labels_and_counted(tmp_path: Path, layout: str) -> None:
    paths = MAKERS[layout](tmp_path / "in")
    before = open_scans(tmp_path / "in", layout=layout)[1]
    if layout == "nuscenes":
        points = np.fromfile(paths[1], "<f4").reshape(-1, 5)
        far = np.flatnonzero(np.linalg.norm(points[:, :3], axis=1) > 1)
        points[far[[3, 5]], 0] = np.nan, np.inf
        points.tofile(paths[1])
        kept = np.delete(np.arange(len(before)), [3, 5])
    else:
        kept = np.flatnonzero(with_bad_points(paths[1]))
    out = tmp_path / "out"
    with pytest.raises(DataError, match=r"points are NaN or infinite.*--on-bad drop-points"):
        convert(open_scans(tmp_path / "in", layout=layout), WRITERS["npz"](out), progress=False)
    options = ["--to", "npz", "--on-bad", "drop-points", "--layout", layout]
    result = CliRunner().invoke(app, [str(tmp_path / "in"), str(out), *options])
    name = open_scans(tmp_path / "in", layout=layout).ids[1]
    count = len(before) - len(kept)
    assert result.exit_code == 0 and f"dropped {count} points of {name}, which are NaN or infinite" in result.output
    scan, expected = open_scans(out)[1], before[kept]
    assert np.array_equal(scan.points, expected.points)
    assert all(np.array_equal(scan.fields()[name], values) for name, values in expected.fields().items())
    source = open_scans(tmp_path / "in", layout=layout, on_bad="drop-points")
    assert len(source[1]) == len(kept) and source.dropped == {name: count}


def test_a_scan_of_bad_points_only_is_refused(tmp_path: Path) -> None:
    [path, *_] = MAKERS["folder"](tmp_path / "in")
    np.full((4, 4), np.nan, "<f4").tofile(path)
    path.with_suffix(".label").unlink()
    with pytest.raises(DataError, match="holds no points|all 4 points are NaN"):
        open_scans(tmp_path / "in", on_bad="drop-points")[0]


def test_intensities_on_another_scale(tmp_path: Path) -> None:
    """The advice of the error is what is to be typed."""
    scan = some_scan(0)
    points = np.column_stack([scan.points, np.round(scan.reflectance * 255)]).astype("<f4")
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", points)
    with pytest.raises(DataError, match=r"on another scale \(convert (--reflectance-max 255)") as error:
        convert(open_scans(tmp_path / "in"), WRITERS["kitti"](tmp_path / "no"), progress=False)
    advice = re.search(r"convert (--\S+ \S+),", str(error.value))
    assert advice is not None
    arguments = [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "kitti", *advice[1].split()]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert np.allclose(open_scans(tmp_path / "out")[0].reflectance, points[:, 3] / 255)
    with pytest.raises(ConfigError, match=r"reflectance_max=255.* for .*--layout folder"):
        open_scans(a_sequence(tmp_path / "kitti").parents[1], reflectance_max=255)


def test_five_floats_per_point(tmp_path: Path) -> None:
    scan = some_scan(0)[:41]  # not a multiple of four
    np.column_stack([scan.points, scan.reflectance, np.zeros(41)]).astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(DataError, match="convert --fields 5"):
        open_scans(tmp_path / "a.bin")[0]
    assert np.array_equal(open_scans(tmp_path / "a.bin", fields=5)[0].points, scan.points)


@pytest.mark.parametrize("to", ["kitti", "npz", "pcd", "ply"])
def test_suffixes_in_capitals(tmp_path: Path, to: str) -> None:
    paths = write_all(to, tmp_path / "in", [some_scan(i) for i in range(3)])
    expected = open_scans(tmp_path / "in")[0]
    for path in (paths[0], paths[2]):  # one stays as it is
        path.rename(path.with_suffix(path.suffix.upper()))
    source = open_scans(tmp_path / "in")
    assert len(source) == 3 and np.array_equal(source[0].points, expected.points)
    assert np.array_equal(open_scans(paths[0].with_suffix(paths[0].suffix.upper()))[0].points, expected.points)
    assert source[0].label is not None and np.array_equal(source[0].label, expected.label)
    assert convert(source, WRITERS["kitti"](tmp_path / "out"), progress=False) == Report(written=3)


@pytest.mark.parametrize("to", ["kitti", "semantic_kitti", "kitti360", "range", "npz"])
def test_what_was_made_stays_synthetic_from_format_to_format(tmp_path: Path, to: str) -> None:
    bank = write_bank(tmp_path / "bank", [some_image(i) for i in range(2)])[0].parent
    assert convert(open_scans(bank), WRITERS[to](tmp_path / "a"), progress=False).written == 2
    first = open_scans(tmp_path / "a")
    assert [scan.domain for scan in first] == [SYNTHETIC] * 2 and first[0].domain == SYNTHETIC
    convert(first, WRITERS["kitti"](tmp_path / "b"), progress=False)
    assert open_scans(tmp_path / "b")[0].domain == SYNTHETIC
    if to in ("semantic_kitti", "kitti360"):  # one file of it, too
        assert open_scans(sorted((tmp_path / "a").rglob("*.bin"))[0])[0].domain == SYNTHETIC


def test_what_was_measured_stays_real(tmp_path: Path) -> None:
    MAKERS["kitti360"](tmp_path / "in")
    convert(open_scans(tmp_path / "in"), WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    assert {scan.domain for scan in open_scans(tmp_path / "out")} == {REAL}
    assert not list((tmp_path / "out").glob("synthetic*"))
    mark_synthetic(tmp_path)  # above a dataset, not beside it
    assert open_scans(tmp_path / "out")[0].domain == REAL


def test_an_interrupted_run_marks_what_is_there(tmp_path: Path) -> None:
    bank = write_bank(tmp_path / "bank", [some_image(i) for i in range(3)])[0].parent
    source, writer = open_scans(bank), WRITERS["kitti"](tmp_path / "out")
    read = source.read

    def stop(index: int) -> Scan:
        if index == 2:
            raise KeyboardInterrupt
        return read(index)

    source.read = stop  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        convert(source, writer, progress=False)
    assert open_scans(tmp_path / "out")[0].domain == SYNTHETIC
