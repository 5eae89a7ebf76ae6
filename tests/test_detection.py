"""``prove --task detection``: places, arms, intervals and the page of a comparison of detectors."""

import json
import shutil
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from streets import kitti, street
from typer.main import get_command
from typer.testing import CliRunner

from lidar_synth import Boxes, Scan, load_sensor
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats.npz import write_scan
from lidar_synth.lab.proof.arms import EPOCHS
from lidar_synth.lab.proof.detection import (
    ARMS,
    DetectionSettings,
    prove_detection,
    study,
)
from lidar_synth.lab.proof.detection.arms import make_mixture
from lidar_synth.lab.proof.detection.bev import CHANNELS, Found
from lidar_synth.lab.proof.detection.boxes import points_in
from lidar_synth.lab.proof.detection.network import Detector, detect
from lidar_synth.lab.proof.detection.page import describe, format_table
from lidar_synth.lab.proof.detection.scores import Criterion, Truth, judge, precision_of
from lidar_synth.lab.proof.detection.study import DetectionWork, half_of
from lidar_synth.lab.proof.detection.summary import summarise

pytestmark = pytest.mark.usefixtures("one_thread")

CAR = (10.0, 0, 0, 4, 2, 1.5, 0)
FAR = (40.0, 0, 0, 4, 2, 1.5, 0)


def values(*rows: tuple[float, ...]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 7)


def found(*rows: tuple[float, ...]) -> Found:
    count = len(rows)
    scores = np.linspace(0.9, 0.5, count, dtype=np.float32)
    return Found(values(*rows), scores, np.zeros(count, np.int64))


def truth(*rows: tuple[float, ...]) -> Truth:
    wanted = np.ones(len(rows), bool)
    return Truth(values(*rows), np.zeros(len(rows), np.int64), wanted)


CASES = {
    "overlap": (Criterion(0.5), 1.0),
    "too little overlap": (Criterion(0.7), 0.5),
    "within 1 m": (Criterion(distance=1), 1.0),
    "not within 0.5 m": (Criterion(distance=0.5), 0.5),
    "the near box alone": (Criterion(0.5, far=20), 1.0),
    "no box so near": (Criterion(0.5, far=5), float("nan")),
}


@pytest.mark.parametrize("case", CASES)
def test_a_criterion_says_what_is_right_and_what_counts(case: str) -> None:
    """One detection is exact and far, the other 0.8 m beside its near box."""
    criterion, expected = CASES[case]
    shifted = (CAR[0] + 0.8, *CAR[1:])
    judged = judge(found(FAR, shifted), truth(CAR, FAR), 0, criterion)
    assert precision_of([judged]) == pytest.approx(expected, nan_ok=True)


def test_a_network_is_not_tested_by_the_statistics_of_one_scan() -> None:
    torch.manual_seed(0)
    network = Detector()
    some = torch.randint(0, 255, (64, 64, CHANNELS), dtype=torch.uint8)
    [expected] = detect(network.eval(), [some])
    [after_training] = detect(network.train(), [some])
    assert len(expected.scores)
    assert np.array_equal(after_training.scores, expected.scores)


def test_two_seeds_test_every_place_once() -> None:
    places = {f"p{i}": [i] for i in range(9)}
    for seed in (0, 2):
        halves = half_of(places, seed), half_of(places, seed + 1)
        assert sorted(halves[0] + halves[1]) == sorted(places)
        assert abs(len(halves[0]) - len(halves[1])) <= 1
    assert half_of(places, 0) != half_of(places, 2)


def outcomes(*good: bool) -> dict[int, dict[int, Found]]:
    """Two seeds with four scans each; the car of each is found, or something else."""
    return {
        seed: {
            4 * seed + i: found(CAR if good[4 * seed + i] else FAR) for i in range(4)
        }
        for seed in range(2)
    }


def compared(*good: bool) -> dict[str, Any]:
    truths = {i: truth(CAR) for i in range(8)}
    tested = {s: {f"p{4 * s + i}": [4 * s + i] for i in range(4)} for s in range(2)}
    base = outcomes(*[False] * 8)
    made = summarise({"gt_sampling": base, "first": outcomes(*good)}, truths, tested)
    return dict(made["classes"]["car"]["arms"]["first"])


