"""The detector of the trial: its overlaps, its score, its targets; and a trial from scans to
table."""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from project import ROOT

sys.path.append(str(ROOT / "tools" / "research"))

from streets import street

from lidar_synth import Boxes, Scan, load_sensor
from lidar_synth.lab.proof.detection.bev import (
    CELL,
    CHANNELS,
    REACH,
    SLICES,
    Found,
    decode,
    targets,
    view,
)
from lidar_synth.lab.proof.detection.scores import (
    Truth,
    average_precision,
    footprint_ious,
    matched,
    precisions,
)

pytestmark = pytest.mark.usefixtures("one_thread")

SQUARE = (0, 0, 0, 1, 1, 1, 0)
OVERLAPS = {
    "the same box": (SQUARE, SQUARE, 1),
    "another height": (SQUARE, (0, 0, 5, 1, 1, 3, 0), 1),
    "half a side apart": (SQUARE, (0.5, 0, 0, 1, 1, 1, 0), 1 / 3),
    "turned by 45 degrees": (SQUARE, (0, 0, 0, 1, 1, 1, np.pi / 4), np.sqrt(0.5)),
    "backwards": ((3, 4, 0, 4, 2, 1, 0.3), (3, 4, 0, 4, 2, 1, 0.3 - np.pi), 1),
    "length and width exchanged": (
        (3, 4, 0, 4, 2, 1, 0.3),
        (3, 4, 0, 2, 4, 1, 0.3),
        1 / 3,
    ),
    "one in the other": ((0, 0, 0, 4, 2, 1, 1), (0.2, 0.1, 0, 1, 1, 1, 2), 1 / 8),
    "apart": (SQUARE, (1.1, 0, 0, 1, 1, 1, 0), 0),
    "apart, but not their circles": ((0, 0, 0, 4, 1, 1, 0), (0, 1.5, 0, 4, 1, 1, 0), 0),
    "with a common side": (SQUARE, (1, 0, 0, 1, 1, 1, 0), 0),
}


def boxes(*rows: tuple[float, ...]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 7)


@pytest.mark.parametrize("case", OVERLAPS)
def test_overlaps_of_known_boxes(case: str) -> None:
    a, b, expected = OVERLAPS[case]
    for turn in (0, 0.7):  # both about the sensor
        pair = boxes(a, b)
        c = np.cos(turn)
        s = np.sin(turn)
        pair[:, :2] = pair[:, :2] @ np.array([[c, s], [-s, c]], np.float32)
        pair[:, 6] += turn
        assert footprint_ious(pair, pair) == pytest.approx(
            np.array([[1, expected], [expected, 1]]), abs=1e-5
        )


def test_overlaps_of_random_boxes_agree_with_sampled_points() -> None:
    rng = np.random.default_rng(0)
    pair = np.c_[
        rng.uniform(-1, 1, (8, 3)), rng.uniform(1, 4, (8, 3)), rng.uniform(-4, 4, 8)
    ].astype(np.float32)
    points = rng.uniform(-4, 4, (100_000, 3)).astype(np.float32)
    points[:, 2] = 0
    flat = pair.copy()
    flat[:, 2] = 0
    flat[:, 5] = 1
    inside = Boxes(flat, ("Car",) * 8).contain(points).astype(float)
    common = inside @ inside.T
    either = inside.sum(1)[:, None] + inside.sum(1) - common
    assert footprint_ious(pair, pair) == pytest.approx(common / either, abs=0.02)


PRECISIONS = {
    "all found": ([0.9, 0.8], [1, 1], 2, 1),
    "a wrong one between": ([0.9, 0.8, 0.7], [1, 0, 1], 2, 0.5 * 1 + 0.5 * 2 / 3),
    "in another order": ([0.7, 0.9, 0.8], [1, 1, 0], 2, 0.5 * 1 + 0.5 * 2 / 3),
    "one never found": ([0.9, 0.8, 0.7], [1, 0, 1], 3, (1 + 2 / 3) / 3),
    "a wrong one first, precision interpolated": ([0.9, 0.8, 0.7], [0, 1, 1], 2, 2 / 3),
    "nothing detected": ([], [], 3, 0),
}


