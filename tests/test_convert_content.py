"""What conversion does to the points: unfolding, bad points, intensity scales, real or
synthetic."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from banks import some_image, write_bank
from conversions import a_sequence, app
from layouts import MAKERS, some_scan, write_all
from typer.testing import CliRunner

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import Report, convert
from lidar_synth.geometry.projection import project, unfold, unproject
from lidar_synth.geometry.scan import REAL, SYNTHETIC, RangeImage, Scan
from lidar_synth.geometry.sensor import load_sensor


def rings_of(seed: int) -> Scan:
    """A scan on the beams of its sensor, ring by ring from straight ahead on."""
    sensor = load_sensor("hdl64e_kitti")
    rng = np.random.default_rng(seed)
    lasers = sensor.by_beams()
    distance = np.where(
        rng.random(lasers.shape) < 0.8, rng.uniform(5, 70, lasers.shape), 0
    ).astype(np.float32)
    scan = unproject(RangeImage(distance, lasers))
    row = np.nonzero(distance)[0]
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    return replace(scan[np.lexsort((azimuth, row))], sensor=sensor)


@pytest.mark.slow
def test_conversion_unfolds_scans(tmp_path: Path) -> None:
    scans = [rings_of(i) for i in range(3)]
    write_all("kitti", tmp_path / "in", scans)
    options = [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "range", "--unfold"]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 0, result.output
    read = open_scans(tmp_path / "out")
    for scan, expected in zip(read, scans, strict=True):
        assert np.allclose(project(scan).range, unfold(expected).range, rtol=3e-7)
        assert np.array_equal(
            project(scan).sensor.row_elevations(), expected.sensor.laser_elevations
        )
    for report in (
        Report(written=3),
        Report(kept=3),
    ):  # points on the beams, described beside them
        again = convert(
            open_scans(tmp_path / "in"),
            WRITERS["kitti"](tmp_path / "b"),
            unfold=True,
            progress=False,
        )
        assert (
            again == report
            and open_scans(tmp_path / "b").sensor == scans[0].sensor.by_beams()
        )
    write_all(
        "kitti",
        tmp_path / "shuffled",
        [scans[0][np.random.default_rng(0).permutation(len(scans[0]))]],
    )
    with pytest.raises(DataError, match="ring by ring"):
        convert(
            open_scans(tmp_path / "shuffled"),
            WRITERS["npz"](tmp_path / "no"),
            unfold=True,
            progress=False,
        )
    with pytest.raises(ConfigError, match="was filled with .*'unfold': True"):
        convert(
            open_scans(tmp_path / "in"),
            WRITERS["range"](tmp_path / "out"),
            progress=False,
        )


def with_bad_points(path: Path) -> np.ndarray:
    """Make points 3, 5 and 8 of a ``.bin`` NaN or infinite; which are left."""
    points = np.fromfile(path, "<f4").reshape(-1, 4)
    points[3, 0], points[5, 2], points[8, 3] = np.nan, -np.inf, np.nan
    points.tofile(path)
    return np.isfinite(points).all(1)


@pytest.mark.parametrize(
    "layout",
    ["kitti360", "semantic_kitti", "kitti_object", "kitti_raw", "folder", "nuscenes"],
)
def test_bad_points_are_dropped_with_their_labels_and_counted(
    tmp_path: Path, layout: str
) -> None:
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
    with pytest.raises(
        DataError, match=r"points are NaN or infinite.*--on-bad drop-points"
    ):
        convert(
            open_scans(tmp_path / "in", layout=layout),
            WRITERS["npz"](out),
            progress=False,
        )
    options = ["--to", "npz", "--on-bad", "drop-points", "--layout", layout]
    result = CliRunner().invoke(app, [str(tmp_path / "in"), str(out), *options])
    name = open_scans(tmp_path / "in", layout=layout).ids[1]
    count = len(before) - len(kept)
    assert (
        result.exit_code == 0
        and f"dropped {count} points of {name}, which are NaN or infinite"
        in result.output
    )
    scan = open_scans(out)[1]
    expected = before[kept]
    assert np.array_equal(scan.points, expected.points)
    assert all(
        np.array_equal(scan.fields()[name], values)
        for name, values in expected.fields().items()
    )
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
    points = np.column_stack([scan.points, np.round(scan.reflectance * 255)]).astype(
        "<f4"
    )
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", points)
    with pytest.raises(
        DataError, match=r"on another scale \((--reflectance-max 255)"
    ) as error:
        convert(
            open_scans(tmp_path / "in"),
            WRITERS["kitti"](tmp_path / "no"),
            progress=False,
        )
    advice = re.search(r"\((--\S+ \S+),", str(error.value))
    assert advice is not None
    arguments = [
        str(tmp_path / "in"),
        str(tmp_path / "out"),
        "--to",
        "kitti",
        *advice[1].split(),
    ]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert np.allclose(open_scans(tmp_path / "out")[0].reflectance, points[:, 3] / 255)
    with pytest.raises(ConfigError, match=r"fields=5.* for .*--layout folder"):
        open_scans(a_sequence(tmp_path / "kitti").parents[1], fields=5)


@pytest.mark.parametrize("to", ["semantic_kitti", "kitti_object"])
def test_intensities_on_another_scale_beside_labels(tmp_path: Path, to: str) -> None:
    scan = some_scan(0)
    write_all(to, tmp_path, [scan])
    [path] = tmp_path.rglob("*.bin")
    points = np.fromfile(path, "<f4").reshape(-1, 4)
    (points * np.array([1, 1, 1, 255], "<f4")).tofile(path)
    with pytest.raises(DataError, match="--reflectance-max 255"):
        open_scans(tmp_path)[0]
    source = open_scans(tmp_path, reflectance_max=255)
    assert np.allclose(source[0].reflectance, scan.reflectance)
    assert source.options == open_scans(tmp_path).options | {"reflectance_max": 255}
    with pytest.raises(ConfigError, match="reflectance_max=0; expected above 0"):
        open_scans(tmp_path, reflectance_max=0)


def test_five_floats_per_point(tmp_path: Path) -> None:
    scan = some_scan(0)[:41]  # not a multiple of four
    np.column_stack([scan.points, scan.reflectance, np.zeros(41)]).astype("<f4").tofile(
        tmp_path / "a.bin"
    )
    with pytest.raises(DataError, match="--fields 5"):
        open_scans(tmp_path / "a.bin")[0]
    assert np.array_equal(
        open_scans(tmp_path / "a.bin", fields=5)[0].points, scan.points
    )


@pytest.mark.parametrize("to", ["kitti", "npz", "pcd", "ply", "mcap"])
def test_suffixes_in_capitals(tmp_path: Path, to: str) -> None:
    paths = write_all(to, tmp_path / "in", [some_scan(i) for i in range(3)])
    expected = open_scans(tmp_path / "in")[0]
    for path in (paths[0], paths[2]):  # one stays as it is
        path.rename(path.with_suffix(path.suffix.upper()))
    source = open_scans(tmp_path / "in")
    assert len(source) == 3 and np.array_equal(source[0].points, expected.points)
    assert np.array_equal(
        open_scans(paths[0].with_suffix(paths[0].suffix.upper()))[0].points,
        expected.points,
    )
    assert source[0].label is not None and np.array_equal(
        source[0].label, expected.label
    )
    assert convert(
        source, WRITERS["kitti"](tmp_path / "out"), progress=False
    ) == Report(written=3)


@pytest.mark.parametrize("to", ["kitti", "semantic_kitti", "kitti360", "range", "npz"])
def test_synthetic_scans_stay_synthetic_in_every_format(
    tmp_path: Path, to: str
) -> None:
    bank = write_bank(tmp_path / "bank", [some_image(i) for i in range(2)])[0].parent
    assert (
        convert(open_scans(bank), WRITERS[to](tmp_path / "a"), progress=False).written
        == 2
    )
    first = open_scans(tmp_path / "a")
    assert [scan.domain for scan in first] == [SYNTHETIC] * 2 and first[
        0
    ].domain == SYNTHETIC
    convert(first, WRITERS["kitti"](tmp_path / "b"), progress=False)
    assert open_scans(tmp_path / "b")[0].domain == SYNTHETIC
    if to in ("semantic_kitti", "kitti360"):  # one file of it, too
        assert (
            open_scans(sorted((tmp_path / "a").rglob("*.bin"))[0])[0].domain
            == SYNTHETIC
        )


def test_real_scans_stay_real(tmp_path: Path) -> None:
    MAKERS["kitti360"](tmp_path / "in")
    convert(
        open_scans(tmp_path / "in"),
        WRITERS["semantic_kitti"](tmp_path / "out"),
        progress=False,
    )
    assert {scan.domain for scan in open_scans(tmp_path / "out")} == {REAL}


def test_an_interrupted_run_marks_existing_scans_as_synthetic(tmp_path: Path) -> None:
    bank = write_bank(tmp_path / "bank", [some_image(i) for i in range(3)])[0].parent
    source = open_scans(bank)
    writer = WRITERS["kitti"](tmp_path / "out")
    read = source.read

    def stop(index: int) -> Scan:
        if index == 2:
            raise KeyboardInterrupt
        return read(index)

    source.read = stop  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        convert(source, writer, progress=False)
    assert open_scans(tmp_path / "out")[0].domain == SYNTHETIC
