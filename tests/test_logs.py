"""PCD logs as the vendors' drivers write them reach a fitted sensor, a picture and a mixture by one
command each."""

from pathlib import Path

import numpy as np
import pytest
from logs import LOGS, axes, turn_time, write_log
from test_fit_sensor import run

from lidar_synth import MixedScans, load_sensor, open_scans
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
    values.tofile(tmp_path / "a.bin")
    out = tmp_path / "a.yaml"
    assert run("sensor", "fit", tmp_path, "--fields", 5, "--out", out) == 1
    highest = int(np.ceil(values[:, 3].max()))
    assert f"--reflectance-max {highest}" in capsys.readouterr().err
    given = ("--fields", 5, "--layout", "folder", "--reflectance-max", 1999)
    assert run("sensor", "fit", tmp_path, *given, "--out", out) == 0
    assert (
        run("view", tmp_path, *given, "--sensor", out, "--out", tmp_path / "a.png") == 0
    )
    assert (
        run(
            "convert",
            tmp_path,
            tmp_path / "out",
            "--to",
            "npz",
            *given,
            "--sensor",
            out,
        )
        == 0
    )
