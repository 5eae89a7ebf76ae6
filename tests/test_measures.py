"""Measures of classes, ranges, sequences, detections and conditions, by hand and against
independent code."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import random_scan
from scipy.spatial.distance import jensenshannon

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, presets
from lidar_synth.lab.evaluate.conditions import AGREEMENTS, obstacles, sight_agreement
from lidar_synth.lab.evaluate.labels import class_histogram, class_shares
from lidar_synth.lab.evaluate.measures import KINDS
from lidar_synth.lab.evaluate.ranges import range_histogram, step_histogram
from lidar_synth.lab.evaluate.segmentation import load_judge

SENSOR = presets()["hdl64e_kitti360"]
SMALL = Sensor("small", 8, 1.0, 90.0, rows=3, fov_up=5.0, fov_down=-20.0)


def scan_of(points: np.ndarray, **fields: object) -> Scan:
    return Scan(
        np.asarray(points, np.float32),
        np.zeros(len(points), np.float32),
        SENSOR,
        **fields,
    )  # type: ignore[arg-type]


# --- classes
# --------------------------------------------------------------------------------------------------


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
        [random_scan(SENSOR, 2000, seed) for seed in seeds]
        for seeds in (range(5), range(5, 8))
    ]
    dense = [np.stack([by_numpy(s).ravel() for s in side]) for side in scans]
    described = [[class_histogram(s) for s in side] for side in scans]
    jsd, mmd = (
        KINDS[name].compare(*described).value for name in ("class_jsd", "class_mmd")
    )
    assert jsd == pytest.approx(
        jensenshannon(dense[0].sum(0), dense[1].sum(0)), rel=1e-6
    )
    p, q = (h / h.sum(1, keepdims=True) for h in dense)
    kernel = lambda a, b: np.exp(-2 * ((a[:, None] - b) ** 2).sum(-1)).mean()  # noqa: E731
    assert mmd == pytest.approx(
        kernel(p, p) + kernel(q, q) - 2 * kernel(p, q), abs=1e-6
    )
    assert KINDS["class_jsd"].compare(
        described[0], described[0]
    ).value == pytest.approx(0, abs=1e-7)


def test_other_labels_on_the_same_points_are_another_scene() -> None:
    scans = [random_scan(SENSOR, 2000, seed) for seed in range(3)]
    swapped = [
        replace(s, label=np.where(s.label == 8, 12, s.label).astype(np.uint8))
        for s in scans
    ]
    both = [[class_histogram(s) for s in side] for side in (scans, swapped)]
    assert KINDS["class_jsd"].compare(*both).value > 0.1


def test_class_shares_sum_to_one_in_each_ring_that_has_labels() -> None:
    points = [(2, 0, 0), (2, 1, 0), (0, 50, 0), (0, 51, 0)]
    shares = class_shares(
        scan_of(points, label=np.array([8, 12, 8, IGNORE], np.uint8))
    ).reshape(16, 19)
    assert (
        shares[0, 8] == shares[0, 12] == 0.5
        and shares[14, 8] == 1
        and shares.sum() == 2
    )


@pytest.mark.parametrize("describe", [class_histogram, class_shares])
def test_classes_need_labels(describe: object) -> None:
    with pytest.raises(
        DataError, match="scan 'bare' without labels; expected labelled scans"
    ):
        describe(scan_of([(9, 0, 0)], id="bare"))  # type: ignore[operator]


def test_a_scan_of_ignored_points_is_refused() -> None:
    with pytest.raises(DataError, match="no labelled return from 3 m to 70 m"):
        class_histogram(scan_of([(9, 0, 0)], label=np.array([IGNORE], np.uint8)))


# --- ranges
# --------------------------------------------------------------------------------------------------


def test_ranges_and_steps_by_hand() -> None:
    image = np.zeros((3, 8), np.float32)
    image[0, 0], image[0, 7], image[0, 2] = (
        10.0,
        12.0,
        20.0,
    )  # columns 0 and 7 are neighbours
    image[1, 0] = 10.5
    scan = unproject(RangeImage(image, SMALL))
    ranges = range_histogram(scan)
    assert (
        ranges.sum() == 4
        and ranges[24] == 1
        and ranges[40] == 1
        and ranges[19:22].sum() == 2
    )
    across, down = step_histogram(scan)
    assert (across.sum(), down.sum()) == (1, 1)  # 2 m across, 0.5 m down
    assert np.flatnonzero(across) == [1 + 33] and np.flatnonzero(down) == [1 + 26]
    for measure in (range_histogram, step_histogram):
        with pytest.raises(DataError, match="without"):
            measure(unproject(RangeImage(np.zeros((3, 8), np.float32), SMALL)))


# --- conditions
# --------------------------------------------------------------------------------------------------


def test_agreement_with_the_own_condition_is_greater_than_with_another() -> None:
    scans = [random_scan(SENSOR, 3000, seed) for seed in range(3)]
    own, other = (
        sight_agreement(scans, some) for some in (scans, scans[1:] + scans[:1])
    )
    assert own.value == 1 > other.value > 0
    judge = load_judge()
    name, agreement = AGREEMENTS["camera"]
    assert agreement(scans, scans, judge) == 1 and "camera" in name
    assert 0 <= AGREEMENTS["semantic"][1](scans, scans, judge) <= 1
    with pytest.raises(
        DataError,
        match="3 generated and 2 real scans; expected one real scan per generated one",
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
