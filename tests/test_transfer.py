"""From sensor to sensor: against what the target records itself of a scene that is known
exactly."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from blocks import (
    BUILDING,
    CAR,
    CAR_BOX,
    GROUND,
    REFLECTANCE,
    ROAD,
    WALL,
    image,
    record,
)
from conftest import Golden, random_scan
from scipy.spatial import cKDTree

from lidar_synth import Town
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor, presets
from lidar_synth.geometry.transfer import Measurement, Mount, Response, SeenAs, Transfer
from lidar_synth.geometry.transfer.rays import rays_of
from lidar_synth.geometry.transfer.surfaces import rings_of
from lidar_synth.noise import keyed_rng

casting = partial(Transfer, recast=True)
"""Rays are cast also for scans of the target's own lasers."""
HDL64E = replace(load_sensor("hdl64e_kitti360"), firings=2000, heights=None)
UNEVEN = Sensor(
    "uneven",
    1200,
    0.5,
    150.0,
    elevations=(6, 3, 2, *np.arange(1.5, -6, -0.2), *np.arange(-6.2, -20, -1.0)),
    azimuths=tuple(-1.0 + 2.0 * (i % 2) for i in range(55)),
)
TARGETS = {
    "uneven": UNEVEN,
    "hdl32e": replace(load_sensor("hdl32e_nuscenes"), firings=1084),
    "hdl64e": HDL64E,
    "os1_128": load_sensor("os1_128"),
    "hdl64e at heights": load_sensor("hdl64e_kitti"),
}
MOUNTS = {
    "same place": Mount(),
    "higher": Mount(0.4),
    "lower, looking down": Mount(-0.2, 3.0),
}


@pytest.fixture(scope="module")
def scan() -> Scan:
    return record(HDL64E)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("target", TARGETS)
def test_it_sees_what_the_target_itself_records(
    scan: Scan, target: str, mount: str
) -> None:
    """Ranges, occlusion and labels: also behind the car, whose shadow moves with the mount."""
    truth = record(TARGETS[target], MOUNTS[mount])
    found = casting(TARGETS[target], MOUNTS[mount])(scan)
    at_truth = image(truth)
    at_found = image(found)
    both = (at_truth >= 0) & (at_found >= 0)
    ranges = [
        np.linalg.norm(s.points, axis=1)[at[both]]
        for s, at in ((truth, at_truth), (found, at_found))
    ]
    right = np.abs(ranges[0] - ranges[1]) < 0.03 + 0.01 * ranges[0]
    assert right.mean() > 0.975
    assert (truth.label[at_truth[both]] == found.label[at_found[both]]).mean() > 0.985
    elevation = np.arctan2(truth.points[:, 2], np.hypot(*truth.points[:, :2].T))
    inside = (
        (elevation < np.radians(2 - MOUNTS[mount].pitch))
        & (elevation > np.radians(MOUNTS[mount].pitch - 22))
        & _near(truth, 50)
    )
    assert (at_found[at_truth >= 0] >= 0)[inside[at_truth[at_truth >= 0]]].mean() > 0.96
    # It returns little where the target returns nothing.
    assert both.sum() > 0.96 * (at_found >= 0).sum()


def _near(scan: Scan, most: float) -> np.ndarray:
    return np.linalg.norm(scan.points, axis=1) < most


def test_the_nearer_surface_hides_the_farther_one(scan: Scan) -> None:
    """From further down, the car stands before the part of the wall that was seen over its roof."""
    mount = Mount(-0.9)
    truth = record(HDL64E, mount)
    found = casting(HDL64E, mount)(scan)
    at_truth = image(truth)
    at_found = image(found)
    both = (at_truth >= 0) & (at_found >= 0)
    on_car = truth.label[at_truth[both]] == CAR
    assert (
        on_car.sum() > 1000
        and (found.label[at_found[both]][on_car] == CAR).mean() > 0.97
    )


