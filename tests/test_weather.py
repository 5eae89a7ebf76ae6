"""Weather and failing sensors: physics, labels and boxes, and bad input, for every corruption."""

import pickle
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
    Dirt,
    Fog,
    IncompleteEcho,
    LowPower,
    MissingBeams,
    MotionBlur,
    Rain,
    Snow,
    Spray,
    WetGround,
    cover,
    fog,
    precipitation,
)
from lidar_synth.weather.corruption import (
    CROSSTALK,
    OUT_OF_SIGHT,
    SCATTERED,
    SURFACE,
)
from lidar_synth.weather.precipitation import DIAMETERS, DIVERGENCE, Precipitation
from lidar_synth.weather.signal import FLOOR
from lidar_synth.weather.wet_ground import find_ground, reflect_from_water

WORSE = ("fog", "rain", "snow", "spray", "dirt", "wet_ground", "low_power")
"""Corruptions with which less returns the worse they are."""
LEAST = {
    "fog": 1e5,
    "rain": 0.1,
    "snow": 0.1,
    "spray": 1e-3,
    "cross_sensor": 1.0,
    "low_power": 0.999,
}
"""Parameters of the lightest of each; of the others they are shares or lengths, 0.001."""
MOVED = {"motion_blur", "crosstalk"}
"""Corruptions that move points off their rays."""
PARTICLES = {
    "fog": {SCATTERED},
    "rain": {SCATTERED},
    "snow": {SCATTERED},
    "spray": {SCATTERED},
    "crosstalk": {CROSSTALK},
}
"""Causes besides the surface."""


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
    assert (
        np.array_equal(new.cause != SURFACE, ~own) or (~own).sum() == changed.sum() + 1
    )
    assert set(np.unique(new.cause)) == {SURFACE, *PARTICLES.get(name, ())}
    assert list(new.augmented[0]) == [name] and clear.augmented == ()
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


@pytest.mark.parametrize("name", WORSE)
def test_fewer_surfaces_return_the_worse_it_is_and_none_farther(
    name: str, clear: Scan
) -> None:
    shares = []
    for severity in SEVERITIES:
        change = CORRUPTIONS[name].at(severity).change(clear, keyed_rng(2))
        shares.append((change.cause == SURFACE).sum() / len(clear))
        before = np.linalg.norm(clear.points[change.source], axis=1)
        assert (np.linalg.norm(change.points, axis=1) <= before + 1e-3).all()
    assert 1 > shares[0] > shares[1] > shares[2] > 0


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_far_returns_stay_the_more_the_lighter_it_is(name: str, clear: Scan) -> None:
    """Towards none all of them, also those that are too dark for the data sheet."""
    scan = replace(clear, reflectance=np.zeros_like(clear.reflectance))
    far = np.linalg.norm(scan.points, axis=1) > 50
    assert far.sum() > 1000
    kind = CORRUPTIONS[name]
    severe = [next(iter(options.values())) for options in kind.SEVERE]
    lighter = np.geomspace(severe[0], LEAST.get(name, 1e-3), 4)[1:]
    shares = []
    for value in [*reversed(severe), *lighter]:
        change = kind(value).change(scan, keyed_rng(2))
        kept = change.source[change.cause == SURFACE]
        shares.append(far[kept].sum() / far.sum())
    assert shares == sorted(shares) or name not in WORSE
    # The least snow, 0.1 mm / h, takes a twelfth of the signal over 50 m.
    assert shares[-1] > (0.8 if name == "snow" else 0.98)


@pytest.mark.parametrize("visibility", [60.0, 400.0])
@pytest.mark.parametrize("compensated", [0.0, 0.7])
def test_reflectance_falls_by_beer_and_lambert(
    visibility: float, compensated: float
) -> None:
    weather = Fog(visibility, compensated=compensated)
    change = weather.change(target(np.linspace(2, 20, 500)), keyed_rng(0))
    hard = change.cause == SURFACE
    distance = change.points[hard, 0]
    slope = np.polyfit(distance, np.log(change.reflectance[hard]), 1)[0]
    wanted = -2 * np.log(20) / visibility * (1 - compensated)
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


@pytest.mark.parametrize("severity", SEVERITIES)
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_energy_never_grows(name: str, severity: str, clear: Scan) -> None:
    """Neither of a surface, nor of all returns of clear air together."""
    change = CORRUPTIONS[name].at(severity).change(clear, keyed_rng(0))
    hard = change.cause == SURFACE
    before = clear.reflectance[change.source]
    assert (change.reflectance[hard] <= before[hard]).all()
    assert change.reflectance.max() <= 1
    assert (fog.find_soft_return(0.2, 0.003)[1] < 1).all()


