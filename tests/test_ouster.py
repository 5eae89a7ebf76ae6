"""Ouster's metadata as a sensor: both forms of the file, its beams, and files that are none."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from layouts import some_scan, write_all
from ouster_files import LIFT, ouster_metadata

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID, Taxonomy
from lidar_synth.errors import LidarSynthError
from lidar_synth.formats import SemanticKITTI, open_scans
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor


def written(folder: Path, values: Any, name: str = "mine.json") -> Path:
    path = folder / name
    path.write_text(json.dumps(values))
    return path


def sdk_points(metadata: dict[str, Any], distance: float) -> np.ndarray:
    """(H, W, 3) points of equal range in the sensor frame, by the equations of Ouster's SDK.

    https://static.ouster.dev/sdk-docs, "XYZ lookup": the encoder turns clockwise from +x of the
    lidar frame, and lidar_to_sensor turns by half a circle. The distance of the beams from the axis
    (15.8 mm) is left out, as in Sensor.
    """
    beams = metadata["beam_intrinsics"]
    columns = metadata["lidar_data_format"]["columns_per_frame"]
    encoder = 2 * np.pi * (1 - np.arange(columns) / columns)
    azimuth = encoder[None] - np.radians(beams["beam_azimuth_angles"])[:, None]
    altitude = np.radians(beams["beam_altitude_angles"])[:, None] + 0 * azimuth
    lidar = [
        np.cos(azimuth) * np.cos(altitude),
        np.sin(azimuth) * np.cos(altitude),
        np.sin(altitude),
    ]
    points = np.stack([*lidar, np.full_like(altitude, 1 / distance)], -1) * distance
    transform = np.reshape(
        metadata["lidar_intrinsics"]["lidar_to_sensor_transform"], (4, 4)
    ).astype(float)
    transform[:3, 3] /= 1000
    return np.asarray((points @ transform.T)[..., :3])


@pytest.mark.parametrize("flat", [False, True])
def test_both_forms_are_read(tmp_path: Path, flat: bool) -> None:
    sensor = load_sensor(written(tmp_path, ouster_metadata(flat)))
    beams = ouster_metadata()["beam_intrinsics"]
    assert (
        sensor.name == "mine"
        and sensor.shape == (8, 1024)
        and "OS-1-8, 1024x10" in sensor.description
    )
    assert sensor.elevations == tuple(beams["beam_altitude_angles"])
    assert sensor.azimuths == tuple(beams["beam_azimuth_angles"])
    assert sensor.heights == (LIFT / 1000,) * 8
    assert (
        sensor.range_min,
        sensor.range_max,
        sensor.range_step,
        sensor.reflectance_levels,
    ) == (
        0.5,
        200,
        0.001,
        256,
    )
    assert Sensor.from_dict(sensor.to_dict()) == sensor


def test_the_directions_are_those_of_the_sdk(tmp_path: Path) -> None:
    metadata = ouster_metadata()
    sensor = load_sensor(written(tmp_path, metadata))
    points = sdk_points(metadata, 40.0) - (0, 0, LIFT / 1000)
    clockwise = -np.arctan2(points[..., 1], points[..., 0])
    half = np.pi / 1024  # a column's azimuth is that of its middle
    assert np.allclose(
        np.sin(sensor.firing_azimuths() - half - clockwise), 0, atol=1e-9
    )
    assert np.allclose(
        np.cos(sensor.firing_azimuths() - half - clockwise), 1, atol=1e-9
    )
    assert np.allclose(
        np.arcsin(points[..., 2] / 40)[:, 0], sensor.laser_elevations, atol=1e-6
    )


def test_points_of_the_sdk_keep_their_rows(tmp_path: Path) -> None:
    metadata = ouster_metadata()
    sensor = load_sensor(written(tmp_path, metadata))
    points = sdk_points(metadata, 40.0).astype(np.float32).reshape(-1, 3)
    image = project(Scan(points, np.zeros(len(points), np.float32), sensor))
    assert image.mask.mean() > 0.9 and len(unproject(image)) == image.mask.sum()
    rows = np.repeat(np.arange(8), 1024)
    elevation = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    edges = np.degrees(sensor.edges)
    assert ((elevation < edges[rows]) & (elevation > edges[rows + 1])).all()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m["lidar_data_format"].pop("columns_per_frame"), {"columns": 1024}),
        (lambda m: m["config_params"].update(lidar_mode="2048x10"), {"columns": 1024}),
        (
            lambda m: m.update(lidar_data_format="error: Command not recognized."),
            {"columns": 1024},
        ),
        (
            lambda m: m["lidar_data_format"].update(columns_per_frame=4096),
            {"columns": 4096},
        ),
        (
            lambda m: m["lidar_data_format"].update(
                udp_profile_lidar="RNG15_RFL8_NIR8"
            ),
            {"range_step": 0.008},
        ),
        (
            lambda m: m["lidar_data_format"].update(udp_profile_lidar="LEGACY"),
            {"reflectance_levels": None},
        ),
        (lambda m: m.pop("sensor_info"), {"range_max": 400.0}),
        (lambda m: m["sensor_info"].update(prod_line="OS-0-128"), {"range_max": 100.0}),
        (lambda m: m.pop("lidar_intrinsics"), {"heights": None}),
    ],
)
def test_what_a_file_says_and_lacks(
    tmp_path: Path, change: Any, expected: dict[str, Any]
) -> None:
    metadata = ouster_metadata()
    change(metadata)
    sensor = load_sensor(written(tmp_path, metadata))
    assert {key: getattr(sensor, key) for key in expected} == expected


def test_channels_that_the_sensor_lacks_are_left_out(tmp_path: Path) -> None:
    """Firmware 1.13 lists 64 channels for a sensor with 16: the others are 0."""
    metadata = ouster_metadata(flat=True, rows=16)
    for key in ("beam_altitude_angles", "beam_azimuth_angles"):
        metadata[key] = [
            value
            for pair in zip([0] * 16, metadata[key], strict=True)
            for value in pair
        ]
    sensor = load_sensor(written(tmp_path, metadata))
    assert sensor.elevations == tuple(
        ouster_metadata(rows=16)["beam_intrinsics"]["beam_altitude_angles"]
    )


def test_rows_are_sorted_with_their_azimuths(tmp_path: Path) -> None:
    metadata = ouster_metadata(flat=True)
    for key in ("beam_altitude_angles", "beam_azimuth_angles"):
        metadata[key] = metadata[key][::-1]
    upright = load_sensor(written(tmp_path, ouster_metadata(), "a.json"))
    turned = load_sensor(written(tmp_path, metadata, "b.json"))
    assert (turned.elevations, turned.azimuths) == (
        upright.elevations,
        upright.azimuths,
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda m: [],
        lambda m: {},
        lambda m: 7,
        lambda m: m | {"beam_altitude_angles": [1.0]},
        lambda m: m | {"beam_altitude_angles": "many"},
        lambda m: m | {"beam_altitude_angles": [[1.0]] * 8},
        lambda m: m | {"beam_altitude_angles": [float("nan")] * 8},
        lambda m: m | {"beam_altitude_angles": [95.0] * 8},
        lambda m: m | {"beam_altitude_angles": [0] * 8, "beam_azimuth_angles": [0] * 8},
        lambda m: m | {"data_format": {"columns_per_frame": "many"}},
        lambda m: m | {"data_format": {"columns_per_frame": 10**9}},
        lambda m: m | {"data_format": {}, "lidar_mode": "fast"},
        lambda m: m | {"data_format": {}, "lidar_mode": {}},
        lambda m: m | {"prod_line": 7},
        lambda m: m | {"lidar_to_sensor_transform": [1]},
        lambda m: m | {"lidar_to_sensor_transform": [0.0] * 11 + [1e9]},
    ],
)
def test_files_that_describe_no_sensor_are_refused(tmp_path: Path, change: Any) -> None:
    path = written(tmp_path, change(ouster_metadata(flat=True)))
    with pytest.raises(LidarSynthError, match="mine.*; expected "):
        load_sensor(path)


def test_text_that_is_no_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text("{")
    with pytest.raises(
        LidarSynthError, match=r"mine.json is not JSON.*metadata JSON of an Ouster"
    ):
        load_sensor(path)
    path.write_text("[" * (1 << 21))
    with pytest.raises(LidarSynthError, match=r"mine.json is longer than"):
        load_sensor(path)


def test_scans_of_another_sensor_in_semantic_kittis_layout(tmp_path: Path) -> None:
    """SemanticTHAB and SemanticPOSS have this layout; the latter has class ids of its own."""
    path = written(tmp_path, ouster_metadata())
    write_all("semantic_kitti", tmp_path / "data", [some_scan(sensor=str(path))])
    [labels] = (tmp_path / "data").rglob("*.label")
    scan = open_scans(tmp_path / "data", sensor=path)[0]
    assert scan.sensor == load_sensor(path) and project(scan).range.shape == (8, 1024)
    own = np.arange(len(scan), dtype="<u4") % 3
    own.tofile(labels)
    with pytest.raises(
        LidarSynthError,
        match=r"unknown class ids \[2\]; expected class ids of SemanticKITTI",
    ):
        open_scans(tmp_path / "data", sensor=path)[0]
    mine = Taxonomy("mine", {0: IGNORE, 1: TRAIN_ID["person"], 2: TRAIN_ID["car"]})
    scan = SemanticKITTI(tmp_path / "data", sensor=path, taxonomy=mine)[0]
    assert np.array_equal(
        scan.label, np.array([IGNORE, TRAIN_ID["person"], TRAIN_ID["car"]])[own]
    )
    assert np.array_equal(scan.raw_label, own)
