"""Points are compared with the sensor that they are said to come from."""

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import _folder
from layouts import write_all, write_kitti_raw
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError
from lidar_synth.formats import (
    KITTI360,
    WRITERS,
    KITTIObject,
    KITTIRaw,
    NuScenes,
    SemanticKITTI,
    open_scans,
)
from lidar_synth.formats.convert import convert
from lidar_synth.formats.description import NAME
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.agreement import MOST_OUTSIDE, Agreement, agreement
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor

Points = NDArray[np.float32]

HDL64, HDL32, OS1 = (
    load_sensor(name) for name in ("hdl64e_kitti", "hdl32e_nuscenes", "os1_128")
)
VLP16 = Sensor(
    "vlp16", 1800, 0.5, 100.0, elevations=tuple(float(e) for e in range(15, -16, -2))
)


def street(sensor: Sensor, seed: int = 0, tilt: float = 0.0) -> Points:
    """Points on the beams of a sensor that stands 1.7 m above a flat road between walls, in degrees
    tilted forward."""
    azimuth = sensor.column_azimuths().astype(np.float64)[None, :]
    elevation = sensor.laser_elevations.astype(np.float64)[:, None]
    height = np.asarray(sensor.heights or np.zeros(sensor.shape[0]))[:, None]
    rng = np.random.default_rng(seed)
    wall = 12 + 40 * np.abs(np.sin(3 * azimuth + rng.uniform(0, 6))) + 0 * elevation
    road = np.where(
        elevation < -0.01,
        (1.7 + height) / np.sin(np.minimum(-elevation, np.pi / 2) + 1e-9),
        np.inf,
    )
    distance = np.minimum(wall / np.cos(elevation), road)
    distance = distance + rng.normal(0, 0.02, distance.shape)
    flat = distance * np.cos(elevation)
    up = distance * np.sin(elevation) + height
    points = np.stack(
        [flat * np.cos(azimuth), -flat * np.sin(azimuth), up], -1
    ).reshape(-1, 3)
    c = np.cos(np.radians(tilt))
    s = np.sin(np.radians(tilt))
    points = points @ np.array([(c, 0, s), (0, 1, 0), (-s, 0, c)])
    within = np.linalg.norm(points, axis=1)
    return points[(within > sensor.range_min) & (within < sensor.range_max)].astype(
        np.float32
    )


def quantised(points: Points) -> Points:
    """The points as they are after a projection to the grid of an HDL-64E, one in the centre of
    each cell."""
    return unproject(
        project(Scan(points, np.zeros(len(points), np.float32), HDL64))
    ).points


def nearest_beam(points: Points, sensor: Sensor) -> NDArray[np.intp]:
    """The number of the beam of each point, from the lowest."""
    beams = np.sort(sensor.laser_elevations)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    return np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation)


def every_fourth(points: Points) -> Points:
    return points[nearest_beam(points, HDL64) % 4 == 0]


def sixteen(points: Points) -> Points:
    return points[
        (nearest_beam(points, HDL64) >= 40) & (nearest_beam(points, HDL64) < 56)
    ]


OWN: dict[str, tuple[Points, Sensor]] = {
    "HDL-64E": (street(HDL64), HDL64),
    "HDL-64E, tilted": (street(HDL64, tilt=0.5), HDL64),
    "HDL-64E, on the grid of its range image": (quantised(street(HDL64)), HDL64),
    "HDL-64E, in front": (street(HDL64)[street(HDL64)[:, 0] > 5], HDL64),
    "HDL-64E, every tenth point": (street(HDL64)[::10], HDL64),
    "HDL-32E": (street(HDL32), HDL32),
    "OS1-128": (street(OS1), OS1),
    "VLP-16": (street(VLP16), VLP16),
    "firings without a return": (
        np.concatenate([street(HDL64), np.zeros((90_000, 3), np.float32)]),
        HDL64,
    ),
    "few points": (street(OS1)[:900], HDL64),
    "no points": (np.zeros((0, 3), np.float32), HDL64),
    "NaN": (np.full((5000, 3), np.nan, np.float32), HDL64),
}