@pytest.mark.parametrize("case", PRECISIONS)
def test_average_precision_as_computed_by_hand(case: str) -> None:
    scores, hits, wanted, expected = PRECISIONS[case]
    assert average_precision(
        np.array(scores), np.array(hits, int), wanted
    ) == pytest.approx(expected)


def test_a_class_without_boxes_has_no_precision() -> None:
    assert np.isnan(average_precision(np.zeros(0), np.zeros(0, int), 0))


def test_each_box_is_found_once_and_unwanted_boxes_do_not_count() -> None:
    car = (10, 0, 0, 4, 2, 1, 0)
    hidden = (30, 0, 0, 4, 2, 1, 0)
    found = boxes(car, (10.2, 0, 0, 4, 2, 1, 0), hidden, hidden, (50, 0, 0, 4, 2, 1, 0))
    scores = np.array([0.5, 0.9, 0.8, 0.7, 0.6])
    fit = footprint_ious(found, boxes(car, hidden)) / 0.5
    right = matched(fit, scores, np.array([True, False]))
    assert right.tolist() == [0, 1, -1, -1, 0]


def test_precisions_are_by_class_and_over_all_scans() -> None:
    car = (10, 0, 0, 4, 2, 1, 0)
    walker = (5, 5, 0, 0.6, 0.6, 1.7, 0)
    truth = Truth(boxes(car, walker), np.array([0, 1]), np.array([True, True]))
    both = Found(boxes(car, walker), np.array([0.5, 0.5]), np.array([0, 1]))
    exchanged = Found(boxes(car, walker), np.array([0.9, 0.4]), np.array([1, 1]))
    assert precisions([both, both], [truth, truth])[:2] == [1, 1]
    assert precisions([both, exchanged], [truth, truth])[:2] == pytest.approx(
        [0.5, 2 / 3]
    )


@pytest.mark.parametrize("pixel", [0.4, 0.8])
def test_targets_decode_to_their_boxes(pixel: float) -> None:
    rng = np.random.default_rng(1)
    count = 30
    grid = np.stack(
        np.meshgrid(np.arange(-40, 41, 10), np.arange(-40, 41, 10)), -1
    ).reshape(-1, 2)
    places = grid[rng.permutation(len(grid))[:count]] + rng.uniform(-3, 3, (count, 2))
    sizes = rng.uniform(0.4, 5, (count, 3))
    yaw = rng.uniform(-np.pi, np.pi, count)
    given = np.c_[places, rng.uniform(-2, 0, count), sizes, yaw].astype(np.float32)
    classes = rng.integers(0, 3, count)
    outside = boxes((REACH + 1, 0, 0, 4, 2, 1, 0))
    target = targets(np.concatenate([given, outside]), np.r_[classes, 0], pixel)
    found = decode(target.heat, target.values, least=0.99)
    assert len(found.boxes) == count
    nearest = np.hypot(
        *(found.boxes[:, None, :2] - given[None, :, :2]).transpose(2, 0, 1)
    ).argmin(1)
    assert sorted(nearest) == list(range(count))
    assert np.array_equal(found.classes, classes[nearest])
    assert found.boxes[:, :6] == pytest.approx(given[nearest, :6], abs=1e-3)
    assert np.abs(np.sin(found.boxes[:, 6] - given[nearest, 6])) == pytest.approx(
        np.zeros(count), abs=1e-3
    )


def test_pixels_beside_a_centre_name_the_same_centre() -> None:
    box = boxes((7.3, -3.1, -1, 4, 2, 1.5, 0.4))
    target = targets(box, np.array([0]), 0.8)
    known = torch.nonzero(target.weight > 0)
    assert len(known) == 9
    centres = (
        known + 0.5 + torch.stack([target.values[:2, i, j] for i, j in known])
    ) * 0.8 - REACH
    assert centres.numpy() == pytest.approx(np.repeat(box[:, :2], 9, 0), abs=1e-4)


