"""Measures of classes, ranges, sequences, detections and conditions, by hand and against
independent code."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import random_scan
from scipy.spatial.distance import jensenshannon

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, presets
from lidar_synth.lab.evaluate.conditions import AGREEMENTS, obstacles, sight_agreement
from lidar_synth.lab.evaluate.detection import detect
from lidar_synth.lab.evaluate.labels import class_histogram, class_shares
from lidar_synth.lab.evaluate.measures import KINDS
from lidar_synth.lab.evaluate.ranges import range_histogram, step_histogram
from lidar_synth.lab.evaluate.segmentation import load_judge
from lidar_synth.lab.evaluate.sequences import chamfer_error, register, registration_error

SENSOR = presets()["hdl64e_kitti360"]
SMALL = Sensor("small", 8, 1.0, 90.0, rows=3, fov_up=5.0, fov_down=-20.0)


def scan_of(points: np.ndarray, **fields: object) -> Scan:
    return Scan(np.asarray(points, np.float32), np.zeros(len(points), np.float32), SENSOR, **fields)  # type: ignore[arg-type]


# --- classes
# ------------------------------------------------------------------------------------------------------


def by_numpy(scan: Scan) -> np.ndarray:
    """(19, 100, 100) by numpy's histograms, one per class."""
    distance = np.linalg.norm(scan.points, axis=1)
    bounds = [(-80, 80), (-80, 80)]
    inside = (distance > 3) & (distance < 70)
    chosen = [scan.points[inside & (scan.label == c), :2] for c in range(19)]
    return np.stack([np.histogramdd(p, 100, bounds)[0] for p in chosen])


def test_class_histograms_are_numpys() -> None:
    scan = random_scan(SENSOR, 4000)
    found = class_histogram(scan)
    dense = np.zeros(19 * 100 * 100)
    dense[found.bins] = found.amounts
    assert np.array_equal(dense.reshape(19, 100, 100), by_numpy(scan))


def test_the_distances_by_class_are_those_of_float64_definitions() -> None:
    scans = [
        [random_scan(SENSOR, 2000, seed) for seed in seeds] for seeds in (range(5), range(5, 8))
    ]
    dense = [np.stack([by_numpy(s).ravel() for s in side]) for side in scans]
    described = [[class_histogram(s) for s in side] for side in scans]
    jsd, mmd = (KINDS[name].compare(*described, {}).value for name in ("class_jsd", "class_mmd"))
    assert jsd == pytest.approx(jensenshannon(dense[0].sum(0), dense[1].sum(0)), rel=1e-6)
    p, q = (h / h.sum(1, keepdims=True) for h in dense)
    kernel = lambda a, b: np.exp(-2 * ((a[:, None] - b) ** 2).sum(-1)).mean()  # noqa: E731
    assert mmd == pytest.approx(kernel(p, p) + kernel(q, q) - 2 * kernel(p, q), abs=1e-6)
    assert KINDS["class_jsd"].compare(described[0], described[0], {}).value == pytest.approx(
        0, abs=1e-7
    )


def test_other_labels_on_the_same_points_are_another_scene() -> None:
    scans = [random_scan(SENSOR, 2000, seed) for seed in range(3)]
    swapped = [
        replace(s, label=np.where(s.label == 8, 12, s.label).astype(np.uint8)) for s in scans
    ]
    both = [[class_histogram(s) for s in side] for side in (scans, swapped)]
    assert KINDS["class_jsd"].compare(*both, {}).value > 0.1


def test_class_shares_sum_to_one_in_each_ring_that_has_labels() -> None:
    points = [(2, 0, 0), (2, 1, 0), (0, 50, 0), (0, 51, 0)]
    shares = class_shares(scan_of(points, label=np.array([8, 12, 8, IGNORE], np.uint8))).reshape(
        16, 19
    )
    assert shares[0, 8] == shares[0, 12] == 0.5 and shares[14, 8] == 1 and shares.sum() == 2


