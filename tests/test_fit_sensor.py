"""Sensors fitted to scans whose beams, firings, mounting and motion are known."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from simulated_sweeps import BEAMS, compensated, driving, turned

from lidar_synth.cli import main
from lidar_synth.errors import DataError
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.deskew import Trajectory, deskew, reskew
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor, sensor_yaml
from lidar_synth.lab.fitting import SensorFit, fit_sensor
from lidar_synth.lab.fitting.search import tilt_of
from lidar_synth.lab.town import Town

HEIGHTS = tuple([0.2] * 8 + [0.12] * 8)
OFFSETS = tuple((np.tile([-3.0, -1.0, 1.0, 3.0], 4) + np.linspace(0, 0.5, 16)).tolist())
MOUNT = (np.array([0.8, 0.3, 1.6]), tilt_of(np.radians([1.0, -1.5])))


def some(count: int = 2, **options: object) -> list[Scan]:
    return [turned(seed=seed, **options).scan for seed in range(count)]  # type: ignore[arg-type]


def untimed(scans: list[Scan]) -> list[Scan]:
    return [replace(scan, time=None) for scan in scans]


def shuffled(scans: list[Scan]) -> list[Scan]:
    return [
        scan[np.random.default_rng(0).permutation(len(scan))] for scan in untimed(scans)
    ]


def moved(scans: list[Scan], offset: np.ndarray, turn: np.ndarray) -> list[Scan]:
    return [
        replace(scan, points=(scan.points @ turn.T + offset).astype(np.float32))
        for scan in scans
    ]


SCANS: dict[str, tuple[Callable[[], list[Scan]], tuple[float, ...]]] = {
    "in the order of time": (lambda: untimed(some()), BEAMS),
    "in any order": (lambda: shuffled(some()), BEAMS),
    "with times": (some, BEAMS),
    "a quarter of the turn": (
        lambda: [s[s.points[:, 0] > abs(s.points[:, 1])] for s in shuffled(some(3))],
        BEAMS,
    ),
    "every fourth beam": (lambda: shuffled(some(3, elevations=BEAMS[::4])), BEAMS[::4]),
    "lasers above the origin": (lambda: shuffled(some(heights=HEIGHTS)), BEAMS),
    "motion compensated, with times": (
        lambda: [compensated(s, 12.0, 0.2) for s in some()],
        BEAMS,
    ),
    "motion compensated, without": (
        lambda: untimed([compensated(s, 12.0, 0.2) for s in some()]),
        BEAMS,
    ),
    "the town's os1_128": (
        lambda: [Town(0, "os1_128", 1, motion=False)[0]],
        tuple(np.degrees(load_sensor("os1_128").row_elevations()).tolist()),
    ),
}


@cache
def fitted(name: str) -> SensorFit:
    return fit_sensor(SCANS[name][0]())


@pytest.mark.parametrize("name", SCANS)
def test_the_beams_are_found(name: str) -> None:
    fit = fitted(name)
    beams = SCANS[name][1]
    assert fit.sensor.shape[0] == len(beams)
    assert np.abs(np.array(fit.sensor.elevations) - beams).max() < 0.02
    assert fit.share > 0.98 and fit.points.sum() == sum(map(len, fit.rings))


@pytest.mark.parametrize("change", ["from 1", "even", "one lost", "one almost lost"])
def test_ring_numbers_may_have_gaps(change: str) -> None:
    made = [turned(seed=seed) for seed in range(2)]
    scans = [replace(m.scan, ring=m.ring.astype(np.int16)) for m in made]
    if change in ("from 1", "even"):
        scans = [
            replace(s, ring=s.ring + np.int16(1) if change == "from 1" else 2 * s.ring)
            for s in scans
        ]
    else:
        scans = [s[s.ring != 5] for s in scans]
    # its only returns are those of the sensor's own housing
    if change == "one almost lost":
        near = np.array([[0.1, 0.0, 0.01]], np.float32)
        last = replace(scans[0][-1:], points=near, ring=np.array([5], np.int16))
        fields = {
            n: np.concatenate([v, last.fields()[n]])
            for n, v in scans[0].fields().items()
        }
        scans[0] = replace(
            scans[0], points=np.concatenate([scans[0].points, near]), **fields
        )
    fit = fit_sensor(scans)
    there = BEAMS if change in ("from 1", "even") else (*BEAMS[:5], *BEAMS[6:])
    assert fit.source == "ring field" and fit.sensor.shape[0] == len(there)
    assert (
        np.abs(np.array(fit.sensor.elevations) - there).max() < 0.02
        and fit.share > 0.99
    )


def test_heights_and_speeds_are_found() -> None:
    fit = fitted("lasers above the origin")
    assert np.allclose(fit.sensor.heights, HEIGHTS, atol=0.005)
    made = turned(heights=HEIGHTS)
    found = assign_beams(made.scan, fit.sensor)
    assert np.array_equal(found.ring, made.ring) and np.abs(found.off).max() < 0.02
    assert np.allclose(
        fitted("motion compensated, with times").motion[:, 0], 12.0, atol=0.3
    )


@pytest.mark.slow
def test_the_place_of_the_sensor_on_a_vehicle_is_found() -> None:
    town = Town(0, "os1_128", 40, motion=False)
    scans = moved(shuffled([town[0], town[30]]), *MOUNT)
    fit = fit_sensor([replace(scan, ring=None) for scan in scans])
    assert (
        np.allclose(fit.mount[:3, 3], MOUNT[0], atol=0.02)
        and fit.sensor.heights is None
    )
    assert np.allclose(fit.mount[2, :2], MOUNT[1][2, :2], atol=1e-3)
    beams = np.degrees(load_sensor("os1_128").row_elevations())
    assert np.abs(np.array(fit.sensor.elevations) - beams).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["os1_128", "pandar64"])
def test_tilts_of_up_to_six_degrees_are_found_without_rings(name: str) -> None:
    offset = np.array([-0.76, -1.29, 0.88])
    turn = tilt_of(np.radians([-4.0, 2.5]))
    [scan] = moved(shuffled([Town(0, name, 1, motion=False)[0]]), offset, turn)
    fit = fit_sensor([replace(scan, ring=None)])
    beams = np.degrees(load_sensor(name).row_elevations())
    assert np.allclose(fit.mount[:3, 3], offset, atol=0.02) and np.allclose(
        fit.mount[2, :2], turn[2, :2], atol=1e-3
    )
    assert np.abs(np.array(fit.sensor.elevations) - beams).max() < 0.02


FIRINGS: dict[str, tuple[Callable[[], list[Scan]], int, str]] = {
    "times": (lambda: some(azimuths=OFFSETS), 1000, "time"),
    "the order of time": (lambda: untimed(some(azimuths=OFFSETS)), 1000, "time"),
    "the encoder's pattern": (
        lambda: shuffled(some(azimuths=OFFSETS, firings=2170, encoder=4000)),
        2170,
        "encoder",
    ),
}


@pytest.mark.parametrize("name", FIRINGS)
def test_firings_and_azimuth_offsets_are_found(name: str) -> None:
    make, firings, known = FIRINGS[name]
    fit = fit_sensor(make())
    assert fit.azimuths.known == known and fit.sensor.firings == pytest.approx(
        firings, rel=0.005
    )
    wrong = np.array(fit.sensor.azimuths) - OFFSETS
    # Without times, lasers seem to fire one after the other, within the angle between two firings.
    assert np.abs(wrong - np.median(wrong)).max() < (
        0.18 if name == "the order of time" else 0.1
    )


def test_ranges_and_reflectance_are_described() -> None:
    scans = shuffled(some())
    for scan in scans:
        distance = np.linalg.norm(scan.points.astype(float), axis=1)
        scan.points = (
            scan.points * (np.round(distance / 0.004) * 0.004 / distance)[:, None]
        ).astype(np.float32)
    fit = fit_sensor(scans)
    assert fit.sensor.range_step == 0.004 and fit.sensor.reflectance_levels == 256
    assert fit.nearest <= 5 and fit.sensor.range_max >= fit.farthest >= 70
    assert fit.sensor.columns == fit.sensor.firings == 1000 and fit.uncertain == ()


BAD: dict[str, tuple[Callable[[], list[Scan]], str]] = {
    "no scans": (list, "0 scans"),
    "empty scans": (lambda: [s[:0] for s in some()], "2 scans with 0 points"),
    "one beam": (
        lambda: [t.scan[t.ring == 12] for t in [turned()]],
        "fewer than two beams|no beams found",
    ),
    "one ring": (
        lambda: [
            replace(t.scan[t.ring == 12], ring=np.zeros((t.ring == 12).sum(), np.int16))
            for t in [turned()]
        ],
        "fewer than two beams|no beams found",
    ),
    "10 m beside the sensor": (
        lambda: moved(some(), np.array([10.0, 4, 0]), np.eye(3)),
        "no beams|fewer than two",
    ),
    "tilted by 20 degrees": (
        lambda: moved(some(1), np.zeros(3), tilt_of(np.radians([20.0, 5]))),
        "no beams|fewer than two",
    ),
    "points anywhere": (
        lambda: [
            replace(
                s,
                points=np.random.default_rng(0)
                .uniform(-20, 20, s.points.shape)
                .astype(np.float32),
                time=None,
            )
            for s in some(1)
        ],
        "no beams|fewer than two",
    ),
    "NaN": (
        lambda: [replace(s, points=s.points * np.float32(np.nan)) for s in some(1)],
        "NaN",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_has_no_beams_is_refused(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    make, message = BAD[name]
    with pytest.raises(DataError, match=message):
        fit_sensor(make())
    if name == "points anywhere":
        assert "which takes minutes" in caplog.text


def test_every_point_gets_its_ring_and_firing() -> None:
    made = turned(azimuths=OFFSETS)
    sensor = fit_sensor(some(azimuths=OFFSETS)).sensor
    found = assign_beams(made.scan, sensor)
    assert np.array_equal(found.ring, made.ring) and np.abs(found.off).max() < 0.02
    # Firings are counted from behind; the fit does not know where the first one is.
    shift = (found.firing - made.firing) % sensor.firings
    assert (np.abs(shift - np.median(shift)) <= 1).all()


@pytest.mark.parametrize("name", ["town", "hdl64e_kitti", "hdl64e_lasers", "os1_128"])
def test_every_point_gets_its_ring_with_the_scans_own_sensor(name: str) -> None:
    """Also where the preset has the elevations that lasers above the origin seem to have from
    there."""
    scan = Town(seed=0, scans=1, sensor=name, motion=False)[0]
    found = assign_beams(scan)
    assert (found.ring == scan.ring).mean() > 0.999 and np.percentile(
        np.abs(found.off), 99
    ) < 0.01


def test_motion_compensation_is_undone_by_poses() -> None:
    scan = turned().scan
    path = driving(15.0, 0.5)
    published = deskew(scan, path)
    assert np.abs(published.points - scan.points).max() > 0.5
    assert np.allclose(reskew(published, path).points, scan.points, atol=1e-4)
    assert np.allclose(
        deskew(scan, path, 0.05).points[-1],
        deskew(scan, path).points[-1] - [0.75, 0, 0],
        atol=1.5,
    )
    sensor = fit_sensor([scan]).sensor
    close = [
        np.mean(np.abs(assign_beams(s, sensor).off) < 0.05)
        for s in (published, reskew(published, path))
    ]
    assert close[0] < 0.9 and close[1] == 1


WRONG_PATHS: dict[str, tuple[Callable[[], object], str]] = {
    "one pose": (lambda: Trajectory([0.0], np.eye(4)[None]), "K >= 2"),
    "no rotation": (lambda: Trajectory([0.0, 1.0], np.ones((2, 4, 4))), "rotation"),
    "columns first": (
        lambda: Trajectory([0.0, 1.0], driving(1.0).poses[:2].swapaxes(1, 2)),
        "rotation, a translation",
    ),
    "a mirror": (
        lambda: Trajectory([0.0, 1.0], [np.diag([1, -1, 1, 1]), np.eye(4)]),
        "rotation",
    ),
    "backward": (
        lambda: Trajectory([1.0, 0.0], np.tile(np.eye(4), (2, 1, 1))),
        "increase",
    ),
    "another time": (
        lambda: reskew(turned().scan, driving(1.0), 50.0),
        "those of the poses",
    ),
    "half a circle": (
        lambda: Trajectory([0.0, 1.0], [np.eye(4), np.diag([-1, -1, 1, 1])]).at(0.5),
        "half a circle",
    ),
    "no times": (
        lambda: reskew(replace(turned().scan, time=None), driving(1.0)),
        "has no time",
    ),
}


@pytest.mark.parametrize("name", WRONG_PATHS)
def test_wrong_trajectories_are_refused(name: str) -> None:
    make, message = WRONG_PATHS[name]
    with pytest.raises(DataError, match=message):
        make()


def run(*words: object) -> int:
    """The exit status of the command line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["lidar-synth", *map(str, words)])
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def write(scans: list[Scan], folder: Path) -> Path:
    folder.mkdir()
    for number, scan in enumerate(scans):
        np.c_[scan.points, scan.reflectance].astype("<f4").tofile(
            folder / f"{number:06d}.bin"
        )
    return folder