def test_extinction_of_precipitation() -> None:
    """Rain of 10 mm / h has a visibility of 1 to 3 km, snow of 1 mm / h of 0.3 to 1 km."""
    assert 1e-3 < Rain(10).extinction < 3e-3
    assert 3e-3 < Snow(1).extinction < 1e-2
    assert Rain(5).extinction < Rain(50).extinction


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.5])
def test_snow_falls_at_a_metre_a_second(rate: float) -> None:
    """The water in the air follows from the flakes, and the fall speed from it."""
    melted = DIAMETERS / precipitation.FLAKE
    step = DIAMETERS[1] - DIAMETERS[0]
    water = (np.pi / 6 * melted**3 * Snow(rate).number()).sum() * step  # mm^3 / m^3
    assert 0.8 < 1e6 * rate / water / 3600 < 1.3


def test_the_extinction_efficiency_is_that_of_mie() -> None:
    """Against miepython 3.3.0 (efficiencies_mx at 905 nm), the mean over 5 % of the diameter."""
    diameter = np.array([0.05, 0.1, 0.2, 0.5, 1.0, 2.0])
    water = [2.061, 2.042, 2.026, 2.014, 2.009, 2.005]  # m = 1.328
    ice = [2.073, 2.040, 2.025, 2.014, 2.008, 2.005]  # m = 1.3031
    found = precipitation.extinction_efficiency(diameter)
    assert found == pytest.approx(water, rel=0.004)
    assert found == pytest.approx(ice, rel=0.005)


@pytest.mark.parametrize("weather", [Rain(50), Snow(1)])
def test_the_strongest_particle_of_a_beam(weather: Precipitation) -> None:
    """Against single particles, thrown into the beams of 3000 rays."""
    rng = np.random.default_rng(0)
    step = DIAMETERS[1] - DIAMETERS[0]
    number = weather.number() * step
    reach = 15.0
    volume = np.pi / 12 * DIVERGENCE**2 * reach**3
    strongest = []
    for _ in range(3000):
        counts = rng.poisson(number * volume)
        diameter = np.repeat(DIAMETERS, counts) * 1e-3
        place = reach * np.cbrt(rng.random(len(diameter)))
        signal = (diameter / DIVERGENCE) ** 2 / place**4
        strongest.append(signal.max(initial=0))
    place, filled = weather.draw_particles(30000, np.random.default_rng(1))
    drawn = np.where(place < reach, (filled / place**2), 0)
    levels = [0.5, 0.7, 0.8, 0.9, 0.95]
    wanted = np.quantile(strongest, levels)
    near = wanted < 0.1  # nearer ones fill the beam
    assert near.sum() >= 3
    assert np.quantile(drawn, levels)[near] == pytest.approx(wanted[near], rel=0.15)


def test_spray_lies_behind_vehicles() -> None:
    boxes = Boxes(np.array([[20, 0, 0, 4, 2, 2, 0]]), ("Car",))
    rng = np.random.default_rng(0)
    points = np.c_[np.full(4000, 30.0), rng.uniform(-10, 10, (4000, 2))]
    scan = replace(target(np.ones(4000)), points=np.float32(points), boxes=boxes)
    new = Spray(0.4)(scan, keyed_rng(0))
    drops = new.points[new.cause == SCATTERED]
    assert len(drops) > 20
    plume = Boxes(np.array([[12, 0, 0, 12, 2.5, 2, 0]]), ("Car",)).enlarged(0.01)
    assert plume.contain(drops).all()
    bare = Spray(0.4)(replace(scan, boxes=None), keyed_rng(0))
    assert (bare.cause == SURFACE).all()  # the own plume is behind, and these in front
    assert np.array_equal(bare.points, scan.points)


@pytest.mark.parametrize(
    "values", [[6, -4, 1, 9, 5, 4, 0.7], [2, 0, -0.1, 12, 3, 3.3, 0.1]]
)
def test_rays_through_a_box_against_points_along_them(values: list[float]) -> None:
    """A box beside the sensor, and one around it."""
    rng = np.random.default_rng(3)
    points = np.float32(rng.uniform(-30, 30, (300, 3)))
    distance = np.linalg.norm(points, axis=1)
    box = np.array(values, np.float32)
    first, last, rays = cover.cross_box(points, distance, box)
    along = np.linspace(0, 1, 4001)
    boxes = Boxes(box, ("Car",))
    found = {}
    for number, point in enumerate(points):
        inside = boxes.contain(np.float32(along[:, None] * point))[0]
        if inside.any():
            found[number] = along[inside][[0, -1]] * distance[number]
    assert set(found) <= set(rays.tolist()) and len(found) >= len(rays) - 2 > 10
    for number, ends in found.items():
        place = rays.tolist().index(number)
        assert (first[place], last[place]) == pytest.approx(ends, abs=0.03)


def test_dirt_covers_its_share() -> None:
    for share in (0.05, 0.4):
        thickness = cover.draw_dirt(share, keyed_rng(0))
        assert (thickness > 0).mean() == pytest.approx(share, abs=0.002)
    rng = np.random.default_rng(0)
    points = rng.standard_normal((20000, 3))
    points *= 5 / np.linalg.norm(points, axis=1)[:, None]
    scan = replace(target(np.ones(20000)), points=np.float32(points))
    change = Dirt(0.3).change(scan, keyed_rng(1))
    untouched = (change.reflectance == 1).sum() / len(scan)
    assert untouched == pytest.approx(0.7, abs=0.06)


