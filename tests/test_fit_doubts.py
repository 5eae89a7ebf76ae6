"""A fit names what it does not know: no beam or offset is wrong without a doubt."""

import json
import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from simulated_sweeps import BEAMS, turned

from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.lines import nearest_beams
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor, presets, sensor_yaml
from lidar_synth.lab.fitting import SensorFit, fit_sensor
from lidar_synth.lab.fitting.doubts import name_vendor, vendors
from lidar_synth.lab.town import Town

OFFSETS = tuple(np.tile([-3.0, -1.0, 1.0, 3.0], 4).tolist())


def near_beam(beam: int = 5) -> Scan:
    """A scan with times, in which one beam has no point beyond 4 m."""
    made = turned(azimuths=OFFSETS)
    own = made.ring == beam
    short = 3.0 / np.linalg.norm(made.scan.points[own], axis=1, keepdims=True)
    points = made.scan.points.copy()
    points[own] *= short.astype(np.float32)
    return replace(made.scan, points=points)


def with_points(scan: Scan, points: np.ndarray) -> Scan:
    """A scan without rings and times, with further points."""
    every = np.concatenate([scan.points, points.astype(np.float32)])
    return Scan(every, np.zeros(len(every), np.float32), scan.sensor)


@cache
def fit_of_near_beam() -> SensorFit:
    return fit_sensor([near_beam()])


def test_unknown_azimuth_offsets_are_named() -> None:
    fit = fit_of_near_beam()
    offsets = np.asarray(fit.sensor.azimuths, np.float64)
    assert np.flatnonzero(np.isnan(offsets)).tolist() == [5] and np.isnan(
        fit.azimuths.offsets[5]
    )
    assert (
        f"offsets of the beams at {fit.sensor.elevations[5]:.2f} degrees are not known"
        in " ".join(fit.uncertain)
    )
    wrong = offsets - OFFSETS
    assert np.nanmax(np.abs(wrong - np.nanmedian(wrong))) < 0.1


def test_a_sensor_with_unknown_offsets_is_written_read_and_cast(tmp_path) -> None:
    sensor = fit_of_near_beam().sensor
    (tmp_path / "a.yaml").write_text(sensor_yaml(sensor))
    assert (
        load_sensor(tmp_path / "a.yaml")
        == sensor
        == Sensor.from_dict(json.loads(json.dumps(sensor.to_dict())))
    )
    (tmp_path / "a.yaml").write_text(sensor_yaml(sensor).replace("null", ".nan"))
    assert load_sensor(tmp_path / "a.yaml") == sensor and "null" in sensor_yaml(sensor)
    with pytest.warns(UserWarning, match="offsets of 1 of 16 beams are not known"):
        azimuths = sensor.firing_azimuths()
    assert np.isfinite(azimuths).all()
    found = assign_beams(near_beam(), sensor)
    assert ((found.firing == -1) == (found.ring == 5)).all()


def test_the_nearest_beam_is_found_without_an_array_of_all_pairs() -> None:
    elevations, heights = load_sensor("hdl64e_lasers").optics()
    tangents = np.tan(elevations)
    points = np.random.default_rng(0).normal(0, [20, 20, 1], (20_000, 3))
    points[0] = np.nan
    near = points.astype(np.float32)
    rho = np.hypot(near[:, :1], near[:, 1:2])
    gap = near[:, 2:] - rho * tangents.astype(np.float32) - heights.astype(np.float32)
    expected = np.abs(gap * (1 / np.hypot(1, tangents))).argmin(1)
    assert not len(nearest_beams(points[:0], tangents, heights))  # compiles it
    tracemalloc.start()
    found = nearest_beams(points, tangents, heights)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (found == expected).all() and peak < 20_000 * 64
    twins = nearest_beams(points, np.r_[tangents, tangents], np.r_[heights, heights])
    assert (twins == expected).all()


@pytest.mark.parametrize("few", [20, 60])
def test_beams_with_few_points_are_found_and_named(few: int) -> None:
    made = turned()
    kept = np.ones(len(made.ring), bool)
    for beam in (0, 7):
        kept[np.flatnonzero(made.ring == beam)[few:]] = False
    fit = fit_sensor([with_points(made.scan[kept], np.zeros((0, 3)))])
    assert np.abs(np.array(fit.sensor.elevations) - BEAMS).max() < 0.03 and fit.points[
        [0, 7]
    ].tolist() == [few, few]
    named = f"{fit.sensor.elevations[0]:.2f}" in " ".join(fit.uncertain)
    assert named == (few < 50)


