"""``prove`` with fewer beams: which returns stay, of real and of synthetic scans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from proofs import TOWN_SENSOR, drives
from typer.testing import CliRunner

from lidar_synth import ProofSettings, Town, load_sensor, open_scans
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.projection import locate
from lidar_synth.lab.proof.beams import coarser, keep_beams
from lidar_synth.lab.proof.planning import make_plan
from lidar_synth.lab.proof.pools import PoolTask, make_pool, read_pool
from lidar_synth.labels.exchange import thin_scan

SMALL = ProofSettings(
    arms=("real", "town"), iterations=10, batch=2, seeds=1, columns=64, widths=(4, 8)
)


@pytest.mark.parametrize("rings", [True, False])
def test_every_fourth_beam_stays_with_its_labels(rings: bool) -> None:
    scan = Town(seed=0, sensor=TOWN_SENSOR, scans=1, motion=False)[0]
    assert scan.ring is not None and scan.label is not None
    stays = scan.ring % 4 == 2
    given = scan if rings else replace(scan, ring=None)
    few = keep_beams(given, 8)
    assert few.label is not None and few.sensor.shape[0] == 8
    assert np.array_equal(few.points, scan.points[stays])
    assert np.array_equal(few.label, scan.label[stays])
    if rings:
        assert few.ring is not None
        assert np.array_equal(few.ring, scan.ring[stays] // 4)
    else:
        assert few.ring is None
    assert keep_beams(scan, None) is scan


def test_the_coarser_sensor_has_the_lasers_that_stay() -> None:
    whole = load_sensor("hdl64e_semantic_kitti")
    few = coarser(whole, 16)
    assert few.name == "hdl64e_semantic_kitti/16 beams"
    for mine, all_of_them in zip(few.optics(), whole.optics(), strict=True):
        assert mine == pytest.approx(all_of_them[2::4], abs=1e-6)
    assert few.azimuths == whole.azimuths[2::4]  # type: ignore[index]
    assert few.columns == whole.columns and few.range_max == whole.range_max
    assert coarser(whole, None) is whole


def test_returns_fall_into_the_rows_of_their_beams() -> None:
    sensor = replace(TOWN_SENSOR, name="other")
    few = keep_beams(Town(seed=0, sensor=sensor, scans=1, motion=False)[0], 8)
    row = locate(few.points, few.sensor).cell // few.sensor.columns
    assert few.ring is not None and np.array_equal(row, few.ring)


def test_all_scans_of_a_plan_and_its_pools_are_of_the_coarser_sensor(
    tmp_path: Path,
) -> None:
    source = drives()
    plan, scans = make_plan(source, replace(SMALL, beams=8), None, 1)
    whole, _ = make_plan(drives(), SMALL, None, 1)
    assert plan.sensor.shape[0] == 8 and plan.grid is not None
    for index, scan in scans.items():
        expected = thin_scan(keep_beams(source[index], 8), plan.grid)
        assert scan.sensor == plan.grid
        assert np.array_equal(scan.points, expected.points)
    assert plan.identity()["beams"] == 8 and "beams" not in whole.identity()
    other = replace(
        plan, sensor=replace(plan.sensor, range_max=50.0)
    )  # of the same name
    assert other.identity() != plan.identity()
    task = PoolTask("town", tmp_path, plan.sensor, plan.grid, 1)
    made = read_pool(make_pool(task))
    assert made[0].sensor.shape == (8, 64) and len(made[0]) > 100


def test_a_comparison_knows_how_its_scans_were_read(tmp_path: Path) -> None:
    writer = WRITERS["semantic_kitti"](tmp_path)
    for index, scan in enumerate(drives()):
        writer.write(scan, index)
    settings = replace(SMALL, places="stretch")
    one, other = (
        make_plan(open_scans(tmp_path, **options), settings, None, 1)[0].identity()
        for options in ({}, {"reflectance_max": 2.0})
    )
    assert "reflectance_max" not in one
    assert other == one | {"reflectance_max": 2.0}


@pytest.mark.parametrize("beams", [5, 0, -4, 64, 2])
def test_other_numbers_are_refused_with_what_to_type(beams: int) -> None:
    with pytest.raises(
        ConfigError, match=r"one of 16, 8, 4.*Use --beams 16 \(beams=16"
    ):
        coarser(TOWN_SENSOR, beams)


def test_the_command_refuses_beams_of_detectors() -> None:
    words = ["prove", "here", "--task", "detection", "--beams", "16"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code and "--beams" in str(result.exception)