def test_the_command_writes_a_sensor_and_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(some(azimuths=OFFSETS), tmp_path / "scans")
    out = tmp_path / "mine.yaml"
    assert (
        run(
            "sensor",
            "fit",
            folder,
            "--out",
            out,
            "--picture",
            tmp_path / "fit.png",
            "--json",
        )
        == 0
    )
    printed = json.loads(capsys.readouterr().out)
    sensor = load_sensor(out)
    assert (
        sensor.to_dict() == printed["sensor"]
        and sensor.name == "mine"
        and sensor.shape == (16, 1000)
    )
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert sensor_yaml(sensor) == out.read_text()
    made = turned()
    bad = write([made.scan[made.ring == 12]], tmp_path / "bad")
    assert run("sensor", "fit", bad, "--out", tmp_path / "bad.yaml") == 1
    assert (
        "expected" in capsys.readouterr().err and not (tmp_path / "bad.yaml").exists()
    )
    assert run("sensor", "fit", folder, "--out", tmp_path / "mine.txt") == 2


@pytest.mark.filterwarnings("ignore:skipped scan 000000")
def test_scans_that_are_skipped_do_not_count(tmp_path: Path) -> None:
    folder = write(some(3), tmp_path / "scans")
    os.truncate(folder / "000000.bin", 1001)
    out = tmp_path / "mine.yaml"
    assert run("sensor", "fit", folder, "--out", out, "--on-bad", "skip") == 0
    assert load_sensor(out).description == "fitted to 2 scans"


