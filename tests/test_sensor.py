"""Sensors: presets, files, angles and validation."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from lidar_synth.errors import ConfigError, FileError
from lidar_synth.geometry.sensor import Sensor, load_sensor, presets, sensor_yaml
from lidar_synth.geometry.transfer.rays import rays_of

DESIGN = {"hdl64e_kitti360", "hdl64e_kitti", "hdl32e_nuscenes", "os1_128", "town"}

LASERS = {
    "vlp16": (16, 15.0, -15.0),
    "hdl32e": (32, 10.67, -30.67),
    "vls128": (128, 15.0, -25.0),
    "pandar64": (64, 14.87, -24.909),
    "pandar128": (128, 14.436, -25.016),
}
"""{sensor: number of lasers, highest and lowest elevation in degrees} by the manuals."""


def test_all_required_presets_exist() -> None:
    assert set(presets()) >= DESIGN
    values = {
        k: v
        for k, v in presets()["town"].to_dict().items()
        if k not in ("name", "description")
    }
    assert values == {k: presets()["hdl64e_kitti360"].to_dict()[k] for k in values}


@pytest.mark.parametrize("name", LASERS)
def test_tables_of_beams_are_those_of_the_manuals(name: str) -> None:
    sensor, (rows, highest, lowest) = presets()[name], LASERS[name]
    assert sensor.elevations is not None and sensor.shape[0] == rows
    assert (sensor.elevations[0], sensor.elevations[-1]) == (highest, lowest)


def test_lasers_beside_each_other_point_apart() -> None:
    """The VLS-128 fires eight lasers at once, in eight directions; each direction has 16 lasers."""
    azimuths = presets()["vls128"].azimuths
    assert azimuths is not None
    values, counts = np.unique(azimuths, return_counts=True)
    assert values.tolist() == [
        -6.354,
        -4.548,
        -2.732,
        -0.911,
        0.911,
        2.732,
        4.548,
        6.354,
    ] and set(counts) == {16}
    assert (
        dict(zip(presets()["vls128"].elevations or (), azimuths, strict=True))[-11.742]
        == 6.354
    )


def test_a_sensor_is_unchanged_by_yaml_copies_and_files(
    sensor: Sensor, tmp_path: Path
) -> None:
    assert Sensor.from_dict(yaml.safe_load(yaml.safe_dump(sensor.to_dict()))) == sensor
    assert copy.deepcopy(sensor) == sensor  # as pickling would rebuild it
    values = sensor.to_dict()
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump({values.pop("name"): values}))
    assert load_sensor(file) == load_sensor(str(file)) == load_sensor(sensor) == sensor


@pytest.mark.parametrize("rays", ["centre", "corner"])
def test_rays_are_unit_vectors_in_the_documented_frame(
    sensor: Sensor, rays: str
) -> None:
    for s in (sensor, sensor.by_beams()):
        rays_xyz = s.ray_directions(rays)  # type: ignore[arg-type]
        assert rays_xyz.shape == (*s.shape, 3)
        assert np.allclose(np.linalg.norm(rays_xyz, axis=-1), 1, atol=1e-6)
        assert np.all(np.diff(rays_xyz[:, 0, 2]) < 0)  # row 0 is the highest
        middle = s.columns // 2
        # Ahead in the middle, the seam behind.
        assert rays_xyz[0, middle, 0] > 0 and rays_xyz[0, 0, 0] < 0
        # clockwise: to the right of ahead is -y
        assert rays_xyz[0, middle + s.columns // 4, 1] < 0
        assert not rays_xyz.flags.writeable


def test_rows_lie_between_their_edges(sensor: Sensor) -> None:
    for s in (sensor, sensor.by_beams()):
        centres = s.row_elevations()
        assert np.all(s.edges[:-1] > centres) and np.all(centres > s.edges[1:])
        corners = s.row_elevations("corner")
        assert np.array_equal(corners, s.edges[:-1])
        corners += 1  # of the caller's own array
        assert not np.array_equal(corners, s.edges[:-1])


def test_arrays_that_a_sensor_keeps_cannot_be_changed() -> None:
    sensor = presets()["hdl64e_kitti"]
    lasers = replace(sensor.by_beams(), heights=(0.1,) * sensor.shape[0])
    assert len(lasers.starts)
    for s in (sensor, presets()["town"], lasers):
        for kept in (s.edges, s.laser_elevations, s.starts, s.ray_directions()):
            with pytest.raises(ValueError, match="read-only"):
                kept *= 2


@pytest.mark.parametrize("of", ["row_elevations", "column_azimuths", "ray_angles"])
def test_a_word_for_no_point_of_a_cell_is_refused(of: str) -> None:
    with pytest.raises(ConfigError, match=r"rays 'corners'.*Did you mean 'corner'"):
        getattr(presets()["town"], of)("corners")


def test_laser_elevations_are_the_beams_or_the_rows() -> None:
    assert np.allclose(
        np.degrees(presets()["town"].laser_elevations[[0, -1]]),
        [2.53, -23.62],
        atol=1e-5,
    )
    linear = presets()["os1_128"]
    assert np.array_equal(linear.laser_elevations, linear.row_elevations())
    assert linear.by_beams() is linear


@pytest.mark.parametrize(
    ("name", "other", "same"),
    [
        ("hdl64e_lasers", "hdl64e_semantic_kitti", True),
        ("hdl64e_kitti360", "hdl64e_lasers", True),
        ("hdl32e", "hdl32e_nuscenes", True),
        ("pandar64", "hdl64e_lasers", False),
        ("os1_64", "os1_128", False),
    ],
)
def test_one_device_on_two_grids_has_the_same_lasers(
    name: str, other: str, same: bool
) -> None:
    assert load_sensor(name).same_lasers(load_sensor(other)) is same


def test_lasers_of_a_fitted_sensor_point_where_they_were_fitted() -> None:
    """Beams are corrected for the height of their laser; the elevations of ``fit_sensor`` are the
    lasers' own."""
    fitted = Sensor(
        "fitted", 8, 1.0, 90.0, elevations=(2.0, -8.0), heights=(0.05, -0.05)
    )
    elevation, height = fitted.optics()
    assert np.allclose(
        np.degrees(elevation), [2.0, -8.0], atol=1e-5
    ) and height.tolist() == [
        0.05,
        -0.05,
    ]
    rays = rays_of(fitted)
    assert np.allclose(
        rays.height + 9.0 * rays.slope,
        9.0 * np.tan(np.radians([2.0, -8.0])) + height,
        atol=1e-6,
    )
    town = presets()["town"]
    lower = np.asarray(town.heights) > 0
    assert (town.optics()[0][lower] < town.laser_elevations[lower]).all()
    assert town.by_beams().heights is None


