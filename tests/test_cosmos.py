"""LiDAR tensors of NVIDIA's Cosmos: as its models take and return them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import some_scan, write_all
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans
from lidar_synth.formats.cosmos import Cosmos, write_sweeps
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import SYNTHETIC
from lidar_synth.geometry.sensor import load_sensor

SHAPE = 3, 2, 128, 1800


def frames() -> NDArray[np.float32]:
    """What a model returns: validity lies between 0 and 1, cells without return hold anything."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, SHAPE).astype(np.float32)
    values[0] = rng.uniform(1, 150, SHAPE[1:])
    return values


def test_sweeps_are_written_as_the_models_take_them(tmp_path: Path) -> None:
    scans = [some_scan(seed, sensor="pandar128") for seed in range(3)]
    scans = [replace(scan, domain=SYNTHETIC) for scan in scans]
    write_sweeps(tmp_path / "drive.safetensors", scans)
    content = load_file(tmp_path / "drive.safetensors")
    assert list(content) == ["frames"]
    assert content["frames"].shape == (3, 3, 128, 1800)
    assert content["frames"].dtype == np.float32
    read = open_scans(tmp_path)
    assert isinstance(read, Cosmos) and read.ids[2] == "drive/000002"
    assert read.sensor == load_sensor("pandar128")
    for number, scan in enumerate(scans):
        image = project(scan)
        distance, intensity, valid = content["frames"][:, number]
        assert np.array_equal(distance, image.range)
        assert np.array_equal(intensity, image.channels["reflectance"])
        assert np.array_equal(valid, image.mask)
        assert read[number].domain == SYNTHETIC
        again = project(read[number])
        np.testing.assert_allclose(again.range, image.range, atol=1e-4)
        assert np.array_equal(again.mask, image.mask)


def test_what_a_model_returns_is_read(tmp_path: Path) -> None:
    values = frames()
    save_file({"frames": values}, tmp_path / "out.safetensors")
    source = open_scans(tmp_path / "out.safetensors")
    assert source.sensor.name == "pandar128" and len(source) == 2
    valid = values[2, 1] >= 0.5
    scan = source[1]
    assert len(scan) == valid.sum()
    lengths = np.linalg.norm(scan.points, axis=1)
    np.testing.assert_allclose(lengths, values[0, 1][valid], rtol=1e-5)
    assert np.array_equal(scan.reflectance, values[1, 1][valid])
    behind = np.zeros(SHAPE, np.float32)
    behind[:, :, 0, 0] = 1  # the first column is behind the sensor, on its left
    save_file({"frames": behind}, tmp_path / "out.safetensors")
    [point] = open_scans(tmp_path / "out.safetensors")[0].points
    assert point[0] < 0 < point[1] < 0.01 and point[2] == pytest.approx(
        0.2493, abs=1e-4
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": np.zeros((3, 128, 1800), "f4")}, r"shape \(3, 128, 1800\)"),
        ({"frames": np.zeros((2, 1, 128, 1800), "f4")}, r"shape \(2, 1,"),
        ({"frames": np.zeros((3, 0, 128, 1800), "f4")}, r"shape \(3, 0,"),
        ({"frames": np.zeros((3, 1, 2, 2), "f8")}, "holds F64"),
        ({"weight": np.zeros(3, "f4")}, r"holds \['weight'\]"),
        ({"frames": np.full((3, 1, 64, 1800), 0.5, "f4")}, r"expected \(128, 1800\)"),
        ({"frames": np.full((3, 1, 128, 1800), 2, "f4")}, "reflectance from 2.0"),
        ({"frames": np.full((3, 1, 128, 1800), np.nan, "f4")}, "holds no points"),
        ({"frames": np.full((3, 1, 128, 1800), np.inf, "f4")}, "not finite"),
    ],
)
def test_other_tensors_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    save_file(content, tmp_path / "a.safetensors")
    with pytest.raises(DataError, match=message):
        open_scans(tmp_path, layout="cosmos")[0]


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    [path] = write_all("cosmos", tmp_path, [some_scan()])
    content = path.read_bytes()
    for damaged in (content[:-1], content[:100], b"", b"not what the name says"):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match="000000.safetensors"):
            open_scans(path, layout="cosmos")


def test_a_checkpoint_is_no_scan(tmp_path: Path) -> None:
    save_file({"weight": np.zeros(3, "f4")}, tmp_path / "model.safetensors")
    assert not Cosmos.recognises(tmp_path)
    assert not Cosmos.recognises(tmp_path / "model.safetensors")


def test_scans_of_several_grids_do_not_fit_into_one_tensor(tmp_path: Path) -> None:
    scans = [some_scan(sensor="pandar128"), some_scan(sensor="os1_128")]
    with pytest.raises(ConfigError, match=r"2 scans of os1_128, pandar128.*pandar128"):
        write_sweeps(tmp_path / "a.safetensors", scans)
    with pytest.raises(ConfigError, match="0 scans of no sensor"):
        write_sweeps(tmp_path / "a.safetensors", [])
