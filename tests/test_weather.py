"""Weather and failing sensors: physics, labels and boxes, and bad input, for every corruption."""

import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lidar_synth import MixedScans, Town
from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.errors import ConfigError, DataError, LidarSynthError
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.noise import keyed_rng
from lidar_synth.weather import (
    CORRUPTIONS,
    SEVERITIES,
    CrossSensor,
    Fog,
    IncompleteEcho,
    MissingBeams,
    Rain,
    Snow,
    WetGround,
    fog,
    precipitation,
)
from lidar_synth.weather.corruption import COMPENSATED, FLOOR, OUT_OF_SIGHT, SURFACE
from lidar_synth.weather.wet_ground import find_ground, reflect_from_water

WEATHER = ("fog", "rain", "snow")
MOVED = {"motion_blur", "crosstalk"}
"""Corruptions that move points off their rays."""


@pytest.fixture(scope="module")
def clear() -> Scan:
    scan = Town(3, "hdl64e_lasers", scans=13, motion=False)[12]
    raw = np.arange(len(scan), dtype=np.uint32)
    return replace(scan, raw_label=raw, confidence=np.ones(len(scan), np.float32))


def target(distance: np.ndarray, reflectance: float = 1.0) -> Scan:
    """Returns straight ahead at given distances, of vehicles."""
    count = len(distance)
    points = np.zeros((count, 3), np.float32)
    points[:, 0] = distance
    return Scan(
        points,
        np.full(count, reflectance, np.float32),
        load_sensor("hdl64e_kitti"),
        label=np.zeros(count, np.uint8),
    )


@pytest.mark.parametrize("severity", SEVERITIES)
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_every_surviving_return_has_its_old_label_and_place(
    name: str, severity: str, clear: Scan
) -> None:
    corruption = CORRUPTIONS[name].at(severity)
    new = corruption(clear, keyed_rng(1))
    assert 0 < len(new) <= len(clear) and new.boxes is not None
    own = new.raw_label > 0
    index = new.raw_label[own].astype(int)  # the raw label is the point's number
    assert np.array_equal(new.label[own], clear.label[index])
    assert np.array_equal(new.ring[own], clear.ring[index])
    if name not in MOVED:
        assert np.allclose(new.points[own], clear.points[index], atol=1e-4)
    changed = ~own & (np.arange(len(new)) > 0)
    assert (new.label[changed] == IGNORE).all() and (new.confidence[changed] == 0).all()
    assert np.array_equal(new.boxes.values, clear.boxes.values)
    assert (new.reflectance >= 0).all() and (new.reflectance <= 1).all()
    assert np.isfinite(new.points).all() and new.points.dtype == np.float32


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_corruption_is_a_function_of_scan_and_generator(
    name: str, clear: Scan
) -> None:
    before = clear.points.copy(), clear.label.copy(), clear.reflectance.copy()
    corruption = CORRUPTIONS[name].at("moderate")
    scans = [c(clear, keyed_rng(4)) for c in (corruption, corruption)]
    scans.append(pickle.loads(pickle.dumps(corruption))(clear, keyed_rng(4)))
    for scan in scans[1:]:
        assert np.array_equal(scan.points, scans[0].points)
        assert np.array_equal(scan.reflectance, scans[0].reflectance)
    after = clear.points, clear.label, clear.reflectance
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    again = corruption(scans[0], keyed_rng(5))  # corrupted already
    assert len(again) <= len(scans[0])


@pytest.mark.parametrize("name", WEATHER)
def test_fewer_surfaces_return_in_worse_weather_and_none_farther(
    name: str, clear: Scan
) -> None:
    shares = []
    for severity in SEVERITIES:
        change = CORRUPTIONS[name].at(severity).change(clear, keyed_rng(2))
        shares.append((change.cause == SURFACE).sum() / len(clear))
        before = np.linalg.norm(clear.points[change.source], axis=1)
        assert (np.linalg.norm(change.points, axis=1) <= before + 1e-3).all()
    assert 1 > shares[0] > shares[1] > shares[2]


@pytest.mark.parametrize("visibility", [60.0, 400.0])
def test_reflectance_falls_by_beer_and_lambert(visibility: float) -> None:
    """The part of the loss that is reported has the slope -2 a (1 - COMPENSATED)."""
    change = Fog(visibility).change(target(np.linspace(2, 20, 500)), keyed_rng(0))
    hard = change.cause == SURFACE
    distance = change.points[hard, 0]
    slope = np.polyfit(distance, np.log(change.reflectance[hard]), 1)[0]
    wanted = -2 * np.log(20) / visibility * (1 - COMPENSATED)
    assert slope == pytest.approx(wanted, rel=0.02)


def test_the_fogs_own_return_peaks_where_it_should() -> None:
    """Against a direct sum of the same integral on another grid, one target at a time."""
    extinction, backscatter = 0.06, 0.046 / 50
    place, strength = fog.find_soft_return(extinction, backscatter)
    ranges = np.arange(0.005, 60, 0.01)
    path = np.arange(0.9, 60, 0.01)
    seen = np.clip((path - 0.9) / 11.1, 0, 1)
    air = seen * np.exp(-2 * extinction * path) / path**2
    half = fog.LIGHT * fog.WIDTH  # length of the pulse, metres
    lag = ranges[:, None] - path
    pulse = np.where((lag >= 0) & (lag <= half), np.sin(np.pi * lag / half) ** 2, 0)
    answer = (pulse * air).sum(1) * 0.01
    assert place[-1] == pytest.approx(ranges[answer.argmax()], abs=0.15)
    assert strength[-1] == pytest.approx(np.pi * backscatter * answer.max(), rel=0.02)
    assert (np.diff(strength) >= 0).all()  # more fog in front, never less light


