"""Projection and unprojection: inverses, invariants, and bit-identical results with numpy and
torch."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from conftest import random_scan, ring_numbers
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp

from lidar_synth.bank.sample import sample_scans
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import (
    locate,
    project,
    unfold,
    unproject,
)
from lidar_synth.geometry.projection.batch import project_batch, torch_asin, torch_atan2
from lidar_synth.geometry.projection.kernels import asin, atan2
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, presets

SMALL = {
    "linear": Sensor("linear", 32, 1.0, 80.0, rows=8, fov_up=10.0, fov_down=-20.0),
    "table": Sensor(
        "table", 16, 0.0, 80.0, elevations=(12.0, 7.0, 1.0, -2.0, -9.0, -25.0)
    ),
}


def image_of(sensor: Sensor, seed: int, share: float = 0.7) -> RangeImage:
    rng = np.random.default_rng(seed)
    low = max(sensor.range_min * 1.001, 0.01)
    distance = np.exp(
        rng.uniform(np.log(low), np.log(sensor.range_max * 0.999), sensor.shape)
    )
    distance[rng.random(sensor.shape) > share] = 0
    label = np.where(distance > 0, rng.integers(0, 19, sensor.shape), IGNORE).astype(
        np.uint8
    )
    return RangeImage(distance.astype(np.float32), sensor, {"label": label})


def test_returns_at_the_range_limits_are_projected_again(sensor: Sensor) -> None:
    limits = np.float32([sensor.range_min or 1, sensor.range_max])
    image = RangeImage(np.resize(limits, sensor.shape), sensor)
    points = unproject(image).points
    assert project(Scan(points, np.zeros(len(points), np.float32), sensor)).mask.all()
    offsets = torch.tensor([0, len(points)])
    assert (project_batch(torch.from_numpy(points), offsets, sensor).range > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("beams", [False, True])
def test_unprojecting_and_projecting_keeps_every_cell(
    sensor: Sensor, beams: bool
) -> None:
    sensor = sensor.by_beams() if beams else sensor
    image = image_of(sensor, 1)
    back = project(unproject(image))
    assert np.array_equal(back.mask, image.mask)
    assert np.array_equal(back.label, image.label)
    assert np.allclose(back.range, image.range, rtol=3e-7, atol=0)


@settings(max_examples=60)
@given(kind=st.sampled_from(sorted(SMALL)), data=st.data())
def test_unprojecting_and_projecting_keeps_any_image(
    kind: str, data: st.DataObject
) -> None:
    sensor = SMALL[kind]
    ranges = st.one_of(st.just(0.0), st.floats(1.5, 79.5, width=32))
    image = RangeImage(
        data.draw(hnp.arrays(np.float32, sensor.shape, elements=ranges)), sensor
    )
    back = project(unproject(image))
    assert np.array_equal(back.mask, image.mask)
    assert np.allclose(back.range, image.range, rtol=3e-7, atol=0)


def test_a_kept_point_moves_by_at_most_half_a_cell(sensor: Sensor) -> None:
    scan = random_scan(sensor, 20000)
    cells = locate(scan.points, sensor)
    image = project(scan)
    back = unproject(image)
    kept = cells.point[cells.point >= 0]
    before = scan.points[kept].astype(np.float64)
    after = back.points.astype(np.float64)
    if len(sensor.starts):  # elevations are those from the lasers
        for points in (before, after):
            points[:, 2] -= sensor.starts[np.nonzero(cells.point >= 0)[0]]
    elevation = [
        np.arcsin(p[:, 2] / np.linalg.norm(p, axis=1)) for p in (before, after)
    ]
    azimuth = [-np.arctan2(p[:, 1], p[:, 0]) for p in (before, after)]
    inside = (elevation[0] <= np.radians(sensor.up)) & (
        elevation[0] >= np.radians(sensor.down)
    )
    half = (
        np.abs(np.diff(sensor.edges)).max() / 2
        if sensor.elevations is None
        else np.abs(np.diff(sensor.edges)).max()
    )
    assert inside.sum() > 5000
    # Between two lasers that start at different heights, the edge of their rows does too.
    steps = np.abs(np.diff(sensor.starts)).max(initial=0) / np.linalg.norm(
        before, axis=1
    )
    assert (np.abs(elevation[1] - elevation[0]) - steps)[inside].max() <= half + 1e-6
    turned = (azimuth[1] - azimuth[0] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() <= np.pi / sensor.columns + 1e-6


@pytest.mark.parametrize("name", sorted(presets()))
def test_projection_equals_a_brute_force_search_for_the_nearest_points(
    name: str,
) -> None:
    sensor = presets()[name]
    scan = random_scan(sensor, 4000, seed=3)
    # every point twice: the first of the two has to win
    scan = scan[np.r_[0:4000, 0:4000]]
    cells = locate(scan.points, sensor)
    best: dict[int, int] = {}
    for i, (cell, distance) in enumerate(zip(cells.cell, cells.range, strict=True)):
        if cell >= 0 and (cell not in best or distance < cells.range[best[cell]]):
            best[int(cell)] = i
    expected = np.full(sensor.shape[0] * sensor.columns, -1)
    expected[list(best)] = list(best.values())
    assert np.array_equal(cells.point.reshape(-1), expected)
    image = project(scan)
    assert image.reflectance is not None
    assert np.array_equal(
        image.reflectance[cells.point >= 0],
        scan.reflectance[cells.point[cells.point >= 0]],
    )
    assert np.all(image.label[~image.mask] == IGNORE)


def test_images_keep_the_boxes_of_their_scan() -> None:
    scan = sample_scans()[0]
    scan = replace(scan, ring=np.zeros(len(scan), np.int16))
    for image in (project(scan), unfold(scan)):
        assert unproject(image).boxes == scan.boxes is not None


def test_points_outside_the_range_limits_hide_no_other_point() -> None:
    """A return nearer than the limit must not hide the one behind it (R2Flow masks after the
    projection)."""
    sensor = SMALL["linear"]
    points = np.array([[0.5, 0, 0], [20, 0, 0], [90, 0, 0], [0, 0, 0]], np.float32)
    image = project(Scan(points, np.arange(4, dtype=np.float32) / 4, sensor))
    assert image.range[image.mask].tolist() == [20.0]
    assert locate(points, sensor).cell.tolist().count(-1) == 3


@pytest.mark.parametrize("kind", sorted(SMALL))
def test_returns_at_exactly_the_range_limits_are_kept(kind: str) -> None:
    """Both limits are inclusive in every projection; what lies beyond rounding errors is
    dropped."""
    low = np.float32(2.5)
    high = np.float32(40)
    outside = low * np.float32(1 - 2e-6), high * np.float32(1 + 2e-6)
    sensor = replace(SMALL[kind], range_min=float(low), range_max=float(high))
    points = np.zeros((4, 3), np.float32)
    for i, distance in enumerate((low, high, *outside)):
        # Four different directions.
        points[i, :2] = [(distance, 0), (0, distance), (-distance, 0), (0, -distance)][
            i
        ]
    scan = Scan(points, np.zeros(4, np.float32), sensor)
    assert (locate(points, sensor).cell >= 0).tolist() == [True, True, False, False]
    assert locate(points, sensor).range[:2].tolist() == [low, high]
    assert sorted(project(scan).range[project(scan).mask].tolist()) == [low, high]
    ringed = replace(scan, ring=np.zeros(4, np.int16))
    assert sorted(unfold(ringed).range[unfold(ringed).mask].tolist()) == [low, high]
    batch = project_batch(torch.from_numpy(points), torch.tensor([0, 4]), sensor)
    assert sorted(batch.range[batch.range > 0].tolist()) == [low, high]


def test_columns_run_clockwise_from_the_rear_and_row_0_is_the_highest() -> None:
    """Straight ahead is the edge between W/2-1 and W/2, columns run clockwise, the seam is behind,
    row 0 is up."""
    sensor = SMALL["linear"]
    points = np.array(
        [
            [9, -0.1, 0],
            [9, 0.1, 0],
            [0.01, -9, 0],
            [-9, 0.1, 0],
            [-9, -0.1, 0],
            [9, -0.1, 1.5],
        ],
        np.float32,
    )
    cell = locate(points, sensor).cell
    assert (cell % 32).tolist() == [16, 15, 23, 0, 31, 16]
    assert cell[5] // 32 < cell[0] // 32
    for just_left_and_right_of_the_seam in (
        [-9, 1e-9, 0],
        [-9, 0, 0],
        [-9, -1e-9, 0],
    ):  # +-pi in float32
        assert (
            locate(np.array([just_left_and_right_of_the_seam], np.float32), sensor).cell
            % 32
            == 0
        )
    straight_up_and_down = locate(
        np.array([[0, 0, 9], [0, 0, -9]], np.float32), sensor
    ).cell
    assert (straight_up_and_down // 32).tolist() == [0, 7]


@settings(max_examples=200)
@given(hnp.arrays(np.float32, (50, 2), elements=st.floats(-200, 200, width=32)))
def test_angles_are_accurate_and_bit_identical_in_torch(xy: np.ndarray) -> None:
    xy = xy + np.float32(0)  # no negative zeros: their side of the seam is undefined
    y, x = torch.from_numpy(xy).unbind(-1)
    ours = np.array([atan2(b, a) for b, a in xy], np.float32)
    assert np.abs(ours - np.arctan2(*xy.astype(np.float64).T)).max() < 5e-7
    assert np.array_equal(ours, torch_atan2(y, x).numpy())
    s = np.clip(xy[:, 0] / 200, -1, 1).astype(np.float32)
    ours = np.array([asin(v) for v in s], np.float32)
    assert np.abs(ours - np.arcsin(s.astype(np.float64))).max() < 5e-7
    assert np.array_equal(ours, torch_asin(torch.from_numpy(s)).numpy())


def devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


@pytest.mark.parametrize("device", devices())
@pytest.mark.parametrize("beams", [False, True])
def test_batches_on_any_device_equal_single_projections(
    sensor: Sensor, device: str, beams: bool
) -> None:
    sensor = sensor.by_beams() if beams else sensor
    empty = project_batch(
        torch.zeros(0, 4, device=device), torch.tensor([0, 0]), sensor
    )
    assert empty.range.shape == (1, *sensor.shape) and not empty.range.any()
    assert empty.channels.shape == (1, 1, *sensor.shape) and (empty.point < 0).all()
    scans = [random_scan(sensor, n, seed) for seed, n in enumerate((5000, 1, 3000))]
    points = np.concatenate(
        [np.c_[s.points, s.reflectance, s.label] for s in scans]
    ).astype(np.float32)
    offsets = torch.tensor(np.cumsum([0, *map(len, scans)]), device=device)
    batch = project_batch(torch.from_numpy(points).to(device), offsets, sensor)
    for b, scan in enumerate(scans):
        image = project(scan)
        cells = locate(scan.points, sensor)
        assert np.array_equal(batch.range[b].cpu().numpy(), image.range)
        assert np.array_equal(batch.channels[b, 0].cpu().numpy(), image.reflectance)
        shown = batch.point[b].cpu().numpy()
        assert np.array_equal(
            shown - np.where(shown >= 0, int(offsets[b]), 0), cells.point
        )


def scan_in_ring_order(share: float = 0.9) -> tuple[Scan, np.ndarray]:
    """A scan ring by ring, each counter-clockwise from straight ahead, and (N,) the row of each
    point."""
    sensor = presets()["hdl64e_kitti360"]
    image = image_of(sensor.by_beams(), 5, share=share)
    points = []
    rows = []
    # Rings of nearer points are ambiguous in crops.
    image.range[image.mask] = np.maximum(image.range[image.mask], 5)
    for row in range(sensor.shape[0]):
        order = np.argsort(-sensor.column_azimuths() % (2 * np.pi))
        order = order[image.range[row, order] > 0]
        points.append(
            image.range[row, order, None]
            * sensor.by_beams().ray_directions()[row, order]
        )
        rows.append(np.full(len(order), row))
    xyz = np.concatenate(points).astype(np.float32)
    return Scan(
        xyz, np.linspace(0, 1, len(xyz), dtype=np.float32), sensor
    ), np.concatenate(rows)


def test_unfolding_assigns_rings_to_their_beams_even_if_some_are_missing() -> None:
    full_scan, rows = scan_in_ring_order()
    for kept in (rows >= 0, rows < 39, rows >= 20, (rows < 10) | (rows > 30)):
        image = unfold(full_scan[kept])
        assert np.array_equal(
            image.range,
            unfold(replace(full_scan, ring=rows.astype(np.int16))[kept]).range,
        )
        assert np.array_equal(np.flatnonzero(image.mask.any(1)), np.unique(rows[kept]))
        assert np.array_equal(project(unproject(image)).mask, image.mask)
    with pytest.raises(DataError, match=r"rings found for the 64 lasers.*project\(\)"):
        unfold(full_scan[np.random.default_rng(0).permutation(len(full_scan))])


@given(
    first=st.integers(0, 359),
    width=st.integers(60, 360),
    share=st.sampled_from([0.3, 0.95]),
)
@settings(max_examples=25)
def test_a_crop_unfolds_like_the_same_part_of_the_complete_scan(
    first: int, width: int, share: float
) -> None:
    full_scan, rows = scan_in_ring_order(share)
    azimuth = np.degrees(np.arctan2(full_scan.points[:, 1], full_scan.points[:, 0]))
    kept = (azimuth - first) % 360 < width
    known = replace(full_scan, ring=rows.astype(np.int16))[kept]
    image = unfold(full_scan[kept])
    expected = unfold(known)
    assert np.array_equal(image.range, expected.range)
    assert np.array_equal(image.reflectance, expected.reflectance)


@pytest.mark.parametrize("half", ["left", "right", "rear"])
def test_rings_are_found_in_half_a_scan(half: str) -> None:
    """R2Flow's rule looks for the step from the fourth quadrant to the first, which half a scan may
    not contain."""
    full_scan, rows = scan_in_ring_order()
    x = full_scan.points[:, 0]
    y = full_scan.points[:, 1]
    kept = {"left": y > 0, "right": y < 0, "rear": x < 0}[half]
    assert np.array_equal(ring_numbers(full_scan.points[kept]), rows[kept])


@given(seed=st.integers(0, 10_000), strays=st.integers(1, 3), at_seam=st.booleans())
@settings(max_examples=25)
def test_stray_points_do_not_start_rings(seed: int, strays: int, at_seam: bool) -> None:
    full_scan, rows = scan_in_ring_order()
    rng = np.random.default_rng(seed)
    place = rng.integers(1, len(full_scan), strays)
    if at_seam:
        place = rng.choice(np.flatnonzero(np.diff(rows)) + 1) + rng.integers(
            -2, 3, strays
        )
    order = np.insert(
        np.arange(len(full_scan)), place, rng.integers(0, len(full_scan), strays)
    )
    ring = ring_numbers(full_scan.points[order])
    moved = ring != rows[order]
    assert ring.max() == 63
    assert moved.sum() <= 5 * strays, "only the strays and points between them"
    assert unfold(full_scan[order]).mask.any(1).all()


def test_points_that_are_not_in_ring_order_are_refused() -> None:
    full_scan, rows = scan_in_ring_order()
    azimuth = np.arctan2(full_scan.points[:, 1], full_scan.points[:, 0]) % (2 * np.pi)
    orders = {
        "column by column": np.argsort(azimuth, kind="stable"),
        "clockwise": np.lexsort((-azimuth, rows)),
        "from the rear on": np.lexsort(((azimuth + np.pi) % (2 * np.pi), rows)),
        "from the bottom up": np.lexsort((azimuth, -rows)),
        "a narrow sector": np.flatnonzero(np.abs(azimuth - 2) < 0.05),
    }
    for name, order in orders.items():
        scan = replace(full_scan[order], id=name)
        with pytest.raises(
            DataError, match=f"{name}.*ring by ring, as KITTI stores them"
        ):
            unfold(scan)


def test_unfolding_with_ring_numbers_needs_no_order() -> None:
    sensor = presets()["hdl32e_nuscenes"]
    image = image_of(sensor, 2)
    scan = unproject(image)
    rows = np.nonzero(image.mask)[0].astype(np.int16)
    scan.ring = rows
    mixed = np.random.default_rng(1).permutation(len(scan))
    assert np.allclose(unfold(scan[mixed]).range, image.range, rtol=3e-7)


@pytest.mark.parametrize(
    ("other", "kept"), [("hdl64e_semantic_kitti", True), ("os1_64", False)]
)
def test_rings_stay_with_their_lasers(other: str, kept: bool) -> None:
    image = image_of(presets()["hdl64e_lasers"], 0)
    image.channels["ring"] = np.indices(image.range.shape)[0]
    seen = unproject(project(unproject(image), presets()[other]))
    assert (seen.ring is not None) is kept


def test_row_edges_of_a_beam_table_are_halfway_between_beams() -> None:
    sensor = SMALL["table"]
    beams = np.radians(sensor.elevations)
    halves = (beams[1:] + beams[:-1]) / 2
    for row, half in enumerate(halves):
        for side, expected in ((1e-4, row), (-1e-4, row + 1)):
            point = (
                np.array([[np.cos(half + side), 0, np.sin(half + side)]], np.float32)
                * 10
            )
            assert locate(point, sensor).cell // 16 == expected


def test_invalid_input_is_refused() -> None:
    sensor = SMALL["linear"]
    scan = random_scan(sensor, 10)
    with pytest.raises(DataError, match="float32"):
        locate(scan.points.astype(np.float64), sensor)
    with pytest.raises(ConfigError, match="no \\['colour'\\]"):
        project(scan, channels=["colour"])
    with pytest.raises(DataError, match=r"\(H, W\)|rows and columns"):
        RangeImage(np.zeros((3, 3), np.float32), sensor)
    with pytest.raises(DataError, match="non-finite"):
        unproject(RangeImage(np.full(sensor.shape, np.nan, np.float32), sensor))
    with pytest.raises(DataError, match="offsets"):
        project_batch(torch.zeros(4, 3), torch.tensor([0, 5]), sensor)
    with_nan = scan.points.copy()
    with_nan[0] = np.nan
    assert locate(with_nan, sensor).cell[0] == -1