@pytest.mark.parametrize("target", ["uneven", "hdl32e"])
def test_no_return_hangs_between_surfaces(scan: Scan, target: str) -> None:
    """Between the outline of the car and the wall behind it."""
    points = casting(TARGETS[target])(scan).points.astype(float)
    off = [np.abs(points[:, 2] - GROUND)]
    for box in (CAR_BOX, WALL):
        c = np.cos(box[6])
        s = np.sin(box[6])
        local = (points - box[:3]) @ np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)])
        off.append(
            np.linalg.norm(
                np.maximum(np.abs(local) - np.array(box[3:6]) / 2, 0), axis=1
            )
        )
    assert (np.min(off, 0) > 0.3).mean() < 1e-3


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_plane_stays_a_plane(scan: Scan, mount: str) -> None:
    found = Transfer(UNEVEN, MOUNTS[mount])(scan[scan.label == ROAD])
    matrix = MOUNTS[mount].matrix
    height = found.points.astype(float) @ matrix[:3, :3].T[:, 2] + matrix[2, 3]
    assert np.quantile(np.abs(height - GROUND), 0.999) < 0.03


@pytest.mark.parametrize("target", TARGETS)
def test_returns_lie_on_the_beams_and_firings_of_the_target(
    scan: Scan, target: str
) -> None:
    sensor = TARGETS[target]
    found = Transfer(sensor, Mount(0.2))(scan)
    elevation = np.arctan2(
        found.points[:, 2].astype(float), np.hypot(*found.points[:, :2].T)
    )
    off = np.degrees(np.abs(elevation - sensor.laser_elevations[found.ring]))
    assert off.max() < 1e-3 if sensor.heights is None else np.median(off) < 0.2
    azimuths = sensor.firing_azimuths()
    firing = (
        -np.arctan2(found.points[:, 1], found.points[:, 0]) - azimuths[found.ring, 0]
    ) / np.diff(azimuths)[0, 0]
    assert np.abs(firing - np.rint(firing)).max() < 1e-3


def test_the_same_sensor_in_the_same_place_changes_nearly_nothing(scan: Scan) -> None:
    found = casting(HDL64E)(scan)
    before = image(scan)
    after = image(found)
    both = (before >= 0) & (after >= 0)
    assert both.sum() > 0.995 * max((before >= 0).sum(), (after >= 0).sum())
    off = np.linalg.norm(scan.points[before[both]] - found.points[after[both]], axis=1)
    assert np.quantile(off, 0.995) < 1e-3
    for name in ("label", "instance", "time"):
        assert (
            getattr(scan, name)[before[both]] == getattr(found, name)[after[both]]
        ).mean() > 0.999
    np.testing.assert_allclose(
        scan.reflectance[before[both]], found.reflectance[after[both]], atol=0.51
    )


def test_a_scan_of_the_same_lasers_keeps_its_returns(scan: Scan) -> None:
    """Within the target's limits; its arrays are its own."""
    target = replace(HDL64E, columns=512, range_max=20.0, reflectance_levels=4)
    given = replace(scan, sensor=replace(HDL64E, name="other", firings=2100))
    before = scan.points.copy()
    found, seen = Transfer(target).cast(given)
    near = np.linalg.norm(scan.points, axis=1) <= 20
    assert 0 < near.sum() < len(scan) and found.sensor == target and seen == 1.0
    assert np.array_equal(found.points, scan.points[near])
    assert np.array_equal(Transfer(target)(given).points, found.points)
    assert np.array_equal(found.label, scan.label[near])
    assert set(np.unique(found.reflectance * 4)) <= {0, 1, 2, 3}
    found.points[:] = 0
    found.boxes.values[:] = 1
    assert np.array_equal(scan.points, before) and (scan.boxes.values != 1).any()
    front = given[scan.points[:, 0] > np.abs(scan.points[:, 1])]
    assert abs(Transfer(target).cast(front).seen - 0.25) < 0.02


@pytest.mark.parametrize(
    "transfer",
    [
        Transfer(HDL64E, Mount(0.1)),
        Transfer(HDL64E, measurement=Measurement(loss=0.01)),
        Transfer(replace(HDL64E, firings=1000)),
        Transfer(replace(HDL64E, range_step=0.004)),
        Transfer(replace(HDL64E, beams=tuple(np.array(HDL64E.beams) - 0.2))),
        Transfer(HDL64E, recast=True),
    ],
    ids=["mount", "losses", "firings", "steps", "lasers", "recast"],
)
def test_any_other_difference_casts_rays(scan: Scan, transfer: Transfer) -> None:
    assert not np.isin(transfer(scan).points[:, 0], scan.points[:, 0]).all()