def test_energy_never_grows() -> None:
    scan = target(np.linspace(2, 70, 2000), 0.4)
    for name in (*WEATHER, "wet_ground", "low_power"):
        for severity in SEVERITIES:
            change = CORRUPTIONS[name].at(severity).change(scan, keyed_rng(0))
            hard = change.cause == SURFACE
            assert (change.reflectance[hard] <= np.float32(0.4)).all()
    assert (fog.find_soft_return(0.2, 0.003)[1] < 1).all()


@pytest.mark.parametrize(
    ("count", "rate", "wanted"),
    [
        (precipitation.count_drops, 10.0, (1e-3, 4e-3)),
        (precipitation.count_flakes, 1.0, (2e-3, 3e-2)),
    ],
)
def test_extinction_of_precipitation(
    count: Callable[[float], np.ndarray], rate: float, wanted: tuple[float, float]
) -> None:
    """Rain of 10 mm / h has a visibility of 1 to 3 km, snow of 1 mm / h of 100 m to 2 km."""
    found = precipitation.extinction_of(count(rate))
    assert wanted[0] / 2 < found < wanted[1]
    assert found < precipitation.extinction_of(count(2 * rate))


def test_wet_ground_is_lost_far_away_first(clear: Scan) -> None:
    assert reflect_from_water(np.array([1.0]))[0] == pytest.approx(
        ((1.33 - 1) / 2.33) ** 2
    )
    assert reflect_from_water(np.array([0.0]))[0] == pytest.approx(1)
    new = WetGround(1.2)(clear, keyed_rng(0))
    ground = GROUND[clear.label]
    far = np.linalg.norm(clear.points, axis=1) > 20
    left = np.isin(clear.raw_label, new.raw_label)
    assert left[~ground].all()
    assert left[ground & far].mean() < left[ground & ~far].mean() - 0.1
    bare = find_ground(replace(clear, label=None))
    assert (bare == ground).mean() > 0.8


def test_beams_go_whole(clear: Scan) -> None:
    half = MissingBeams(0.5)(clear, keyed_rng(0))
    assert len(np.unique(half.ring)) == len(np.unique(clear.ring)) - 32
    few = CrossSensor(0.25)(clear, keyed_rng(0))
    rings = np.unique(few.ring)
    assert len(rings) == 16 and set(np.diff(rings)) == {4}
    bare = replace(clear, ring=None)
    assert len(CrossSensor(0.25)(bare, keyed_rng(0))) == pytest.approx(
        len(few), rel=0.02
    )


def test_a_box_without_returns_is_flagged() -> None:
    scan = target(np.linspace(9.5, 10.5, 20))
    boxes = Boxes(
        np.array([[10, 0, 0, 2, 2, 2, 0], [30, 0, 0, 2, 2, 2, 0]]), ("Car",) * 2
    )
    scan = replace(scan, boxes=boxes)
    new = IncompleteEcho(1.0)(scan, keyed_rng(0))
    assert len(new) == 0 and new.boxes is not None
    assert new.boxes.occlusion.tolist() == [OUT_OF_SIGHT, -1]  # the second had none


def test_mixed_scans_take_them(clear: Scan) -> None:
    train = MixedScans(
        [clear] * 2, [clear] * 2, 0.5, augment=Snow.at("light"), augment_real=True
    )
    sizes = [len(train[i]["points"]) for i in range(len(train))]
    assert len(set(sizes)) > 1 and max(sizes) < len(clear)


def test_weak_returns_are_the_first_to_go() -> None:
    dim = np.linalg.norm(
        Rain(60)(target(np.linspace(2, 70, 3000), 0.1), keyed_rng(0)).points, axis=1
    ).max()
    bright = np.linalg.norm(
        Rain(60)(target(np.linspace(2, 70, 3000), 0.9), keyed_rng(0)).points, axis=1
    ).max()
    assert dim <= bright and 0.1 / dim**2 >= FLOOR * 0.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Fog.at("hevy"), "severity 'hevy'.*heavy"),
        (lambda: Fog(0), "visibility=0; expected 5 to"),
        (lambda: Rain(-1), "rate=-1"),
        (lambda: MissingBeams(1.5), "share=1.5; expected 0 to 1"),
        (lambda: WetGround(float("nan")), "depth=nan"),
    ],
)
def test_wrong_parameters_are_refused(make: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_scans_that_lack_something(name: str, clear: Scan) -> None:
    corruption = CORRUPTIONS[name].at("light")
    empty = clear[np.zeros(0, int)]
    assert len(corruption(empty, keyed_rng(0))) == 0
    bare = replace(clear, label=None, raw_label=None, boxes=None, ring=None)
    if name == "incomplete_echo":
        with pytest.raises(DataError, match="without labels"):
            corruption(bare, keyed_rng(0))
    else:
        assert len(corruption(bare, keyed_rng(0))) > 0
    if name in ("missing_beams", "cross_sensor"):
        wrong = replace(clear, ring=np.full(len(clear), 99, np.int16))
        with pytest.raises(LidarSynthError, match="rings from 99 to 99"):
            corruption(wrong, keyed_rng(0))