@pytest.fixture
def pandaset() -> Path:
    folder = os.environ.get("LIDAR_SYNTH_LABELLED_SCANS")
    if not folder:
        pytest.skip("LIDAR_SYNTH_LABELLED_SCANS is not set")
    return Path(folder) / "pandaset"


@pytest.mark.slow
def test_the_table_of_a_real_pandar64_is_found(pandaset: Path) -> None:
    table = np.loadtxt(pandaset / "pandar64_elevations.csv", delimiter=",", skiprows=1)
    scans = []
    for frame in ("00", "20", "40", "60", "70"):
        with np.load(pandaset / "sensor_frame" / f"{frame}.npz") as file:
            points = file["points"]
            time = file["time"]
            scans.append(
                Scan(
                    points,
                    np.zeros(len(points), np.float32),
                    load_sensor("town"),
                    time=time,
                )
            )
    fit = fit_sensor(scans)
    assert (np.abs(np.array(fit.sensor.elevations) - table[:, 1]) < 0.02).sum() >= 60
    assert fit.share > 0.98 and fit.sensor.firings == 1800
    wrong = np.array(fit.sensor.azimuths) - table[:, 2]
    # Lasers fire one after the other, within 30 microseconds.
    assert np.abs(wrong - np.median(wrong)).max() < 0.15