def test_noise_may_have_a_class_of_its_own(clear: Scan) -> None:
    new = Fog(60, noise_label=19)(clear, keyed_rng(0))
    assert (new.label[new.cause == SCATTERED] == 19).all()
    again = MissingBeams(0.25)(new, keyed_rng(0))
    assert ((again.cause == SCATTERED) == (again.label == 19)).all()
    assert [next(iter(step)) for step in again.augmented] == ["fog", "missing_beams"]


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
    ignored = np.full_like(clear.label, IGNORE)
    assert np.array_equal(find_ground(replace(clear, label=ignored)), bare)


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


def test_half_of_the_returns_of_every_beam_stay(clear: Scan) -> None:
    """Every other one in the order of the azimuth."""
    whole = CrossSensor(1.0)(clear, keyed_rng(0))
    assert len(whole) == len(clear)
    half = CrossSensor(1.0, along=0.5)(clear, keyed_rng(0))
    assert clear.ring is not None and half.raw_label is not None
    turn = np.arctan2(clear.points[:, 1], clear.points[:, 0])
    for ring in np.unique(clear.ring):
        on = np.flatnonzero(clear.ring == ring)
        on = on[np.argsort(turn[on], kind="stable")]
        kept = np.flatnonzero(np.isin(clear.raw_label[on], half.raw_label))
        assert abs(len(kept) - len(on) / 2) <= 1
        assert (np.diff(kept) == 2).mean() > 0.99


def test_motion_blur_is_horizontal(clear: Scan) -> None:
    moved = MotionBlur(0.08)(clear, keyed_rng(0)).points - clear.points
    assert moved.std(axis=0) == pytest.approx([0.08, 0.08, 0], rel=0.02)


def test_a_box_without_returns_is_flagged() -> None:
    scan = target(np.linspace(9.5, 10.5, 20))
    boxes = Boxes(
        np.array([[10, 0, 0, 2, 2, 2, 0], [30, 0, 0, 2, 2, 2, 0]]), ("Car",) * 2
    )
    scan = replace(scan, boxes=boxes)
    new = IncompleteEcho(1.0)(scan, keyed_rng(0))
    assert len(new) == 0 and new.boxes is not None
    assert new.boxes.occlusion.tolist() == [OUT_OF_SIGHT, -1]  # the second had none
    drop = np.arange(20) == 7
    cause = np.where(drop, SCATTERED, SURFACE).astype(np.uint8)
    label = np.where(drop, IGNORE, scan.label).astype(np.uint8)
    new = IncompleteEcho(1.0)(replace(scan, cause=cause, label=label), keyed_rng(0))
    assert len(new) == 1 and new.boxes is not None
    assert new.boxes.occlusion.tolist() == [OUT_OF_SIGHT, -1]  # a drop is no return


def test_mixed_scans_take_them(clear: Scan) -> None:
    train = MixedScans(
        [clear] * 2, [clear] * 2, 0.5, augment=Snow.at("light"), augment_real=True
    )
    sizes = [len(train[i]["points"]) for i in range(len(train))]
    assert len(set(sizes)) > 1 and max(sizes) < len(clear)


def test_weak_returns_are_the_first_to_go() -> None:
    """A signal below the sensor's floor is above it by an unknown, drawn amount."""
    for reflectance in (0.1, 0.9):
        scan = target(np.linspace(2, 70, 3000), reflectance)
        farthest = LowPower(0.05)(scan, keyed_rng(0)).points[:, 0].max()
        assert 0.05 * reflectance / farthest**2 == pytest.approx(FLOOR, rel=0.05)
    beyond = target(np.full(10000, 60), 0.1)
    for power in (0.99, 0.8, 0.5):
        share = len(LowPower(power)(beyond, keyed_rng(0))) / len(beyond)
        assert share == pytest.approx(np.exp(1 - 1 / power), abs=0.015)


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
    points = np.where(clear.points > 40, np.float32(np.nan), clear.points)
    with pytest.raises(DataError, match="NaN or infinite.*isfinite"):
        corruption(replace(clear, points=points), keyed_rng(0))
    for factor in (np.float32(np.nan), 255, -1):
        bright = replace(clear, reflectance=clear.reflectance * factor)
        with pytest.raises(DataError, match=r"reflectance of .*expected 0 to 1.*255"):
            corruption(bright, keyed_rng(0))
    if name in ("missing_beams", "cross_sensor"):
        wrong = replace(clear, ring=np.full(len(clear), 99, np.int16))
        with pytest.raises(LidarSynthError, match="rings from 99 to 99"):
            corruption(wrong, keyed_rng(0))