WRONG: dict[str, tuple[Points, Sensor, str]] = {
    "OS1-128 as HDL-64E": (
        street(OS1),
        HDL64,
        r"% of the points lie above 3\.0 degrees",
    ),
    "HDL-32E as HDL-64E": (street(HDL32), HDL64, "above 3.0 degrees"),
    "VLP-16 as HDL-64E": (
        street(VLP16),
        HDL64,
        "above 3.0 degrees.*beams have no points",
    ),
    "HDL-64E as VLP-16": (street(HDL64), VLP16, "below -16.0 degrees"),
    "HDL-64E as HDL-32E": (street(HDL64), HDL32, "lie between the beams"),
    "16 beams, one of four, as HDL-64E": (
        every_fourth(street(HDL64)),
        HDL64,
        "though beams around them have",
    ),
    "16 neighbouring beams as HDL-64E": (
        sixteen(street(HDL64)),
        HDL64,
        "7. % of the 64 beams have no points",
    ),
    "far points": (
        street(replace(HDL64, range_max=200.0)) * np.float32(3),
        HDL64,
        "farther than 80 m",
    ),
    "near points": (street(HDL64), replace(HDL64, range_min=20.0), "nearer than 20 m"),
    "flattened": (
        street(HDL64) * np.array([1, 1, 0.3], np.float32),
        HDL64,
        "between the beams|no points",
    ),
}


@pytest.mark.parametrize("name", OWN)
def test_points_of_the_sensor_itself(name: str) -> None:
    points, sensor = OWN[name]
    assert agreement(points, sensor).faults(sensor) == []


@pytest.mark.parametrize("name", WRONG)
def test_points_of_another_sensor(name: str) -> None:
    points, sensor, message = WRONG[name]
    found = "; ".join(agreement(points, sensor).faults(sensor))
    assert found and re.search(message, found), found


def test_a_tilt_puts_no_point_outside_of_the_field_of_view() -> None:
    """A beam of a scan that leans forward looks up behind the sensor, as all beams of real scans do
    a little."""
    assert (
        agreement(street(HDL64, tilt=0.9), HDL64).outside
        == 0
        < agreement(street(HDL64, tilt=2.5), HDL64).outside
    )


def test_shares_do_not_depend_on_the_order_of_points() -> None:
    points = street(OS1)
    other = agreement(points[np.random.default_rng(0).permutation(len(points))], HDL64)
    np.testing.assert_allclose(other, agreement(points, HDL64), atol=0.02)
    assert agreement(points, HDL64).outside > MOST_OUTSIDE


SENSORLESS: dict[str, Callable[[Path, Scan], object]] = {
    "kitti_raw": lambda root, scan: [
        np.column_stack([scan.points, scan.reflectance]).tofile(path)
        for path in write_kitti_raw(root)
    ],
    **{
        to: lambda root, scan, to=to: (
            write_all(to, root, [scan]),
            (root / NAME).unlink(),
        )  # type: ignore[misc]
        for to in ("kitti", "semantic_kitti", "kitti360")
    },
    "npy": lambda root, scan: np.save(
        root / "scan.npy", np.column_stack([scan.points, scan.reflectance])
    ),
}
"""Writers of a scan in a layout that names no sensor."""


def a_scan(points: Points, sensor: Sensor = OS1) -> Scan:
    return Scan(
        points,
        np.full(len(points), 0.5, np.float32),
        sensor,
        label=np.zeros(len(points), np.uint8),
    )


@pytest.mark.parametrize("layout", SENSORLESS)
def test_readers_refuse_points_of_another_sensor_than_their_layout_has(
    tmp_path: Path, layout: str
) -> None:
    SENSORLESS[layout](tmp_path, a_scan(street(OS1)))
    for on_bad in ("error", "skip", "drop-points"):
        with pytest.raises(
            ConfigError,
            match=r"read as one of sensor 'hdl64e.*lie above 3\.0 degrees.*--sensor",
        ):
            open_scans(tmp_path, on_bad=on_bad)[0]  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="read as one of sensor"):
        next(iter(open_scans(tmp_path)))
    with pytest.warns(UserWarning, match="read as one of sensor 'hdl64e_kitti'"):
        assert len(open_scans(tmp_path, sensor="hdl64e_kitti")[0]) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(open_scans(tmp_path, sensor=OS1)[0]) > 0


def test_one_scan_of_a_source_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = []

    def counted(points: Points, sensor: Sensor) -> Agreement:
        compared.append(len(points))
        return agreement(points, sensor)

    monkeypatch.setattr("lidar_synth.formats.source.agreement", counted)
    write_all(
        "kitti", tmp_path, [a_scan(street(HDL64, seed), HDL64) for seed in range(3)]
    )
    assert len(list(open_scans(tmp_path))) == 3 and compared == []
    (tmp_path / NAME).unlink()
    source = open_scans(tmp_path)
    assert len([*source, *source]) == 6 and len(compared) == 1
    source.check_sensor()
    assert len(compared) == 1