def test_a_real_street_of_the_town_too() -> None:
    """A scan of a range image has no ring, and rows without a return."""
    # few leaves, whose returns have random depths
    town = Town(seed=5, scans=1, motion=False)[0]
    for scan in (town, unproject(project(replace(town, boxes=None, pose=None)))):
        found = casting(scan.sensor)(replace(scan, ring=scan.ring))
        ranges = [project(s).range for s in (scan, found)]
        both = (ranges[0] > 0) & (ranges[1] > 0)
        assert both.sum() > 0.9 * (ranges[0] > 0).sum()
        assert np.median(np.abs(ranges[0] - ranges[1])[both]) < 0.05


def test_fields_are_those_of_the_surface_that_returns(scan: Scan) -> None:
    found = Transfer(UNEVEN, Mount(0.3))(scan)
    inner = (
        np.abs(found.reflectance - np.vectorize(REFLECTANCE.get)(found.label)) < 1e-6
    )
    # between two surfaces that touch, reflectance is interpolated
    assert inner.mean() > 0.99
    assert ((found.label == CAR) == (found.instance == 1)).all()
    assert set(found.fields()) == set(scan.fields())
    assert (
        found.id == scan.id and found.sensor == UNEVEN and found.domain == scan.domain
    )


@pytest.mark.parametrize("mount", MOUNTS)
def test_boxes_and_pose_move_to_the_targets_frame(scan: Scan, mount: str) -> None:
    found = casting(HDL64E, MOUNTS[mount])(scan)
    np.testing.assert_allclose(found.pose, MOUNTS[mount].matrix)
    slack = 0.03 + 2 * np.sin(np.radians(MOUNTS[mount].pitch)) * CAR_BOX[3] / 2
    grown = replace(
        found.boxes,
        values=found.boxes.values + np.float32([0, 0, 0, slack, slack, slack, 0]),
    )
    inside = grown.contain(found.points)[0]
    assert (
        (inside[found.label == CAR]).mean() > 0.99 and (found.label == CAR).sum() > 500
    )
    world = found.points.astype(float) @ found.pose[:3, :3].T + found.pose[:3, 3]
    assert np.median(np.abs(world[found.label == ROAD, 2] - GROUND)) < 0.01


@pytest.mark.parametrize(
    "transfer",
    [
        Transfer(replace(HDL64E, range_max=20.0)),
        casting(replace(HDL64E, range_max=20.0)),
        casting(UNEVEN, Mount(0.3)),
    ],
    ids=["kept", "cast", "other lasers"],
)
def test_boxes_without_a_return_are_left_out(scan: Scan, transfer: Transfer) -> None:
    far = np.float32([60, 30, 0, 0, 0, 0, 0])
    boxes = replace(
        Boxes(np.float32([CAR_BOX, CAR_BOX + far]), ("Car", "Van")),
        dont_care=np.ones((1, 4)),
    )
    given = replace(scan, boxes=boxes)
    for found in (transfer(given), transfer.cast(given).scan):
        assert found.boxes.names == ("Car",) and len(found.boxes.dont_care) == 1


def test_porous_surfaces_keep_their_share_of_returns() -> None:
    """Leaves: returns at random depths, and rays between them that return nothing."""
    full = record(HDL64E)
    rng = np.random.default_rng(0)
    distance = np.linalg.norm(full.points, axis=1)
    leaves = full.points * (rng.uniform(10, 14, len(full)) / distance)[:, None].astype(
        np.float32
    )
    scan = replace(full, points=leaves.astype(np.float32))
    for share in (0.3, 0.6, 1.0):
        some = scan[rng.random(len(scan)) < share]
        for target in (HDL64E, UNEVEN):
            found = casting(target)(some)
            rays = rays_of(target)
            rows = (np.degrees(np.arctan(rays.slope)) < 2) & (
                np.degrees(np.arctan(rays.slope)) > -15
            )
            truth = np.bincount(record(target).ring, minlength=len(rows))[rows].sum()
            ratio = np.bincount(found.ring, minlength=len(rows))[rows].sum() / truth
            assert abs(ratio - share) < 0.1 * share + 0.03, (share, target.name)