def test_returns_at_the_origin_are_left_out() -> None:
    scan = turned().scan
    plain = fit_sensor([scan])
    points = scan.points.copy()
    points[::5] = 0
    fit = fit_sensor([replace(scan, points=points)])
    assert fit.share == plain.share == 1 and np.allclose(
        fit.sensor.elevations, plain.sensor.elevations, atol=1e-3
    )
    assert (fit.rings[0][::5] == -1).all() and fit.points.sum() == (
        fit.rings[0] >= 0
    ).sum()


SPOILT = {
    "were not fitted": lambda rng, count: rng.uniform(-0.25, 0.25, (count, 3)),
    "from every beam": lambda rng, count: (
        rng.uniform(-20, 20, (count, 3)) * [1, 1, 0.2]
    ),
}


@pytest.mark.parametrize("doubt", SPOILT)
def test_every_unexplained_per_cent_of_points_is_a_doubt(doubt: str) -> None:
    scan = turned().scan
    count = len(scan) // 50
    fit = fit_sensor(
        [with_points(scan, SPOILT[doubt](np.random.default_rng(0), count))]
    )
    [found] = [line for line in fit.uncertain if doubt in line]
    assert float(found.split("%")[0]) == pytest.approx(
        100 * count / (count + len(scan)), abs=0.8
    )
    assert (
        len(fit.points) == 16
        and fit.points.sum() + count * ("fitted" in doubt) == len(scan) + count
    )


def test_the_vendor_of_a_fit_is_named() -> None:
    table = vendors()["Hesai Pandar128E4X"]
    assert name_vendor(table, np.full(128, 500)) == "Hesai Pandar128E4X"
    few = np.where(np.arange(128) < 20, 3, 500)
    assert (
        name_vendor(table, few)
        == "Hesai Pandar128E4X; 20 channels had few points or none"
    )
    assert name_vendor(table[20:], few[20:]) == name_vendor(table, few)
    assert name_vendor(np.array(BEAMS), np.full(16, 500)) == ""
    assert (
        name_vendor(np.array(presets()["pandar64"].elevations), np.full(64, 500))
        == "Hesai Pandar64"
    )


def test_no_beam_of_a_sparse_town_is_wrong_without_a_doubt() -> None:
    scan = Town(0, "os0_128", 1, motion=False)[0]
    beams = np.degrees(scan.sensor.row_elevations())
    seen = np.bincount(scan.ring, minlength=128)
    shuffled = replace(scan, ring=None)[np.random.default_rng(0).permutation(len(scan))]
    fit = fit_sensor([shuffled])
    assert len(fit.points) == (seen >= 15).sum()
    wrong = np.abs(np.array(fit.sensor.elevations)[:, None] - beams).min(1) > 0.05
    for elevation in np.array(fit.sensor.elevations)[wrong]:
        assert f"{elevation:.2f}" in " ".join(fit.uncertain)


@pytest.mark.parametrize("encoder", [None, 4000])
def test_the_firings_of_a_thinned_scan_are_not_known(encoder: int | None) -> None:
    made = turned(azimuths=OFFSETS, firings=2170, encoder=encoder)
    rng = np.random.default_rng(0)
    thinned = made.scan[rng.permutation(len(made.scan))[: len(made.scan) // 3]]
    untimed = fit_sensor([replace(thinned, time=None)])
    assert untimed.sensor.firings is None and untimed.azimuths.offsets is None
    assert "number of firings is not known" in " ".join(untimed.uncertain)
    timed = fit_sensor([thinned])
    assert timed.sensor.firings is None
    wrong = np.asarray(timed.sensor.azimuths) - OFFSETS
    assert np.abs(wrong - np.median(wrong)).max() < 0.1


def test_near_returns_beside_a_beam_are_none() -> None:
    scan = turned().scan
    angle = np.radians(np.linspace(20, 40, 100))
    elevation = np.radians((BEAMS[13] + BEAMS[14]) / 2)
    wall = 0.9 * np.stack(
        [np.cos(angle), np.sin(angle), np.full(100, np.tan(elevation))], 1
    )
    fit = fit_sensor([with_points(scan, wall)])
    assert len(fit.points) == 16