@pytest.mark.parametrize("describe", [class_histogram, class_shares])
def test_classes_need_labels(describe: object) -> None:
    with pytest.raises(DataError, match="scan 'bare' without labels; expected labelled scans"):
        describe(scan_of([(9, 0, 0)], id="bare"))  # type: ignore[operator]


def test_a_scan_of_ignored_points_is_refused() -> None:
    with pytest.raises(DataError, match="no labelled return from 3 m to 70 m"):
        class_histogram(scan_of([(9, 0, 0)], label=np.array([IGNORE], np.uint8)))


# --- ranges
# -------------------------------------------------------------------------------------------------------


def test_ranges_and_steps_by_hand() -> None:
    image = np.zeros((3, 8), np.float32)
    image[0, 0], image[0, 7], image[0, 2] = 10.0, 12.0, 20.0  # columns 0 and 7 are neighbours
    image[1, 0] = 10.5
    scan = unproject(RangeImage(image, SMALL))
    ranges = range_histogram(scan)
    assert ranges.sum() == 4 and ranges[24] == 1 and ranges[40] == 1 and ranges[19:22].sum() == 2
    across, down = step_histogram(scan)
    assert (across.sum(), down.sum()) == (1, 1)  # 2 m across, 0.5 m down
    assert np.flatnonzero(across) == [1 + 33] and np.flatnonzero(down) == [1 + 26]
    for measure in (range_histogram, step_histogram):
        with pytest.raises(DataError, match="without"):
            measure(unproject(RangeImage(np.zeros((3, 8), np.float32), SMALL)))


# --- sequences
# ----------------------------------------------------------------------------------------------------


def drive(count: int = 5, step: float = 0.4) -> list[Scan]:
    """A street seen from a sensor that turns a little and moves ``step`` metres ahead per frame."""
    street = np.random.default_rng(0).uniform((-30, -15, -2), (30, 15, 3), (4000, 3))
    scans = []
    for i in range(count):
        pose = np.eye(4)
        turn = 0.01 * i
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        pose[0, 3] = step * i
        scans.append(scan_of((street - pose[:3, 3]) @ pose[:3, :3], pose=pose, id=f"frame {i}"))
    return scans


def test_a_sequence_that_moves_as_its_poses_say_has_no_error() -> None:
    scans = drive()
    assert registration_error(scans, 1) == pytest.approx(0, abs=1e-3)
    assert chamfer_error(scans, 1) == pytest.approx(0, abs=1e-9)


def test_a_sequence_that_moves_otherwise_has_an_error() -> None:
    scans = drive()
    standing = [replace(s, pose=np.eye(4)) for s in scans]
    assert registration_error(standing, 1) == pytest.approx(
        0.4 / 3, abs=5e-3
    )  # of three coordinates, one is wrong
    near, far = (chamfer_error(standing, n) for n in (1, 4))
    assert 0 < near < far
    jumping = [
        scan_of(s.points + np.float32([0.3 * (i % 2), 0, 0]), pose=s.pose)
        for i, s in enumerate(scans)
    ]
    assert registration_error(jumping, 1) > 0.09 and registration_error(jumping, 2) < 0.01


def test_registration_finds_a_turn() -> None:
    street = drive(1)[0].points.astype(np.float64)
    turn = np.radians(3)
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    found = register(street, street @ rotation.T + (0.2, -0.1, 0.05))
    assert np.allclose(found[:3, :3], rotation, atol=1e-4) and np.allclose(
        found[:3, 3], (0.2, -0.1, 0.05), atol=1e-3
    )


def test_sequences_refuse_what_they_cannot_compare() -> None:
    scans = drive(3)
    with pytest.raises(DataError, match="3 scans, compared 3 frames apart; expected more than 3"):
        registration_error(scans, 3)
    with pytest.raises(DataError, match="scan 'frame 0' without a pose"):
        chamfer_error([replace(s, pose=None) for s in scans])
    with pytest.raises(ConfigError, match="0 frames apart"):
        chamfer_error(scans, 0)
    with pytest.raises(DataError, match="0 of 4000 points match within 2 m"):
        register(scans[0].points.astype(np.float64), scans[0].points + 500.0)


