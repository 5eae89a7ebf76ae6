"""MCAP files of ROS 2 as drivers record them: read scan by scan, and refused where they are
damaged."""

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import some_scan, write_all
from mcap_files import cloud, record, some_record

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans
from lidar_synth.formats.mcap import LARGEST, MCAP
from lidar_synth.geometry.sensor import Sensor

pytest.importorskip("mcap_ros2")
from mcap.writer import CompressionType


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunk_size", [1000, 60_000, 1 << 24])
def test_the_record_of_a_driver_is_read(
    tmp_path: Path, compression: CompressionType, chunk_size: int
) -> None:
    some_record(tmp_path, compression=compression, chunk_size=chunk_size)
    scans = open_scans(tmp_path, sensor="os1_128")
    scans.skip_sensor_check()
    found = [scans[number] for number in (3, 0, 4, 1, 2)]
    assert scans.ids == tuple(f"drive/{n:06d}" for n in range(5))
    for number, scan in zip((3, 0, 4, 1, 2), found, strict=True):
        sent = np.frombuffer(cloud(number)["data"], np.uint8).reshape(-1, 48)
        xyz = sent[:, :12].copy().view("<f4")
        kept = xyz.any(axis=1)
        assert np.array_equal(scan.points, xyz[kept])
        reflectivity = sent[:, 24:26].copy().view("<u2")[kept, 0]
        assert np.allclose(scan.reflectance, reflectivity / 255)
        assert scan.time is not None and scan.time.max() == pytest.approx(0.063)
        assert scan.id == f"drive/{number:06d}"


NO_COUNT = [field | {"count": 0} for field in cloud(0)["fields"]]


