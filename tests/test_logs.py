"""PCD logs as the vendors' drivers write them reach a fitted sensor, a picture and a mixture by one
command each."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from logs import LOGS, axes, turn_time, write_log
from test_fit_sensor import run

from lidar_synth import MixedScans, load_sensor, open_scans
from lidar_synth.errors import DataError
from lidar_synth.formats.folder import rows_of_rings
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.town import Town

SCANS = 1


def town_of(name: str) -> list[Scan]:
    town = Town(0, LOGS[name].sensor, SCANS, motion=False)
    return [town[i] for i in range(SCANS)]


@pytest.mark.slow
@pytest.mark.parametrize("name", LOGS)
def test_a_log_reaches_a_sensor_a_picture_and_a_mixture(
    name: str, tmp_path: Path
) -> None:
    folder = tmp_path / "logs"
    fitted = tmp_path / "mine.yaml"
    scans = town_of(name)
    folder.mkdir()
    for number, scan in enumerate(scans):
        write_log(folder / f"{number}.pcd", LOGS[name].columns(scan))
    assert run("sensor", "fit", folder, "--out", fitted) == 0
    assert run("view", folder, "--sensor", fitted, "--out", tmp_path / "view.png") == 0
    real = open_scans(folder, sensor=fitted)
    mixed = MixedScans(real, Town(1, load_sensor(fitted), 2), ratio=0.5, labels="none")
    assert len(mixed) and {mixed.domain(i) for i in range(len(mixed))} == {0, 1}

    sensor = load_sensor(fitted)
    read = real[0]
    own = scans[0]
    there = (
        np.ones(len(own), bool)
        if name != "ouster"
        else LOGS[name].columns(own)["range"] > 0
    )
    beams = np.degrees(own.sensor.row_elevations())
    assert np.abs(np.array(sensor.elevations) - beams).max() < 0.02
    assert np.array_equal(read.points, own.points[there]) and np.array_equal(
        read.ring, own.ring[there]
    )
    assert np.allclose(read.reflectance, own.reflectance[there], atol=0.5 / 255 + 1e-6)
    since = turn_time(own)[there] - turn_time(own)[there].min()
    assert read.time is not None and np.allclose(
        read.time - read.time.min(), since, atol=1e-6
    )


def rays(count: int = 128) -> Scan:
    """A return of each ray of a sensor with dense beams, with the row as ring."""
    sensor = replace(load_sensor("os1_128"), columns=count)
    points = 20 * sensor.ray_directions().reshape(-1, 3)
    ring = np.repeat(np.arange(sensor.shape[0], dtype=np.int16), count)
    return Scan(points, np.full(len(points), 0.5, np.float32), sensor, ring=ring)


@pytest.mark.parametrize(("pitch", "lost"), [(0.0, 0.6), (0.5, 0.0), (2.0, 0.0)])
@pytest.mark.filterwarnings("ignore:scan a of")  # that it is tilted
def test_each_ring_of_a_log_gets_its_own_row(
    tmp_path: Path, pitch: float, lost: float
) -> None:
    scan = rays()
    cosine, sine = np.cos(np.radians(pitch)), np.sin(np.radians(pitch))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    there = np.random.default_rng(0).random(len(scan)) >= lost
    points = np.where(there[:, None], scan.points @ turn.T, np.nan)
    tilted = replace(scan, points=points.astype(np.float32))
    ring = (200 - scan.ring).astype(np.uint8)
    write_log(tmp_path / "a.pcd", {**axes(tilted), "i": scan.reflectance, "ring": ring})
    read = open_scans(tmp_path, sensor=scan.sensor, on_bad="drop-points")[0]
    assert np.array_equal(read.ring, scan.ring[there])


def test_more_rings_than_the_sensor_has_rows_stay_apart() -> None:
    scan = replace(rays(), sensor=load_sensor("vlp16"))
    assert np.array_equal(rows_of_rings(scan), scan.ring)


@pytest.mark.filterwarnings("ignore:scan a of")  # of its points
def test_a_log_in_the_frame_of_a_vehicle_is_brought_into_the_sensors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = town_of("velodyne")[0]
    columns = LOGS["velodyne"].columns(scan)
    on_vehicle = replace(scan, points=scan.points + np.float32([1.2, 0, 1.8]))
    write_log(tmp_path / "a.pcd", columns | axes(on_vehicle))
    fitted = tmp_path / "mine.yaml"
    assert run("sensor", "fit", tmp_path, "--out", fitted, "--json") == 0
    place = json.loads(capsys.readouterr().out)["place of the sensor"]
    formula = place.split("by (points - ")[1].split(") @ ")
    offset, turn = (np.float32(json.loads(text)) for text in formula)
    with pytest.warns(UserWarning, match="rings keep the numbers of the files"):
        read = open_scans(tmp_path, sensor=fitted)[0]
    assert np.array_equal(read.ring, columns["ring"])
    there = replace(read, points=(read.points - offset) @ turn)
    write_log(tmp_path / "a.pcd", columns | axes(there))
    assert np.array_equal(open_scans(tmp_path, sensor=fitted)[0].ring, scan.ring)


def test_rings_become_rows_of_the_sensor_that_the_folder_names(tmp_path: Path) -> None:
    scan = town_of("velodyne")[0]
    write_log(tmp_path / "a.pcd", LOGS["velodyne"].columns(scan))
    said = {"format": "lidar-synth-scans/1", "sensor": "vlp16"}
    (tmp_path / "scans.json").write_text(json.dumps(said))
    assert np.array_equal(open_scans(tmp_path)[0].ring, scan.ring)


@pytest.mark.parametrize("name", ["time", "t", "timestamp"])
@pytest.mark.parametrize(
    ("kind", "start", "unit"),
    [
        *(("f4", 0, 10**n) for n in (0, 3, 6, 9)),
        *(("f8", 1.7e5, 10**n) for n in (0, 3, 6, 9)),
        *(("u8", 1.7e5, 10**n) for n in (3, 6, 9)),
    ],
)
def test_times_are_read_in_any_unit(
    tmp_path: Path, name: str, kind: str, start: float, unit: int
) -> None:
    scan = rays(8)
    time = np.linspace(0, 0.1, len(scan))
    given = np.round((start + time) * unit, 5).astype(kind)
    write_log(tmp_path / "a.pcd", {**axes(scan), "i": scan.reflectance, name: given})
    read = open_scans(tmp_path, sensor=scan.sensor)[0].time
    assert read is not None and np.allclose(read, time, atol=1.1 / max(unit, 1000))


@pytest.mark.parametrize("empty", [0.0, np.nan])
def test_firings_without_a_return_are_dropped_and_their_times_do_not_count(
    tmp_path: Path, empty: float
) -> None:
    scan = rays(8)
    lost = np.arange(len(scan)) % 5 == 0
    points = np.where(lost[:, None], np.float32(empty), scan.points)
    time = 1.7e9 + np.linspace(0, 0.1, len(scan))
    columns = axes(replace(scan, points=points)) | {"i": scan.reflectance}
    columns |= {"ring": scan.ring, "timestamp": np.where(lost, empty, time)}
    write_log(tmp_path / "a.pcd", columns)
    read = open_scans(tmp_path, sensor=scan.sensor)[0]
    assert np.array_equal(read.points, scan.points[~lost])
    since = time[~lost] - time[~lost].min()
    assert read.time is not None and np.allclose(read.time, since, atol=1e-6)


def test_times_of_bad_points_do_not_count(tmp_path: Path) -> None:
    scan = rays(8)
    bad = np.arange(len(scan)) == 7
    columns = axes(scan) | {"x": np.where(bad, np.float32(np.nan), scan.points[:, 0])}
    time = np.where(bad, 0, 1.7e9 + np.linspace(0, 0.1, len(scan)))
    fields = {"i": scan.reflectance, "ring": scan.ring, "timestamp": time}
    write_log(tmp_path / "a.pcd", columns | fields)
    with pytest.raises(DataError, match="1 of 1024 points are NaN"):
        open_scans(tmp_path, sensor=scan.sensor)[0]
    read = open_scans(tmp_path, sensor=scan.sensor, on_bad="drop-points")[0]
    assert read.time is not None and read.time.max() == pytest.approx(0.1)


def test_rings_may_be_whole_floats(tmp_path: Path) -> None:
    scan = rays(8)
    fields = {"i": scan.reflectance, "ring": scan.ring.astype(np.float32)}
    write_log(tmp_path / "a.pcd", axes(scan) | fields)
    read = open_scans(tmp_path, sensor=scan.sensor)[0]
    assert read.ring is not None and read.ring.dtype == np.int16
    assert np.array_equal(read.ring, scan.ring)


def test_fields_that_are_not_understood_are_reported(tmp_path: Path) -> None:
    scan = rays(8)
    ring = np.where(np.arange(len(scan)) == 3, 65535, scan.ring).astype(np.uint16)
    fields = {"i": 255 * scan.reflectance, "ring": ring, "t": 1e7 * np.arange(1024)}
    write_log(tmp_path / "a.pcd", axes(scan) | fields)
    source = open_scans(tmp_path, sensor=scan.sensor, reflectance_max=255)
    with (
        pytest.warns(UserWarning, match=r"rings .* are ignored: some are no whole"),
        pytest.warns(UserWarning, match=r"times .* are ignored: in no unit"),
    ):
        assert list(source[0].fields()) == ["reflectance"]
    with (
        pytest.warns(UserWarning, match=r"rings .* are ignored"),
        pytest.raises(DataError, match="its reflectance runs from") as error,
    ):
        open_scans(tmp_path, sensor=scan.sensor)[0]
    assert "--reflectance-max 255" in str(error.value)
    assert "--fields" not in str(error.value)


def test_labels_of_other_programs_are_not_taken_for_classes(tmp_path: Path) -> None:
    scan = rays(8)
    ones = np.ones(len(scan))
    foreign = {
        "label": ones.astype(np.uint8),
        "confidence": ones.astype(np.float32),
        "cause": ones.astype(np.uint8),
    }
    write_log(tmp_path / "a.pcd", {**axes(scan), "i": scan.reflectance, **foreign})
    read = open_scans(tmp_path, sensor=scan.sensor)[0]
    assert list(read.fields()) == ["reflectance"]


def test_points_without_reflectance_are_reported(tmp_path: Path) -> None:
    scan = rays(8)
    write_log(tmp_path / "a.pcd", axes(scan))
    with pytest.warns(UserWarning, match="have no reflectance .*: it is read as 0"):
        read = open_scans(tmp_path, sensor=scan.sensor)[0]
    assert not read.reflectance.any()


def test_arrays_of_other_programs_are_read_as_the_folder_says(tmp_path: Path) -> None:
    scan = rays(8)
    arrays = {"points": scan.points, "reflectance": scan.reflectance * 255}
    said = {"format": "lidar-synth-scans/1", "sensor": scan.sensor.to_dict()}
    for name, values in (("points", arrays), ("range", {"range": np.ones((128, 8))})):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "a.npz", **values)
        (tmp_path / name / "scans.json").write_text(json.dumps(said))
    read = open_scans(tmp_path / "points", reflectance_max=255)[0]
    assert read.sensor == scan.sensor and np.array_equal(read.points, scan.points)
    assert np.allclose(read.reflectance, scan.reflectance)
    assert open_scans(tmp_path / "range")[0].sensor == scan.sensor


def test_channels_and_files_without_a_sensor_are_read(tmp_path: Path) -> None:
    scan = town_of("velodyne")[0]
    write_log(
        tmp_path / "a.pcd", {**axes(scan), "channel": scan.ring.astype(np.uint16)}
    )
    source = open_scans(tmp_path / "a.pcd")
    source.skip_sensor_check()
    assert np.array_equal(source[0].ring, scan.ring)
    (tmp_path / "npz").mkdir()
    np.savez(tmp_path / "npz/a.npz", points=scan.points, reflectance=scan.reflectance)
    assert run("sensor", "fit", tmp_path / "npz", "--out", tmp_path / "b.yaml") == 0
    assert load_sensor(tmp_path / "b.yaml").shape[0] == 16


def test_plain_files_are_fitted_with_the_options_of_convert(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = town_of("velodyne")[0]
    values = np.c_[scan.points, 1999 * scan.reflectance, scan.ring].astype("<f4")
    scans = tmp_path / "scans"
    scans.mkdir()
    values.tofile(scans / "a.bin")
    out = tmp_path / "a.yaml"
    assert run("sensor", "fit", scans, "--fields", 5, "--out", out) == 1
    highest = int(np.ceil(values[:, 3].max()))
    assert f"--reflectance-max {highest}" in capsys.readouterr().err
    given = ("--fields", 5, "--layout", "folder", "--reflectance-max", 1999)
    assert run("sensor", "fit", scans, *given, "--out", out) == 0
    picture = tmp_path / "a.png"
    assert run("view", scans, *given, "--sensor", out, "--out", picture) == 0
    assert (
        run(
            "convert",
            scans,
            tmp_path / "out",
            "--to",
            "npz",
            *given,
            "--sensor",
            out,
        )
        == 0
    )