def test_an_arm_that_is_better_everywhere_has_an_interval_above_0() -> None:
    row = compared(*[True] * 8)
    assert row["by_seed"] == [100, 100] and row["difference"] == 100
    assert row["interval"] == (100, 100)


def test_an_arm_that_is_better_at_two_places_has_a_wide_interval() -> None:
    row = compared(True, False, False, False, False, False, False, True)
    low, high = row["interval"]
    assert low == 0 < row["difference"] < high == 100


def test_an_arm_that_is_better_in_one_seed_only_has_an_interval_with_0() -> None:
    row = compared(*[True] * 4, *[False] * 4)
    assert row["difference"] == 50 and row["interval"] == (0, 100)


@pytest.mark.parametrize(("places", "seeds"), [(1, 1), (2, 6), (3, 4), (5, 4), (6, 2)])
def test_an_interval_needs_six_places_however_many_seeds(
    places: int, seeds: int
) -> None:
    names = {f"p{i}": [i] for i in range(places)}
    tested = {s: {n: names[n] for n in half_of(names, s)} for s in range(seeds)}
    base = {s: {i: found(FAR) for i in range(places)} for s in tested}
    truths = {i: truth(CAR) for i in range(places)}
    made = summarise({"gt_sampling": base, "first": base}, truths, tested)
    interval = made["classes"]["car"]["arms"]["first"]["interval"]
    assert (interval is not None) == (places == 6)


def test_a_class_counts_in_the_seeds_and_comparisons_that_test_it() -> None:
    """A car in one half of the places, and a cyclist in none that is tested."""
    cyclist = replace(truth(CAR), classes=np.array([2]))
    truths = {0: truth(CAR), 1: truth(), 2: cyclist}
    tested = {0: {"a": [0]}, 1: {"b": [1]}}
    base = {seed: {seed: found(FAR)} for seed in tested}
    better = {seed: {seed: found(CAR)} for seed in tested}
    made = summarise({"gt_sampling": base, "first": better}, truths, tested)
    assert list(made["classes"]) == ["car"]
    row = made["classes"]["car"]["arms"]["first"]
    assert row["by_seed"] == [100, None] and row["difference"] == 100
    json.dumps(made, allow_nan=False)
    assert "| 100.0, – | 100.0 | +100.0 | – |" in format_table(made)


@pytest.mark.parametrize(
    ("arm", "expected"),
    [
        ("first", [8] * 30 + [4] * 8 + [0] * 2),
        ("layouts", [8] * 30 + [4] * 8 + [0] * 2),
        ("quarter", [8] * 10 + [0] * 30),
        ("town", [8] * 40),
        ("gt_sampling", [0] * 40),
    ],
)
def test_an_arm_has_its_shares_of_the_town_by_epoch(
    arm: str, expected: list[int]
) -> None:
    labelled = [street(i) for i in range(2)]
    town = [street(10 + i) for i in range(2)]
    mixed = make_mixture(ARMS[arm], labelled, town, None, 0, 8)
    shares = []
    for epoch in range(EPOCHS):
        mixed.set_epoch(epoch)
        shares.append(sum(mixed.domain(i) for i in range(len(mixed))))
    assert shares == expected


@pytest.mark.parametrize("wrong", [{"arms": ("frist",)}, {"labelled": 0}, {"batch": 0}])
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"first|1 or more"):
        DetectionSettings(**wrong)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for i in range(4):
        (folder / f"place{i}").mkdir()
        write_scan(folder / f"place{i}" / "0.npz", street(i))
    return folder


@pytest.mark.slow
def test_a_comparison_from_scans_to_page(places: Path, tmp_path: Path) -> None:
    pool = tmp_path / "pool"
    pool.mkdir()
    for i in range(2):
        write_scan(pool / f"{i:06d}.npz", street(10 + i))
    options = ["--task", "detection", "--labelled", "2", "--iterations", "10"]
    options += ["--batch", "1", "--synthetic", "2", "--arm", "first"]
    folders = ["--out", str(tmp_path / "out"), "--pools", str(pool)]
    command = ["prove", str(places), *options, *folders]
    result = CliRunner().invoke(app, command)
    assert (
        "| GT sampling |" in result.output
        and "real scans last, GT sampling |" in result.output
    )
    made = json.loads((tmp_path / "out" / "results-2.json").read_text())
    assert set(made["places"]) == {f"place{i}" for i in range(4)}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "Label budget: 2 real scans with boxes" in page and "<svg" in page
    runs = {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "runs").iterdir()}
    assert len(runs) == 4
    CliRunner().invoke(app, command)  # it resumes: nothing is trained
    assert {p: p.stat().st_mtime_ns for p in runs} == runs
    [first, *_] = runs
    first.write_text("{}")
    with pytest.raises(DataError, match="damaged"):
        prove_detection(
            places,
            tmp_path / "out",
            DetectionSettings(2, ("first",), 10, 1, synthetic=2),
            pools=pool,
        )