def test_a_narrow_pole_stays() -> None:
    pole = (12.0, -4.0, 0.0, 0.1, 0.1, 4.0, 0.0)
    for target in (HDL64E, UNEVEN):
        found = casting(target)(record(HDL64E, car=pole))
        truth = record(target, car=pole)
        assert (
            abs(np.log((found.label == CAR).sum() / (truth.label == CAR).sum())) < 0.35
        )


def test_what_was_not_seen_returns_nothing(scan: Scan) -> None:
    front = scan[scan.points[:, 0] > np.abs(scan.points[:, 1])]
    found, seen = casting(HDL64E).cast(front)
    assert (found.points[:, 0] > 0.9 * np.abs(found.points[:, 1])).all() and abs(
        seen - 0.25
    ) < 0.02
    found, seen = Transfer(load_sensor("os1_128")).cast(scan)
    elevation = np.degrees(
        np.arctan2(found.points[:, 2], np.hypot(*found.points[:, :2].T))
    )
    assert elevation.max() < 3.1 and abs(seen - 25.5 / 45) < 0.02


def test_surfaces_end_where_rings_are_missing(scan: Scan) -> None:
    found = casting(HDL64E)(scan[(scan.ring < 25) | (scan.ring > 40)])
    assert not ((found.ring > 25) & (found.ring < 40)).any() and (
        (found.ring < 25).sum(),
        (found.ring > 40).sum(),
    ) > (
        0,
        0,
    )


def test_limits_and_quantisation_are_those_of_the_target(scan: Scan) -> None:
    target = replace(
        UNEVEN, range_min=6.0, range_max=20.0, range_step=0.05, reflectance_levels=8
    )
    found = casting(target)(scan)
    steps = np.linalg.norm(found.points.astype(float), axis=1) / 0.05
    assert (
        np.abs(steps - np.rint(steps)).max() < 1e-3
        and steps.min() >= 120
        and 0.05 * steps.max() <= 20
    )
    assert (
        np.abs(found.reflectance * 8 % 1).max() < 1e-6
        and found.reflectance.max() <= 7 / 8
    )


def test_noise_and_losses_are_added_and_keyed(scan: Scan) -> None:
    plain = casting(HDL64E)(scan)
    noisy = casting(HDL64E, measurement=Measurement(range_noise=0.05))
    first = noisy(scan, keyed_rng(1))
    again = noisy(scan, keyed_rng(1))
    other = noisy(scan, keyed_rng(2))
    assert np.array_equal(first.points, again.points) and not np.array_equal(
        first.points, other.points
    )
    off = np.linalg.norm(first.points, axis=1) - np.linalg.norm(plain.points, axis=1)
    assert abs(off.std() - 0.05) < 0.003
    fewer = casting(HDL64E, measurement=Measurement(loss=0.2))(scan)
    assert abs(len(fewer) / len(plain) - 0.8) < 0.01
    weak = casting(HDL64E, measurement=Measurement(reach=30.0))(scan)
    far = [np.mean(np.linalg.norm(s.points, axis=1) > 25) for s in (plain, weak)]
    assert far[1] < 0.5 * far[0]


def test_a_response_gives_the_targets_distribution(scan: Scan) -> None:
    rng = np.random.default_rng(0)
    recorded = replace(scan, reflectance=rng.random(len(scan), np.float32))
    target = replace(scan, reflectance=(rng.random(len(scan), np.float32) ** 2 / 3))
    response = Response.match([recorded], [target])
    np.testing.assert_allclose(
        response(np.array([0.3, 0.6, 0.9])),
        np.array([0.3, 0.6, 0.9]) ** 2 / 3,
        atol=0.01,
    )
    found = casting(HDL64E, measurement=Measurement(response=response))(recorded)
    assert found.reflectance.max() < 0.34
    with pytest.raises(DataError, match="no target return between 4 and 40 m"):
        Response.match([scan], [])
    with pytest.raises(ConfigError, match="a response"):
        Response((0.0, 1.0), (1.0, 0.0))