GOOD = {
    "name": "x",
    "columns": 8,
    "range_min": 1.0,
    "range_max": 9.0,
    "rows": 4,
    "fov_up": 2.0,
    "fov_down": -2.0,
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": 7}, "an even number"),
        ({"range_max": 0.5}, "range_min < range_max"),
        ({"range_max": float("nan")}, "range_max = nan; expected a finite number"),
        ({"fov_down": 3.0}, "fov_up > fov_down"),
        ({"rows": None}, "either all of rows"),
        ({"elevations": [2.0, 1.0]}, "or elevations"),
        ({"beams": [1.0]}, r"one per row \(4\)"),
        ({"beams": [1.0, 2.0, 3.0, 4.0]}, "highest first"),
        ({"heights": [0.1]}, r"one per row \(4\)"),
        ({"heights": [0.1, 0.1, 0.1, 7.0]}, "within 1 m"),
        ({"name": ""}, "an empty name; expected text"),
        ({"beans": 4}, r"sensor keys \['beans'\]"),
    ],
)
def test_invalid_sensors_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Sensor.from_dict({**GOOD, **change})


def test_numbers_of_numpy_become_those_of_python() -> None:
    numbers = {
        "columns": np.int64(8),
        "rows": np.int32(4),
        "range_min": np.float32(1),
        "range_max": np.float64(9),
    }
    sensor = Sensor.from_dict({**GOOD, **numbers})
    assert sensor == Sensor.from_dict(GOOD) and sensor.to_dict() == GOOD
    assert json.loads(
        json.dumps(sensor.to_dict())
    ) == GOOD and "range_max: 9.0" in sensor_yaml(sensor)


def test_unknown_names_and_invalid_files_are_explained(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="hdl64e_kitti360.*or a .yaml file"):
        load_sensor("hdl65")
    with pytest.raises(FileError, match="cannot be read"):
        load_sensor(tmp_path / "none.yaml")
    (tmp_path / "two.yaml").write_text("a: {}\nb: {}\n")
    with pytest.raises(ConfigError, match="exactly one entry"):
        load_sensor(tmp_path / "two.yaml")
    (tmp_path / "code.yaml").write_text("a: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(ConfigError, match="not YAML"):
        load_sensor(tmp_path / "code.yaml")
    with pytest.raises(ConfigError, match="numbers, as in sensors.yaml"):
        Sensor.from_dict({"name": "x"})