# --- detections
# ---------------------------------------------------------------------------------------------------


def boxes(*places: tuple[float, float], name: str = "Car") -> Boxes:
    values = np.array([(x, y, 0, 4, 2, 1.5, 0) for x, y in places], np.float32).reshape(-1, 7)
    return Boxes(values, (name,) * len(values))


def test_detections_by_hand() -> None:
    """Confidences 0.9 (hit), 0.8 (none near), 0.7 (hit): precision 1, then 2/3, at recalls 1/2 and
    1."""
    scan = scan_of([(9, 0, 0)], boxes=boxes((10, 0), (20, 0)))
    found = boxes((10.2, 0), (40, 0), (20, 0.3)), np.array([0.9, 0.8, 0.7])
    result = detect(lambda s: found, [scan], distances=(0.5,))
    assert result.precision == {"Car": pytest.approx((1 + 2 / 3) / 2)} and result.boxes == {
        "Car": 2
    }
    assert (
        result.confidence == {"Car": pytest.approx(0.8)}
        and result.mean_precision == result.precision["Car"]
    )
    strict = detect(lambda s: found, [scan], distances=(0.1,))
    assert strict.precision == {"Car": 0.0}


def test_a_box_is_found_once_and_by_its_class() -> None:
    scan = scan_of([(9, 0, 0)], boxes=boxes((10, 0)))
    twice = detect(lambda s: (boxes((10, 0), (10, 0)), np.array([0.5, 0.6])), [scan])
    assert twice.precision == {"Car": 1.0}  # the second one comes after full recall
    other = detect(lambda s: (boxes((10, 0), name="Van"), np.array([0.5])), [scan])
    assert other.precision == {"Car": 0.0} and other.confidence == {"Van": 0.5}
    nothing = detect(lambda s: (boxes(), np.zeros(0)), [scan])
    assert nothing.precision == {"Car": 0.0} and nothing.confidence == {}


def test_detections_refuse_what_they_cannot_score() -> None:
    scan = scan_of([(9, 0, 0)], boxes=boxes((10, 0)), id="one")
    with pytest.raises(DataError, match="without boxes"):
        detect(lambda s: (boxes(), np.zeros(0)), [scan_of([(9, 0, 0)])])
    for confidence in (np.zeros(2), np.array([1.5]), np.array([np.nan])):
        with pytest.raises(
            DataError,
            match=r"scan 'one': 1 boxes with confidences .* one confidence in \[0, 1\] per box",
        ):
            detect(lambda s, c=confidence: (boxes((1, 1)), c), [scan])
    with pytest.raises(ConfigError, match="positive metres"):
        detect(lambda s: (boxes(), np.zeros(0)), [scan], distances=())


# --- conditions
# ---------------------------------------------------------------------------------------------------


def test_agreement_with_the_own_condition_is_greater_than_with_another() -> None:
    scans = [random_scan(SENSOR, 3000, seed) for seed in range(3)]
    own, other = (sight_agreement(scans, some) for some in (scans, scans[1:] + scans[:1]))
    assert own.value == 1 > other.value > 0
    judge = load_judge()
    name, agreement = AGREEMENTS["camera"]
    assert agreement(scans, scans, judge) == 1 and "camera" in name
    assert 0 <= AGREEMENTS["semantic"][1](scans, scans, judge) <= 1
    with pytest.raises(
        DataError, match="3 generated and 2 real scans; expected one real scan per generated one"
    ):
        sight_agreement(scans, scans[:2])


def test_obstacles_are_ahead_and_above_the_ground() -> None:
    seen = obstacles(
        scan_of(
            [
                (10.5, 2.5, 0),
                (10.5, 2.7, 1),
                (10.5, -3.5, -1.7),
                (-10, 0, 0),
                (1, 20, 0),
                (50, 0, 0),
            ]
        )
    )
    assert [tuple(i) for i in np.argwhere(seen)] == [(10, 42)]