def test_a_conversion_that_is_refused_leaves_nothing_behind(tmp_path: Path) -> None:
    SENSORLESS["kitti360"](tmp_path / "in", a_scan(street(OS1)))
    with pytest.raises(ConfigError, match="hdl64e_kitti360"):
        convert(
            open_scans(tmp_path / "in"),
            WRITERS["range"](tmp_path / "out"),
            progress=False,
        )
    assert not (tmp_path / "out").exists()
    convert(
        open_scans(tmp_path / "in", sensor=OS1),
        WRITERS["range"](tmp_path / "out"),
        progress=False,
    )
    assert open_scans(tmp_path / "out").sensor == OS1


def test_beams_that_do_not_fit_are_a_warning(tmp_path: Path) -> None:
    SENSORLESS["kitti"](tmp_path, a_scan(every_fourth(street(HDL64)), HDL64))
    with pytest.warns(
        UserWarning, match="beams have no points though beams around them have"
    ):
        assert open_scans(tmp_path)[0].sensor == HDL64


def test_a_damaged_first_scan_does_not_prevent_the_comparison(tmp_path: Path) -> None:
    SENSORLESS["kitti"](tmp_path, a_scan(street(OS1)))
    (tmp_path / "000000.bin").rename(tmp_path / "000001.bin")
    (tmp_path / "000000.label").unlink()
    (tmp_path / "000000.bin").write_bytes(b"damaged")
    source = open_scans(tmp_path, on_bad="skip")
    with pytest.raises(ConfigError, match="scan 000001"):
        source.check_sensor()


def pandar64(folder: Path) -> Sensor:
    rows = np.loadtxt(
        folder / "pandaset" / "pandar64_elevations.csv", delimiter=",", skiprows=1
    )
    return Sensor("pandar64", 1800, 0.3, 200.0, elevations=tuple(rows[:, 1]))


def recorded(real: Path) -> Iterator[ScanFiles]:
    """Every recorded dataset, read with its own preset."""
    yield from (
        KITTI360(real / "kitti360"),
        SemanticKITTI(real / "semantic_kitti"),
        KITTIRaw(real / "kitti_raw"),
    )
    yield from (
        KITTIObject(real / "kitti_object"),
        KITTIObject(real / "kitti_object", reduced=True),
    )
    yield NuScenes(real / "nuscenes")


@pytest.fixture(scope="module")
def labelled() -> Path:
    return _folder("LIDAR_SYNTH_LABELLED_SCANS")


def agrees(points: Points, sensor: Sensor) -> bool:
    return agreement(points, sensor).faults(sensor) == []


@pytest.mark.slow
def test_every_recorded_scan_agrees_with_its_own_sensor(
    real_scans: Path, labelled: Path
) -> None:
    scans = [
        scan
        for source in (
            *recorded(real_scans),
            SemanticKITTI(labelled / "semantic_kitti"),
        )
        for scan in source
    ]
    assert len(scans) > 50
    wrong = {
        scan.id: agreement(scan.points, scan.sensor)
        for scan in scans
        if not agrees(scan.points, scan.sensor)
    }
    assert wrong == {}


@pytest.mark.slow
def test_recorded_scans_contradict_other_sensors(
    real_scans: Path, labelled: Path
) -> None:
    own = pandar64(labelled)
    for path in sorted((labelled / "pandaset" / "sensor_frame").glob("*.npz"))[::6]:
        points = np.load(path)["points"].astype(np.float32)
        assert agrees(points, own)
        # refused if HDL-64E is only assumed
        assert agreement(points, HDL64).outside > MOST_OUTSIDE
        assert not agrees(points, HDL32) and not agrees(points, VLP16)
    sweep = NuScenes(real_scans / "nuscenes")[0].points
    assert (
        agreement(sweep, HDL64).outside > MOST_OUTSIDE
        and not agrees(sweep, own)
        and not agrees(sweep, OS1)
    )
    for scan in list(KITTI360(real_scans / "kitti360"))[::4]:
        assert not agrees(every_fourth(scan.points), HDL64) and not agrees(
            sixteen(scan.points), HDL64
        )
        assert not agrees(scan.points, HDL32) and not agrees(scan.points, VLP16)