def test_sweeps_fill_gaps_and_moving_objects_follow_their_boxes() -> None:
    """A sweep 2 m further on, when the car stood 3 m further: its returns go back to where the scan
    has the car."""
    scan = record(HDL64E)
    later = record(HDL64E, car=(CAR_BOX[0] + 3, *CAR_BOX[1:]), at=2.0)
    # Neither the car nor what is behind it.
    blind = scan[(scan.points[:, 1] < 1) | (scan.points[:, 0] < 0)]
    alone = casting(HDL64E)(blind)
    filled = casting(HDL64E).cast(blind, sweeps=[later]).scan
    assert len(filled) > 1.1 * len(alone)
    car = filled.points[filled.label == CAR]
    assert len(car) > 300
    grown = replace(
        scan.boxes, values=scan.boxes.values + np.float32([0, 0, 0, 0.3, 0.3, 0.3, 0])
    )
    assert grown.contain(car)[0].mean() > 0.98
    unknown = replace(
        later, boxes=replace(later.boxes, instance=np.array([9], np.int32))
    )
    pose = later.pose.copy()
    pose[0, 3] = 500  # so far away, its instances are other objects
    for sweep in (unknown, replace(later, pose=pose)):
        assert CAR not in casting(HDL64E).cast(blind, sweeps=[sweep]).scan.label
    with pytest.raises(DataError, match="without a pose; expected poses"):
        casting(HDL64E).cast(scan, sweeps=[replace(later, pose=None)])


def test_the_own_vehicle_does_not_stand_in_the_way_of_another_mount(scan: Scan) -> None:
    """A bonnet 0.5 m below the sensor would hide the street from a sensor 0.4 m further down."""
    rays = rays_of(HDL64E)
    own = np.flatnonzero(
        (scan.ring > 50) & (np.abs(scan.points[:, 1]) < 0.5 * np.abs(scan.points[:, 0]))
    )
    points = scan.points.copy()
    points[own] *= (-0.5 / rays.slope[scan.ring[own]] / np.hypot(*points[own, :2].T))[
        :, None
    ]
    given = replace(scan, points=points)
    lower = casting(HDL64E, Mount(-0.4))
    assert len(lower(given)) > 0.95 * len(
        lower(scan[np.setdiff1d(np.arange(len(scan)), own)])
    )
    assert len(replace(lower, vehicle=(0.0, 0.0))(given)) < 0.98 * len(lower(given))
    near = (
        np.linalg.norm(casting(replace(HDL64E, range_min=0.1))(given).points, axis=1)
        < 1.8
    )
    assert near.sum() > 0.9 * len(own)  # in the same place it stays


def test_a_source_seen_as_another_sensor(scan: Scan) -> None:
    scans = SeenAs(
        [scan, scan], Transfer(UNEVEN, measurement=Measurement(loss=0.5)), seed=3
    )
    assert len(scans) == 2 and scans.sensor == UNEVEN
    assert np.array_equal(scans[1].points, scans[-1].points) and len(scans[0]) != len(
        scans[1]
    )


@pytest.mark.parametrize("name", presets())
def test_every_preset_is_a_source_and_a_target(name: str) -> None:
    sensor = load_sensor(name)
    found = casting(sensor)(record(sensor))
    assert len(found) > 0.9 * len(record(sensor))
    assert set(np.unique(found.label)) == {ROAD, BUILDING, CAR}


BAD = {
    "empty": (lambda s: s[:0], "without a return"),
    "one beam": (lambda s: s[s.ring == 40], "one beam only"),
    "not finite": (
        lambda s: replace(
            s, points=np.where(s.ring[:, None] == 5, np.float32(np.nan), s.points)
        ),
        "NaN",
    ),
    "fewer beams": (
        lambda s: replace(_shuffled(s), sensor=load_sensor("hdl32e_nuscenes")),
        "on no rings",
    ),
    "a map": (lambda s: random_scan(HDL64E, 5000), "on no rings"),
    "no overlap": (lambda s: s[s.ring < 12], "none of its surfaces lies within"),
}