@pytest.mark.parametrize(
    "changes", [{"is_dense": False}, {"order": ">"}, {"fields": NO_COUNT}]
)
def test_other_clouds_are_read(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = record(tmp_path / "a.mcap", [("/points", 0, cloud(1, **changes))])
    record(tmp_path / "b.mcap", [("/points", 0, cloud(1))])
    scans = MCAP(tmp_path)
    scans.skip_sensor_check()
    assert scans.ids == ("a", "b") and MCAP(path).ids == ("a",)
    assert np.array_equal(scans[0].points, scans[1].points)
    assert np.array_equal(scans[0].reflectance, scans[1].reflectance)


def test_a_cloud_without_rings_is_read_as_its_error_says(tmp_path: Path) -> None:
    fields = [field for field in cloud(0)["fields"] if field["name"] != "ring"]
    record(tmp_path / "a.mcap", [("/points", 0, cloud(0, fields=fields))])
    with pytest.raises(DataError, match="reflectance_max=255"):
        open_scans(tmp_path, sensor="os1_128")[0]
    scans = open_scans(tmp_path, sensor="os1_128", reflectance_max=255)
    scans.skip_sensor_check()
    assert 0.9 < scans[0].reflectance.max() <= 1
    with pytest.raises(ConfigError, match="no fields: layout 'mcap' has none$"):
        open_scans(tmp_path, fields=5)
    with pytest.raises(ConfigError, match="reflectance_max=0; expected above 0"):
        open_scans(tmp_path, reflectance_max=0)


@pytest.mark.filterwarnings("ignore:scan a of")  # points in a box are of no sensor
def test_rings_become_rows_of_the_sensor_that_the_folder_names(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", [("/points", 0, cloud(0))])
    sensor = Sensor("upward", 64, 1.0, 50.0, rows=8, fov_up=45.0, fov_down=25.0)
    given = open_scans(tmp_path, sensor=sensor)[0]
    said = {"format": "lidar-synth-scans/1", "sensor": sensor.to_dict()}
    (tmp_path / "scans.json").write_text(json.dumps(said))
    assert np.array_equal(open_scans(tmp_path)[0].ring, given.ring)
    unknown = open_scans(tmp_path)
    unknown.skip_sensor_check()
    assert not np.array_equal(unknown[0].ring, given.ring)


def test_a_cloud_without_any_return_is_skipped(tmp_path: Path) -> None:
    lost = cloud(0, is_dense=False)
    points = np.frombuffer(lost["data"], "<f4").reshape(-1, 12).copy()
    points[:, :3] = np.nan
    empty = lost | {"data": points.tobytes()}
    record(tmp_path / "a.mcap", [("/points", 0, empty), ("/points", 1, cloud(1))])
    with pytest.raises(DataError, match="a/000000 holds no points"):
        MCAP(tmp_path)[0]
    scans = MCAP(tmp_path, on_bad="skip")
    scans.skip_sensor_check()
    with pytest.warns(UserWarning, match="skipped scan a/000000"):
        assert [scan.id for scan in scans] == ["a/000001"]


def test_rows_may_have_bytes_at_their_ends(tmp_path: Path) -> None:
    plain = cloud(2)
    rows = np.frombuffer(plain["data"], np.uint8).reshape(8, -1)
    wide = np.pad(rows, ((0, 0), (0, 100)), constant_values=77)
    padded = plain | {"data": wide.tobytes(), "row_step": wide.shape[1]}
    record(tmp_path / "a.mcap", [("/points", 0, plain), ("/points", 1, padded)])
    scans = MCAP(tmp_path)
    scans.skip_sensor_check()
    assert np.array_equal(scans[0].points, scans[1].points)


def test_scans_are_in_the_order_of_their_times(tmp_path: Path) -> None:
    messages = [("/points", time, cloud(time)) for time in (30, 10, 20)]
    record(tmp_path / "a.mcap", messages, chunk_size=1000)
    scans = MCAP(tmp_path)
    scans.skip_sensor_check()
    record(tmp_path / "b" / "b.mcap", [("/points", 0, cloud(10))])
    first = MCAP(tmp_path / "b")
    first.skip_sensor_check()
    assert np.array_equal(scans[0].points, first[0].points)


def test_several_topics_need_a_choice(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", [("/left", 0, cloud(0)), ("/right", 1, cloud(1))])
    with pytest.raises(
        ConfigError, match=r"on /left, /right; expected one topic.*--to"
    ):
        open_scans(tmp_path)
    assert len(open_scans(tmp_path, topic="/right")) == 1
    with pytest.raises(ConfigError, match="on /left, /right; expected /middle"):
        MCAP(tmp_path, topic="/middle")


def test_topics_of_several_files_are_not_mixed(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", [("/front", 0, cloud(0))])
    record(tmp_path / "b.mcap", [("/rear", 0, cloud(1))])
    with pytest.raises(ConfigError, match="on /front, /rear; expected one topic"):
        MCAP(tmp_path)
    assert MCAP(tmp_path, topic="/rear").ids == ("b",)


def test_parts_of_a_record_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        record(tmp_path / f"bag_{number}.mcap", [("/points", number, cloud(number))])
    assert MCAP(tmp_path).ids == ("bag_1", "bag_2", "bag_10")


def test_a_file_without_point_clouds(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", [])
    with pytest.raises(DataError, match="holds no scan"):
        open_scans(tmp_path)


def test_a_file_that_was_not_closed(tmp_path: Path) -> None:
    path = some_record(tmp_path)
    content = path.read_bytes()
    for end in (len(content) // 2, len(content) - 1, 100, 8, 0):
        path.write_bytes(content[:end])
        with pytest.raises(DataError, match="drive.mcap"):
            open_scans(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"point_step": 20, "row_step": 20 * 64}, "with all fields"),
        ({"width": 1 << 20}, "with all fields"),
        ({"height": 1 << 30}, "with all fields"),
        ({"row_step": 10}, "with all fields"),
        ({"data": b""}, "with all fields"),
        ({"width": 0}, "holds no points"),
        ({"fields": cloud(0)["fields"][1:]}, "x, y and z among them"),
        ({"fields": 2 * cloud(0)["fields"]}, "twice"),
    ],
)
def test_messages_that_do_not_fit_together(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    record(tmp_path / "a.mcap", [("/points", 0, cloud(0) | changes)])
    with pytest.raises(DataError, match=message):
        open_scans(tmp_path)[0]


@pytest.mark.parametrize("offset", [16, 9 + 16 + 2])
def test_a_chunk_that_would_not_fit_into_memory_is_refused(
    tmp_path: Path, offset: int
) -> None:
    """Whether the chunk itself declares its size, or zstd's frame in it does."""
    path = some_record(tmp_path, 1, chunk_size=1 << 24)
    content = bytearray(path.read_bytes())
    chunk = content.index(b"\x06", 8)
    while struct.unpack_from("<Q", content, chunk + 1)[0] > len(content):
        chunk = content.index(b"\x06", chunk + 1)
    struct.pack_into("<Q", content, chunk + 9 + 16, LARGEST + 1)
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"a chunk of {LARGEST + 1} bytes"):
        open_scans(tmp_path)[0]


def test_a_damaged_chunk_is_noticed(tmp_path: Path) -> None:
    path = some_record(tmp_path, 1, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    content[content.index(b"os_lidar") + 4000] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="damaged"):
        open_scans(tmp_path)[0]


def test_other_tools_read_what_is_written(tmp_path: Path) -> None:
    from mcap_ros2.reader import read_ros2_messages

    scan = some_scan()
    [path] = write_all("mcap", tmp_path, [scan])
    [message] = read_ros2_messages(str(path), topics=["/points"])
    sent: Any = message.ros_msg
    assert [f.name for f in sent.fields][:4] == ["x", "y", "z", "intensity"]
    records = np.frombuffer(sent.data, np.uint8).reshape(-1, sent.point_step)
    assert np.array_equal(records[:, :12].copy().view("<f4"), scan.points)


@pytest.mark.parametrize("code", ["open_scans('x.mcap')", "WRITERS['mcap']('o')"])
def test_without_the_extra_the_error_says_what_to_install(
    tmp_path: Path, code: str
) -> None:
    write_all("mcap", tmp_path, [some_scan()])
    (tmp_path / "000000.mcap").rename(tmp_path / "x.mcap")
    write = ".write(open_scans('a'), 0)" if code.startswith("W") else ""
    if write:
        write_all("npz", tmp_path / "a", [some_scan()])
        write = ".write(open_scans('a')[0], 0)"
    program = (
        "import sys; sys.modules['mcap_ros2'] = None\n"
        "from lidar_synth.formats import WRITERS, open_scans\n" + code + write
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "pip install 'lidar_synth[mcap]'" in done.stderr
