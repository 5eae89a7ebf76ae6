"""Augmentations: points, labels and boxes stay together, and each is undone by its inverse."""

import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from box_scenes import SENSOR, car, cast, wall
from conftest import random_scan
from hypothesis import given, settings

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.projection import locate
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels import augment
from lidar_synth.labels.augment import (
    Augmentation,
    mirror_scan,
    rotate_scan,
    scale_scan,
)
from lidar_synth.labels.compose import Compose
from lidar_synth.noise import keyed_rng

STEPS: dict[str, Augmentation] = {
    "yaw": augment.yaw,
    "flip_x": partial(augment.flip_x, chance=1),
    "flip_y": partial(augment.flip_y, chance=1),
    "scale": augment.scale,
    "jitter": partial(augment.jitter, spread=0.1, reflectance=0.5),
    "beam_drop": augment.beam_drop,
    "range_drop": augment.range_drop,
}
STEPS["all"] = Compose(list(STEPS.values()))

seeds = st.integers(0, 2**32)


def scan_with_boxes(seed: int, count: int = 3000) -> Scan:
    """Points all around with all fields, and boxes none of whose faces a point is near to."""
    rng = np.random.default_rng(seed)
    scan = random_scan(SENSOR, count, seed)
    scan.ring = (locate(scan.points, SENSOR).cell // 1024).clip(0).astype(np.int16)
    scan.confidence = rng.random(count).astype(np.float32)
    scan.pose = np.eye(4)
    scan.image_path = Path("image.png")
    values = np.c_[
        rng.uniform(-15, 15, (6, 2)),
        rng.uniform(-3, 1, 6),
        rng.uniform(2, 9, (6, 3)),
        rng.uniform(-4, 4, 6),
    ]
    scan.boxes = Boxes(
        values.astype(np.float32),
        ("Car", "Van", "Truck", "Tram", "Misc", "Cyclist"),
        truncation=rng.random(6),
        occlusion=rng.integers(0, 3, 6),
        instance=np.arange(1, 7),
    )
    margin = np.array([0, 0, 0, 2e-3, 2e-3, 2e-3, 0], np.float32)
    wide, tight = (
        Boxes(scan.boxes.values + m, scan.boxes.names) for m in (margin, -margin)
    )
    return scan[(wide.contain(scan.points) == tight.contain(scan.points)).all(0)]


def freeze(scan: Scan) -> Scan:
    for array in (
        scan.points,
        *scan.fields().values(),
        *([] if scan.boxes is None else [scan.boxes.values]),
    ):
        array.setflags(write=False)
    return scan


@pytest.mark.parametrize("name", STEPS)
@settings(max_examples=15)
@given(seed=seeds)
def test_the_generator_alone_decides_and_nothing_given_is_changed(
    name: str, seed: int
) -> None:
    scan = freeze(scan_with_boxes(seed % 50))
    first, again, *others = (
        STEPS[name](scan, keyed_rng(s)) for s in (seed, *range(seed, seed + 6))
    )
    assert (
        first.points.dtype == np.float32
        and first.fields().keys() == scan.fields().keys()
    )
    assert np.array_equal(first.points, again.points)
    for key, values in first.fields().items():
        assert values.dtype == scan.fields()[key].dtype and np.array_equal(
            values, again.fields()[key]
        )
    assert first.boxes is not None and np.array_equal(
        first.boxes.values, again.boxes.values
    )
    assert (first.reflectance >= 0).all() and (first.reflectance <= 1).all()
    assert (np.abs(first.boxes.values[:, 6]) <= np.float32(np.pi)).all() or name in (
        "jitter",
        "beam_drop",
        "range_drop",
    )
    # two may do the same by chance, such as nothing; six do not
    if not name.startswith("flip"):
        assert not all(np.array_equal(first.points, other.points) for other in others)
    copied = pickle.loads(pickle.dumps(STEPS[name]))(scan, keyed_rng(seed))
    assert np.array_equal(copied.points, first.points)


@pytest.mark.parametrize("name", STEPS)
@settings(max_examples=25)
@given(seed=seeds)
def test_boxes_contain_the_same_points(name: str, seed: int) -> None:
    """The confidence, made unique, says which point is which."""
    scan = scan_with_boxes(seed % 50)
    scan.confidence = np.arange(len(scan), dtype=np.float32)
    changed = STEPS[name](scan, keyed_rng(seed))
    assert scan.boxes is not None and changed.boxes is not None
    left = changed.fields()["confidence"].astype(int)
    before = scan.boxes.contain(scan.points)
    after = changed.boxes.contain(changed.points)
    kept = [scan.boxes.names.index(n) for n in changed.boxes.names]
    assert np.array_equal(after, before[kept][:, left])
    gone = np.setdiff1d(np.arange(6), kept)
    # They lost all that they had.
    assert before[gone].any(1).all() and not before[gone][:, left].any()
    for key in ("occlusion", "instance"):
        assert np.array_equal(
            getattr(changed.boxes, key), getattr(scan.boxes, key)[kept]
        )
    for key in ("label", "raw_label", "instance", "ring"):
        assert np.array_equal(changed.fields()[key], scan.fields()[key][left])


@settings(max_examples=25)
@given(seed=seeds, angle=st.floats(-7, 7), factor=st.floats(0.5, 2))
def test_augmentations_can_be_inverted(seed: int, angle: float, factor: float) -> None:
    scan = scan_with_boxes(seed % 50, 300)
    for changed in (
        rotate_scan(rotate_scan(scan, angle), -angle),
        mirror_scan(mirror_scan(scan, "x"), "x"),
        mirror_scan(mirror_scan(scan, "y"), "y"),
        scale_scan(scale_scan(scan, factor), 1 / factor),
        rotate_scan(
            mirror_scan(mirror_scan(scan, "x"), "y"), np.pi
        ),  # both flips are half a turn
    ):
        assert np.allclose(changed.points, scan.points, atol=1e-4)
        assert changed.boxes is not None and scan.boxes is not None
        assert np.allclose(
            changed.boxes.values[:, :6], scan.boxes.values[:, :6], atol=1e-4
        )
        turns = (changed.boxes.values[:, 6] - scan.boxes.values[:, 6]) / (2 * np.pi)
        assert np.allclose(turns, turns.round(), atol=1e-5)


def test_yaws_turn_and_flip_with_their_boxes() -> None:
    scan = cast([car(10, 5, 0.5)])
    for changed, expected in (
        (rotate_scan(scan, np.pi / 2), [-5, 10, 0.5 + np.pi / 2]),
        (rotate_scan(scan, np.pi), [-10, -5, 0.5 - np.pi]),
        (mirror_scan(scan, "y"), [10, -5, -0.5]),
        (mirror_scan(scan, "x"), [-10, 5, np.pi - 0.5]),
        (scale_scan(scan, 2), [20, 10, 0.5]),
    ):
        assert changed.boxes is not None
        assert np.allclose(changed.boxes.values[0, [0, 1, 6]], expected, atol=1e-5)
    assert np.allclose(
        scale_scan(scan, 2).boxes.values[0, 3:6], 2 * scan.boxes.values[0, 3:6]
    )


def test_moving_a_scan_removes_its_camera_image() -> None:
    scan = scan_with_boxes(0)
    for changed in (
        rotate_scan(scan, 1),
        mirror_scan(scan, "x"),
        scale_scan(scan, 1.1),
    ):
        assert (
            changed.pose is None
            and changed.image_path is None
            and changed.boxes is not None
        )
        assert (changed.boxes.truncation == -1).all() and (
            changed.boxes.alpha == -10
        ).all()
    kept = augment.range_drop(scan, keyed_rng(0))
    assert kept.pose is scan.pose and kept.image_path == scan.image_path


def test_without_boxes() -> None:
    scan = replace(scan_with_boxes(1), boxes=None, ring=None)
    changed = STEPS["all"](scan, keyed_rng(0))
    assert (
        changed.boxes is None and changed.ring is None and 0 < len(changed) < len(scan)
    )
    empty = STEPS["all"](scan[:0], keyed_rng(0))
    assert len(empty) == 0


def test_yaw_and_scale_stay_within_their_limits() -> None:
    scan = cast([car(10, 0)])
    turns = [
        augment.yaw(scan, keyed_rng(s), limit=30).boxes.values[0] for s in range(60)
    ]
    angles = np.degrees([np.arctan2(y, x) for x, y, *_ in turns])
    assert 20 < angles.max() <= 30 and -30 <= angles.min() < -20
    sizes = [
        augment.scale(scan, keyed_rng(s), low=0.8, high=0.9).boxes.values[0, 3] / 4.2
        for s in range(60)
    ]
    assert 0.8 <= min(sizes) < 0.82 and 0.88 < max(sizes) <= 0.9


def test_a_flip_happens_as_often_as_it_should() -> None:
    scan = cast([car(10, 3)])
    flipped = [
        augment.flip_y(scan, keyed_rng(s), chance=0.3).boxes.values[0, 1] < 0
        for s in range(200)
    ]
    assert 40 <= sum(flipped) <= 80
    assert augment.flip_x(scan, keyed_rng(0), chance=0) is scan


def test_jitter_is_along_the_ray() -> None:
    scan = cast([], [wall(8, 0, 1.5)])
    noisy = augment.jitter(scan, keyed_rng(0), spread=0.05, reflectance=0)
    before = np.linalg.norm(scan.points, axis=1)
    after = np.linalg.norm(noisy.points, axis=1)
    assert np.allclose(
        noisy.points / after[:, None], scan.points / before[:, None], atol=1e-5
    )
    assert (after - before).std() == pytest.approx(0.05, rel=0.03)
    assert np.abs(after - before).max() < 0.151
    assert np.array_equal(noisy.reflectance, scan.reflectance)


@pytest.mark.slow
@pytest.mark.parametrize("rings", [True, False])
def test_beams_go_as_wholes(rings: bool) -> None:
    scan = cast()
    row = locate(scan.points, SENSOR).cell // 1024
    scan = replace(scan, ring=row[::-1].astype(np.int16).copy()) if rings else scan
    beam = row[::-1] if rings else row
    numbers = []
    for seed in range(40):
        kept = augment.beam_drop(scan, keyed_rng(seed), share=0.25)
        here = np.isin(scan.points.view("V12").ravel(), kept.points.view("V12").ravel())
        dropped = np.setdiff1d(np.arange(64), beam[here])
        assert np.array_equal(here, ~np.isin(beam, dropped))
        numbers.append(len(np.intersect1d(dropped, beam)))
    assert min(numbers) <= 2 and 8 <= max(numbers) <= 16


def test_far_returns_are_lost_more_often() -> None:
    scan = random_scan(SENSOR, 40_000)
    kept = augment.range_drop(
        replace(scan, confidence=np.arange(len(scan), dtype=np.float32)),
        keyed_rng(0),
        0.8,
    )
    distance = np.linalg.norm(scan.points, axis=1)
    here = np.isin(np.arange(len(scan)), kept.fields()["confidence"].astype(int))
    for low, high in ((0, 10), (30, 40), (70, 80)):
        ring = (distance >= low) & (distance < high)
        expected = 1 - 0.8 * np.mean((distance[ring] / 80) ** 2)
        assert here[ring].mean() == pytest.approx(expected, abs=0.03)
    assert len(augment.range_drop(scan, keyed_rng(0), 0)) == len(scan)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (partial(augment.yaw, limit=200), "limit 200"),
        (partial(augment.flip_x, chance=2), "chance 2"),
        (partial(augment.scale, low=0, high=1), "low=0"),
        (partial(augment.scale, low=1.1, high=1), "low=1.1"),
        (partial(augment.jitter, spread=-1), "spread=-1"),
        (partial(augment.beam_drop, share=1.5), "share 1.5"),
        (partial(augment.range_drop, share=-0.1), "share -0.1"),
        (partial(augment.range_drop, power=-1), "power=-1"),
        (lambda scan, rng: mirror_scan(scan, "z"), "axis='z'"),
    ],
)
def test_values_out_of_range_are_refused(step: Augmentation, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        step(cast(), keyed_rng(0))