def _shuffled(scan: Scan) -> Scan:
    return replace(scan[np.random.default_rng(0).permutation(len(scan))], ring=None)


@pytest.mark.parametrize("case", BAD)
def test_bad_scans_are_refused(scan: Scan, case: str) -> None:
    change, message = BAD[case]
    low = Sensor("low", 512, 1.0, 50.0, rows=16, fov_up=-10.0, fov_down=-30.0)
    with pytest.raises(DataError, match=message):
        casting(low)(change(scan))


def test_a_shuffled_scan_finds_its_rings_by_elevation(scan: Scan) -> None:
    sensor = replace(
        HDL64E,
        name="beams",
        elevations=HDL64E.beams,
        beams=None,
        rows=None,
        fov_up=None,
        fov_down=None,
    )
    given = replace(scan, sensor=sensor)
    shuffled = replace(_shuffled(scan), sensor=sensor)
    assert abs(len(Transfer(UNEVEN)(given)) - len(Transfer(UNEVEN)(shuffled))) < 50


def test_rows_whose_rays_start_above_the_origin_are_found_without_rings() -> None:
    sensor = load_sensor("hdl64e_lasers")
    drawn = project(Town(seed=0, scans=1, sensor=sensor, motion=False)[0])
    on_rows = unproject(drawn)
    rows, on_grid = rings_of(replace(on_rows, ring=None))
    assert on_grid and np.array_equal(rows, np.nonzero(drawn.mask)[0])
    given, without = (
        Transfer(load_sensor("hdl32e"))(s)
        for s in (on_rows, replace(on_rows, ring=None))
    )
    assert len(without) > 0.95 * len(given)


@pytest.mark.parametrize("wrong", [{"z": 9.0}, {"pitch": 60.0}, {"z": float("nan")}])
def test_impossible_mounts_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="a mount"):
        Mount(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"range_noise": -1.0}, {"loss": 1.0}, {"reach": 0.0}]
)
def test_impossible_measurements_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="range_noise="):
        Measurement(**wrong)


def porous(seed: int = 0) -> Scan:
    """A small scan with lost returns and with leaves, so that triangles, their rims and gaps all
    occur."""
    rng = np.random.default_rng(seed)
    sensor = Sensor("small", 360, 1.0, 80.0, rows=24, fov_up=4.0, fov_down=-20.0)
    scan = record(sensor)
    leaves = np.where(
        (rng.random(len(scan)) < 0.3) & (scan.label == BUILDING),
        rng.uniform(0.6, 1.0, len(scan)),
        1.0,
    )
    moved = replace(scan, points=(scan.points * leaves[:, None]).astype(np.float32))
    return moved[rng.random(len(scan)) < 0.9]


@pytest.mark.parametrize("mount", MOUNTS)
def test_returns_are_those_of_the_kernels_before_they_were_made_faster(
    golden: Golden, mount: str
) -> None:
    """The returns that version 0.1.0 gave (tests/golden/README.md) on a processor with AVX-512:
    without it, the last bits of a sine decide rays along an edge differently, 1 in 100."""
    target = Sensor("other", 400, 1.0, 80.0, elevations=tuple(np.linspace(3, -16, 12)))
    found = casting(target, MOUNTS[mount])(porous())
    with np.load(golden / "transfer.npz") as file:
        before = {
            name: file[f"{mount} {name}"]
            for name in ("points", "ring", "label", "reflectance")
        }
    now = {name: getattr(found, name) for name in before}
    assert lacking(now, before) < 0.02 and lacking(before, now) < 0.02


def lacking(some: dict[str, np.ndarray], others: dict[str, np.ndarray]) -> float:
    """The share of some returns that have no equal among the others."""
    rows, other_rows = (
        np.column_stack([returns[name] for name in sorted(returns)])
        for returns in (some, others)
    )
    apart, _ = cKDTree(other_rows).query(rows)
    return float(np.mean(apart > 1e-4))