def test_kittis_objects_are_learnt_in_the_cameras_view(tmp_path: Path) -> None:
    root = kitti(tmp_path / "k", 4)
    (root / "testing").mkdir()
    (root / "testing" / "velodyne").symlink_to(root / "training" / "velodyne")
    command = ["prove", str(root), "--task", "detection", "--dry-run"]
    result = CliRunner().invoke(app, [*command, "--places", "stretch:2"])
    assert "4 scans in 2 places" in result.output
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, DataError)
    assert "mapping/ of the devkit" in str(result.exception)


def test_of_a_larger_pool_the_first_scans_are_taken(tmp_path: Path) -> None:
    for i in range(3):
        write_scan(tmp_path / f"{i:06d}.npz", street(10 + i))
    settings = DetectionSettings(synthetic=2)
    town = DetectionWork([street(0)], settings, tmp_path / "out", tmp_path).town
    assert [town[i].id for i in range(len(town))] == ["000000", "000001"]


def test_a_pool_and_a_comparison_are_of_one_sensor(tmp_path: Path) -> None:
    write_scan(tmp_path / "pool" / "000000.npz", street(10))
    scan = street(0)
    other = replace(scan, sensor=replace(scan.sensor, name="other", fov_up=5.0))
    settings = DetectionSettings(synthetic=1)
    first, second = (
        DetectionWork([one], settings, tmp_path / "out", tmp_path / "pool")
        for one in (scan, other)
    )
    assert len(first.town) == 1
    with pytest.raises(ConfigError, match="was filled with"):
        _ = second.town
    assert study._identity(first) != study._identity(second)


def test_scans_of_layouts_have_boxes_of_the_towns(tmp_path: Path) -> None:
    settings = DetectionSettings(arms=("layouts",), synthetic=1)
    work = DetectionWork([street(0)], settings, tmp_path / "out", tmp_path / "pool")
    assert work.synthetic(ARMS["real"]) is None
    town = work.synthetic(ARMS["first"])
    drawn = work.synthetic(ARMS["layouts"])
    assert town is not None and drawn is not None and len(drawn) == len(town) == 1
    assert drawn[0].sensor == town[0].sensor
    assert not np.array_equal(drawn[0].points, town[0].points)
    names = [scan[0].boxes.names for scan in (drawn, town)]
    assert names[0] and set(names[0]) <= set(names[1])


class Drives:
    """Eight drives of a scan each, read anew each time; ``most`` is the highest number of scans
    that were in memory at once."""

    def __init__(self) -> None:
        self.ids = [f"p{i}/0" for i in range(8)]
        self.read: list[weakref.ref[Scan]] = []
        self.most = 0

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Scan:
        scan = replace(street(index), id=self.ids[index])
        self.read.append(weakref.ref(scan))
        self.most = max(self.most, sum(one() is not None for one in self.read))
        return scan


def test_tested_scans_are_read_one_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "train", lambda *_: [0.0] * 10)
    source = Drives()
    settings = DetectionSettings(labelled=1, iterations=10)
    work = DetectionWork(source, settings, tmp_path, tmp_path)
    assert len(work.run("real", 0)["found"]) == 4
    assert source.most <= 3  # that to train on, one, and the one before it


def test_a_plan_reads_one_scan_and_the_page_has_the_labelled_scans_of_each_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = Drives()
    source.ids = source.ids[:3]
    settings = DetectionSettings(labelled=100, arms=("real",))
    work = DetectionWork(source, settings, tmp_path, tmp_path)
    assert "3 scans in 3 places" in study.describe(work)
    assert len(source.read) == 1
    empty = {"boxes": [], "scores": [], "classes": []}
    monkeypatch.setattr(
        DetectionWork,
        "run",
        lambda *_: {"found": {str(i): empty for i in range(3)}},
    )
    made = prove_detection(source, tmp_path / "out", settings)
    assert "on the same 1 to 2 real scans with boxes" in describe(made)


