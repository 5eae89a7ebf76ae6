"""Projection, unfolding and label transfer on every HDL-64E scan of the real datasets."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ring_numbers

from lidar_synth.formats.points import read_points
from lidar_synth.geometry.projection import (
    locate,
    project,
    unfold,
    unproject,
)
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor

FULL_TURN = 100_000  # points; fewer is a scan cut off or cropped to a camera's view
ROOTS = ("kitti360", "semantic_kitti", "kitti_object", "kitti_raw")


def scans_below(root: Path) -> list[Scan]:
    scans = []
    for path in sorted(p for folder in ROOTS for p in (root / folder).rglob("*.bin")):
        points = read_points(path)
        sensor = load_sensor(
            "hdl64e_semantic_kitti" if "semantic" in str(path) else "hdl64e_kitti"
        )
        scans.append(
            Scan(points[:, :3], points[:, 3], sensor, id=str(path.relative_to(root)))
        )
    return scans


@pytest.fixture(scope="module")
def scans(real_scans: Path) -> list[Scan]:
    return scans_below(real_scans)


def elevation(points: np.ndarray) -> np.ndarray:
    return np.arcsin(
        points[:, 2].astype(np.float64)
        / np.linalg.norm(points.astype(np.float64), axis=1)
    )


@pytest.mark.slow
def test_unprojecting_and_projecting_keeps_every_cell(scans: list[Scan]) -> None:
    full = [s for s in scans if len(s) > FULL_TURN]
    assert len(full) >= 29
    for scan in full:
        for image in (project(scan), unfold(scan)):
            back = project(unproject(image))
            assert np.array_equal(back.mask, image.mask), scan.id
            assert np.allclose(back.range, image.range, rtol=3e-7, atol=0), scan.id
            assert np.array_equal(back.reflectance, image.reflectance), scan.id


def test_a_kept_point_moves_by_at_most_half_a_cell(scans: list[Scan]) -> None:
    for scan in scans:
        sensor = scan.sensor
        kept = locate(scan.points, sensor).point
        before = scan.points[kept[kept >= 0]]
        after = unproject(project(scan)).points
        seen = (elevation(before) <= np.radians(sensor.up)) & (
            elevation(before) >= np.radians(sensor.down)
        )
        half = np.radians(sensor.up - sensor.down) / sensor.shape[0] / 2
        assert seen.mean() > 0.9
        assert (
            np.abs(elevation(after) - elevation(before))[seen].max() <= half + 1e-6
        ), scan.id
        turned = np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(
            before[:, 1], before[:, 0]
        )
        turned = (turned + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turned).max() <= np.pi / sensor.columns + 1e-6, scan.id


def test_unfolding_finds_the_beam_of_each_ring_also_in_cropped_scans(
    scans: list[Scan],
) -> None:
    """The truncated scan has the upper 39 rings, and the camera-cropped one the upper 46; both
    start in row 0."""
    rows = {s.id: np.flatnonzero(unfold(s).mask.any(axis=1)) for s in scans}
    for scan_id, filled in rows.items():
        count = {"drive_0052": 39, "velodyne_reduced": 46}
        expected = next((n for key, n in count.items() if key in scan_id), 64)
        assert filled.tolist() == list(range(expected)), scan_id


@pytest.mark.slow
def test_halves_have_the_rings_of_the_complete_scan(scans: list[Scan]) -> None:
    for scan in (s for s in scans if len(s) > FULL_TURN):
        ring, (x, y, _) = ring_numbers(scan.points), scan.points.T
        for kept in (x > 0, x < 0, y > 0, y < 0, x < 5):
            expected = np.unique(ring[kept], return_inverse=True)[1]
            assert np.array_equal(ring_numbers(scan.points[kept]), expected), scan.id
            assert unfold(scan[kept]).mask.any(1).sum() == expected.max() + 1, scan.id


@pytest.mark.slow
def test_the_beam_table_matches_the_rings_of_real_scans(scans: list[Scan]) -> None:
    """Compares the median elevation of each ring over full scans with the preset's ``beams``."""
    sensor: Sensor = load_sensor("hdl64e_kitti360")
    medians = []
    for scan in (s for s in scans if len(s) > FULL_TURN):
        ring = ring_numbers(scan.points)
        assert ring[-1] == 63, scan.id
        medians.append(
            [np.median(elevation(scan.points[ring == i])) for i in range(64)]
        )
    assert (
        np.degrees(np.abs(np.median(medians, axis=0) - sensor.laser_elevations)).max()
        < 0.03
    )