def test_a_view_has_each_return_in_its_pixel() -> None:
    points = np.array(
        [(10.05, -3.25, -1.5), (10.05, -3.25, 0.4), (REACH, 0, 0), (0, 0, 9)],
        np.float32,
    )
    seen = view(points, np.full(4, 0.5, np.float32)).numpy()
    assert seen.shape == (256, 256, CHANNELS)
    i = int((10.05 + REACH) / CELL)
    j = int((-3.25 + REACH) / CELL)
    pixel = seen[i // 2, j // 2].reshape(2, 2, SLICES + 2)[i % 2, j % 2]
    # 2.5 and 4.4 m above the lowest slice's bottom.
    assert np.flatnonzero(pixel[:SLICES]).tolist() == [
        8,
        14,
    ]
    assert pixel[SLICES] == 127 and pixel[SLICES + 1] == int(40 * np.log2(3))
    assert np.count_nonzero(seen) == 4  # the returns outside the view are nowhere


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    import detector_trial

    for name, value in {
        "LABELLED": 1,
        "TESTED": 1,
        "TEST_TOWNS": (8,),
    }.items():
        monkeypatch.setattr(detector_trial, name, value)
    monkeypatch.setattr(detector_trial.pools, "FRAMES", (4,))
    return detector_trial


@pytest.mark.slow
def test_a_trial_from_scans_to_table(
    trial: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trial.main(tmp_path, ["gt_sampling"], seeds=1, iterations=2)
    [result] = (tmp_path / "runs-2").iterdir()
    assert (
        result.name == "gt_sampling-0.json"
        and len(json.loads(result.read_text())["ap"]) == 3
    )
    assert "| GT sampling |" in capsys.readouterr().out
    monkeypatch.setattr(trial, "run", None)  # a second run trains nothing
    trial.main(tmp_path, ["gt_sampling"], seeds=1, iterations=2)
    assert "| GT sampling |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arm", "shares"),
    [("town_first", [8] * 30 + [4] * 8 + [0] * 2), ("layout_gt", [4] * 2)],
)
def test_synthetic_scans_come_first_or_in_half_of_each_batch(
    trial: ModuleType, arm: str, shares: list[int]
) -> None:
    labelled = [street(i) for i in range(2)]
    pool = [street(10 + i) for i in range(2)]
    mixed = trial.mixture(trial.ARMS[arm], labelled, pool, 0, 8)
    found = []
    for epoch in range(len(shares)):
        mixed.set_epoch(epoch)
        found.append(sum(mixed.domain(i) for i in range(len(mixed))))
    assert found == shares


def test_layout_arms_need_a_model(trial: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--layout-model"):
        trial.main(tmp_path, ["layout"])


def test_the_table_has_means_spreads_and_paired_differences(trial: ModuleType) -> None:
    text = trial.report(
        {
            "gt_sampling": {0: [0.5, 0.2, 0.2], 1: [0.7, 0.4, 0.4]},
            "real": {0: [0.4, 0.1, 0.1]},
        }
    )
    rows = text.splitlines()
    assert (
        rows[2]
        == "| GT sampling | 60.0 ± 14.1 | 30.0 ± 14.1 | 30.0 ± 14.1 | 40.0 ± 14.1 | - | 2 |"
    )
    assert rows[3] == "| labelled scans only | 40.0 | 10.0 | 10.0 | 20.0 | -10.0 | 1 |"


def test_boxes_with_few_returns_or_outside_the_view_are_not_wanted() -> None:
    near, few, far, truck = ((x, 0, 0, 4, 2, 2, 0) for x in (10, 20, 60, 30))
    inside = np.random.default_rng(0).uniform(-0.8, 0.8, (9, 3)).astype(np.float32)
    points = [inside + np.float32([x, 0, 0]) for x in (10, 60, 30)] + [
        inside[:4] + np.float32([20, 0, 0])
    ]
    given = Boxes(boxes(near, truck, few, far), ("Van", "Truck", "Car", "Car"))
    scan = Scan(
        np.concatenate(points),
        np.zeros(31, np.float32),
        load_sensor("hdl64e_lasers"),
        boxes=given,
    )
    truth = Truth.of(scan)
    assert truth.boxes[:, 0].tolist() == [10, 20, 60]
    assert truth.wanted.tolist() == [True, False, False]