def test_scans_without_boxes_are_refused(tmp_path: Path) -> None:
    bare = [
        Scan(s.points, s.reflectance, s.sensor, id=f"p{i}/0")
        for i in range(2)
        for s in [street(i)]
    ]
    with pytest.raises(DataError, match="without boxes"):
        prove_detection(bare, tmp_path)
    with pytest.raises(DataError, match="without boxes"):
        study.describe(DetectionWork(bare, DetectionSettings(), tmp_path, tmp_path))


def test_a_dry_run_says_what_would_be_trained(places: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--labelled", "2", "--arm", "first", "--dry-run", "--out", str(out)]
    result = CliRunner().invoke(
        app, ["prove", str(places), "--task", "detection", *options]
    )
    assert result.exit_code == 0, result.output
    assert "4 scans in 4 places: place0 (1), place1 (1)" in result.output
    assert "4 trainings of 800 iterations of 2:" in result.output
    assert "seed 1: 2 labelled scans, tested on place" in result.output
    assert "the town first, then half, real scans last, GT sampling" in result.output
    assert not out.exists()


def test_a_scan_with_boxes_along_the_way_of_a_car_is_named(
    places: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scan = street(5)
    assert scan.boxes is not None
    trail = Boxes(np.repeat(scan.boxes.values, 2, 0), ("Car",) * 6)
    trail.values[::2, 0] += 1
    write_scan(tmp_path / "trail" / "0.npz", replace(scan, boxes=trail))
    for folder in places.iterdir():
        shutil.copytree(folder, tmp_path / folder.name)
    with pytest.raises(DataError, match="no seed"):
        prove_detection(tmp_path, tmp_path / "out", minutes=0)
    [warning] = caplog.messages
    assert "trail/0: 6 of 6 boxes overlap one of their class" in warning


@pytest.mark.parametrize(
    ("option", "value"),
    [("--only", "car"), ("--model", "none"), ("--classes", "none"), ("--jobs", "2")],
)
def test_options_of_the_other_task_are_refused(
    places: Path, tmp_path: Path, option: str, value: str
) -> None:
    command = ["prove", str(places), "--task", "detection", option, value, "--dry-run"]
    result = CliRunner().invoke(app, [*command, "--out", str(tmp_path)])
    assert isinstance(result.exception, ConfigError)
    message = str(result.exception)
    assert option in message and "Did you mean" not in message
    named = message.partition("options of segmentation: ")[2].split(", ")
    params = get_command(app).commands["prove"].params  # type: ignore[attr-defined]
    marked = [p.opts[0] for p in params if "(segmentation)" in getattr(p, "help", "")]
    assert sorted(named) == sorted(marked)


@pytest.mark.parametrize("task", ["segmentation", "detection"])
def test_scans_that_may_be_skipped_are_not_compared(task: str, places: Path) -> None:
    """A skipped scan would be replaced by one of another place."""
    given = ["--task", task, "--places", "drive", "--on-bad", "skip", "--dry-run"]
    with pytest.raises(ConfigError, match="convert IN OUT --to FORMAT --on-bad skip"):
        app(["prove", str(places), *given], standalone_mode=False)


def test_false_detections_outside_a_range_do_not_count_in_it() -> None:
    wrong = (40.0, 20, 0, 4, 2, 1.5, 0)
    for criterion, expected in ((Criterion(0.5, far=20), 1), (Criterion(0.5), 0.5)):
        judged = judge(found(wrong, CAR), truth(CAR), 0, criterion)
        assert precision_of([judged]) == pytest.approx(expected)


def test_the_road_under_a_box_is_none_of_its_returns() -> None:
    points = np.array([(10, 0, -0.7)] * 5 + [(10, 0, 0)] * 3, np.float32)
    scan = Scan(points, np.zeros(8, np.float32), load_sensor("hdl64e_lasers"))
    assert points_in(Boxes(values(CAR), ("Car",)), scan).tolist() == [3]


def test_eight_places_have_a_wider_interval_than_the_plain_quantiles() -> None:
    """Each seed tests four places, of which one is not better: the quantile at 2.5 % is 16.7."""
    row = compared(True, True, True, False, True, True, True, False)
    assert row["interval"] == (0, 100)
