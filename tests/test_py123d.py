"""py123d's logs, as its own writer writes them (``golden/py123d``): every value that was written is
read."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from py123d_files import (
    MOUNT,
    TO_NUSCENES,
    copy_logs,
    grey,
    in_vehicle,
    in_world,
    split_sensors,
    town_scans,
    write_logs,
)

from lidar_synth.datasets.classes import IGNORE, NUSCENES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import READERS, open_scans, py123d
from lidar_synth.geometry.scan import Scan

CODECS = ["laz", "draco", "ipc", "ipc_zstd"]


@pytest.fixture(scope="module")
def town() -> list[Scan]:
    """The scans that the logs hold."""
    return town_scans()


def check(root: Path, town: list[Scan]) -> None:
    """The scans of the logs are those of the town, as far as the format can hold them."""
    scans = open_scans(root)
    assert type(scans).__name__ == "Py123D"
    assert scans.sensor.name == "hdl32e_nuscenes"
    assert scans.ids == (
        "nuscenes_train/log0/000000",
        "nuscenes_train/log1/000000",
        "nuscenes_val/log2/000000",
    )
    for read, sent in zip(scans, town, strict=True):
        assert np.allclose(read.points, sent.points, atol=0.011)  # LAZ keeps 1 cm
        assert np.array_equal(read.reflectance, grey(sent) / np.float32(255))
        assert sent.ring is not None and sent.label is not None and sent.boxes
        assert np.array_equal(read.ring, sent.ring)
        known = sent.label != IGNORE
        classes = TO_NUSCENES[np.where(known, sent.label, 0)] * known
        assert np.array_equal(read.raw_label, classes)
        assert np.array_equal(read.label, NUSCENES.decode(classes))
        assert read.time is not None
        assert np.allclose(read.time, np.arange(len(sent)) * 1e-5)
        check_boxes(read, sent)
        placed = in_world(in_vehicle(sent.points))
        assert read.pose is not None
        world = read.points @ read.pose[:3, :3].T + read.pose[:3, 3]
        assert np.allclose(world, placed, atol=0.02)


def check_boxes(read: Scan, sent: Scan) -> None:
    """Centres of gravity and yaw in the frame of the sensor."""
    assert sent.boxes is not None and read.boxes is not None and len(sent.boxes)
    turned = read.boxes.values[:, 6] - sent.boxes.values[:, 6]
    assert np.allclose(read.boxes.values[:, :6], sent.boxes.values[:, :6], atol=2e-4)
    assert np.allclose(np.cos(turned), 1, atol=1e-6)
    kept = {"Car": "Car", "Truck": "Truck"}
    assert read.boxes.names == tuple(
        kept.get(name, "Pedestrian") for name in sent.boxes.names
    )
    assert len(set(read.boxes.instance.tolist())) == len(read.boxes)


def test_what_py123d_wrote_is_read(tmp_path: Path, town: list[Scan]) -> None:
    pytest.importorskip("pyarrow")
    copy_logs(tmp_path)
    check(tmp_path, town)


def test_firings_without_a_return_are_dropped_as_in_nuscenes(
    tmp_path: Path, town: list[Scan], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    copy_logs(tmp_path)
    read_cloud = py123d._cloud

    def with_empty_firings(*given: Any) -> dict[str, np.ndarray]:
        cloud = read_cloud(*given)
        empty = {name: values[-100:] for name, values in cloud.items()}
        empty["xyz"] = np.tile(MOUNT[:3], (100, 1))  # the sensor's place in the vehicle
        return {n: np.concatenate([values, empty[n]]) for n, values in cloud.items()}

    monkeypatch.setattr(py123d, "_cloud", with_empty_firings)
    check(tmp_path, town)


@pytest.mark.parametrize("codec", CODECS)
def test_every_codec_is_read(tmp_path: Path, town: list[Scan], codec: str) -> None:
    pytest.importorskip("py123d.datatypes")
    write_logs(tmp_path, town, codec)
    check(tmp_path, town)


def test_splits_are_kept_apart(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    copy_logs(tmp_path)
    for name in ("train", "nuscenes_train"):
        ids = open_scans(tmp_path, split=name).ids
        assert [i.split("/")[1] for i in ids] == ["log0", "log1"]
    assert (
        open_scans(tmp_path, split="val").ids
        == open_scans(tmp_path / "nuscenes_val").ids
    )
    with pytest.raises(ConfigError, match="one of nuscenes_train, nuscenes_val"):
        open_scans(tmp_path, split="test")


def test_another_sensor_of_the_log(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    copy_logs(tmp_path)
    scans = READERS["py123d"](tmp_path, lidar=3)  # type: ignore[call-arg]
    scans.skip_sensor_check()
    assert len(scans[0]) == 5
    absent = READERS["py123d"](tmp_path, lidar=6)  # type: ignore[call-arg]
    with pytest.raises(DataError, match=r"has no sensor 6; expected one of \[2, 3\]"):
        absent[0]


def test_a_sensor_of_a_log_with_a_file_for_each(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    copy_logs(tmp_path)
    reader: Any = READERS["py123d"]
    places = {}
    for number in (2, 3):
        merged = reader(tmp_path, lidar=number)
        places[number] = merged.read(0).pose
    split_sensors(tmp_path)
    for number in (2, 3):
        own = reader(tmp_path, lidar=number)
        assert np.array_equal(own.read(0).pose, places[number])
    with pytest.raises(DataError, match="has no sensor 0"):
        reader(tmp_path, lidar=0).read(0)


@pytest.mark.parametrize("keep", [0, 100, -200])
def test_a_damaged_file_is_named(tmp_path: Path, keep: int) -> None:
    pytest.importorskip("pyarrow")
    path = copy_logs(tmp_path)[1]
    path.write_bytes(path.read_bytes()[:keep])
    scans = open_scans(tmp_path, on_bad="skip")
    with pytest.warns(UserWarning, match=r"lidar_merged.arrow is damaged"):
        assert [scan.id for scan in scans] == [scans.ids[0], scans.ids[2]]


def test_logs_without_clouds_are_refused(tmp_path: Path, town: list[Scan]) -> None:
    pytest.importorskip("py123d.datatypes")
    write_logs(tmp_path, town, lidar=False)
    with pytest.raises(DataError, match=r"holds no scan; expected py123d's logs"):
        open_scans(tmp_path)


def test_clouds_of_the_raw_dataset(
    tmp_path: Path, town: list[Scan], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("py123d.datatypes")
    from py123d.common.runtime import dataset_paths

    write_logs(tmp_path / "logs", town, path="sweep.pcd.bin")
    scans = open_scans(tmp_path)
    monkeypatch.setattr(dataset_paths, "_global_dataset_paths", None)
    monkeypatch.delenv("NUSCENES_DATA_ROOT", raising=False)
    with pytest.raises(DataError, match=r"refers to sweep.pcd.bin of nuscenes .*_ROOT"):
        scans[0]
    monkeypatch.setattr(dataset_paths, "_global_dataset_paths", None)
    monkeypatch.setenv("NUSCENES_DATA_ROOT", str(tmp_path))
    x, y, z = town[0].points.T
    ring = 31 - np.asarray(town[0].ring)
    raw = np.column_stack([-y, x, z, grey(town[0]), ring]).astype("<f4")
    raw.tofile(tmp_path / "sweep.pcd.bin")
    scan = scans[0]
    assert np.allclose(scan.points, town[0].points, atol=1e-4)
    assert np.array_equal(scan.ring, town[0].ring)


def test_without_the_extra_the_error_says_what_to_install(tmp_path: Path) -> None:
    copy_logs(tmp_path)
    program = (
        "import sys; sys.modules['pyarrow'] = None\n"
        "from lidar_synth.formats import open_scans\nopen_scans('.')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "pip install 'lidar_synth[py123d]'" in done.stderr
