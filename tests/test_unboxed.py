"""No detector gets an object without a box: it is counted, and removed with its hole filled, or
refused."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from box_scenes import CAR, car, cast, wall
from mixtures import Endless

from lidar_synth import (
    Boxes,
    KeepLabels,
    MixedScans,
    ObjectBank,
    PasteObjects,
    PolarMix,
    make_policy,
)
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.labels import edit
from lidar_synth.labels.edit.unboxed import HANDLING, clusters
from lidar_synth.labels.objects import LABELS
from lidar_synth.mixing.synthetic import make_synthetic
from lidar_synth.noise import keyed_rng

FIELDS = frozenset({"reflectance", "label", "instance"})
BEHIND = wall(26, 0, np.pi / 2, length=50)
BOTH = cast([car(12, 3), car(10, -5, 0.5)], [BEHIND])
BANK = ObjectBank.from_scans([cast([car(8, 7), car(-9, 5)])])


def with_boxes(scan: Scan, keep: list[int] | None) -> Scan:
    """The scan with some of its boxes, and without instances, as a model would generate it."""
    assert scan.boxes is not None
    boxes = (
        None
        if keep is None
        else Boxes(scan.boxes.values[keep], tuple(scan.boxes.names[i] for i in keep))
    )
    return replace(scan, boxes=boxes, instance=None)


@pytest.mark.parametrize(
    ("keep", "expected"), [([0, 1], 0), ([0], 1), ([], 2), (None, 2)]
)
def test_unboxed_objects_are_counted(keep: list[int] | None, expected: int) -> None:
    scan = with_boxes(BOTH, keep)
    found = edit.measure([scan, scan])
    assert found.scans == 2 and found.objects == 2 * expected
    assert found.points == 2 * (BOTH.label == CAR).sum()
    outside = sum(
        (BOTH.instance == k).sum() for k in (1, 2) if keep is None or k - 1 not in keep
    )
    assert found.share == pytest.approx(outside / (BOTH.label == CAR).sum())


def test_twenty_points_are_an_object() -> None:
    scan = with_boxes(BOTH, [0])
    points = np.flatnonzero(BOTH.instance == 2)
    few = scan[np.setdiff1d(np.arange(len(scan)), points[19:])]
    enough = scan[np.setdiff1d(np.arange(len(scan)), points[20:])]
    assert clusters(few).max() == 0 and clusters(enough).max() == 1


def test_touching_cars_are_one_cluster_and_distant_ones_two() -> None:
    near, far = (with_boxes(cast([car(12, 0), car(12, y)]), []) for y in (2.0, 6.0))
    assert clusters(near).max() == 1 and clusters(far).max() == 2


def test_behind_a_closed_object_is_what_was_there() -> None:
    truth = project(cast([car(12, 3)], [BEHIND]))
    result = edit.remove_unboxed(with_boxes(BOTH, [0]))
    assert edit.measure([result]).objects == 0
    assert (np.abs(project(result).range - truth.range) < 0.3).mean() > 0.997
    assert (result.label == CAR).sum() == (BOTH.instance == 1).sum()


def mixed(scan: Scan, **options: object) -> dict[str, object]:
    """The sample of a synthetic scan in a mixture."""
    train = MixedScans([cast([car(9, 1)])], [scan], ratio=0.5, **options)  # type: ignore[arg-type]
    [position] = [i for i in range(len(train)) if train.domain(i)]
    return train[position]  # type: ignore[no-any-return]


@pytest.mark.parametrize("labels", ["generated", "boxes"])
def test_mixtures_close_unboxed_objects_of_boxed_scans(labels: str) -> None:
    item = mixed(with_boxes(BOTH, [0]), labels=labels)
    assert (item["label"] == CAR).sum() == (BOTH.instance == 1).sum() and len(
        item["boxes"]
    ) == 1  # type: ignore
    kept = mixed(with_boxes(BOTH, [0]), labels=labels, unboxed="keep")
    assert (kept["label"] == CAR).sum() == (BOTH.label == CAR).sum()  # type: ignore[attr-defined]
    with pytest.raises(
        DataError,
        match="with 1 objects without a box; expected a box for every object.*unboxed='close'",
    ):
        mixed(with_boxes(BOTH, [0]), labels=labels, unboxed="error")
    with pytest.raises(
        ConfigError, match="unboxed 'drop'; expected one of 'close', 'keep', 'error'"
    ):
        mixed(with_boxes(BOTH, [0]), unboxed="drop")


def test_low_confidence_does_not_hide_an_object() -> None:
    scan = with_boxes(BOTH, [0])
    scan.confidence = np.where(scan.label == CAR, 0.2, 1).astype(np.float32)
    own = make_policy(
        PasteObjects(BANK, count=1, threshold=0.5), fields=FIELDS | {"confidence"}
    )
    assert BOTH.boxes is not None
    assert not BOTH.boxes.contain(
        own(replace(scan, boxes=None), keyed_rng(0)).points, above_floor=0.4
    ).any()
    item = mixed(scan, labels=KeepLabels(threshold=0.5))
    assert len(item["points"]) > 0  # type: ignore[arg-type]
    points = np.asarray(item["points"])
    near = np.linalg.norm(points[:, :2] - (10, -5), axis=1) < 1.2  # type: ignore[call-overload]
    assert not (points[near, 2] > -1.2).any()  # type: ignore[call-overload]


def test_scans_without_boxes_keep_their_objects() -> None:
    """Segmentation is not changed."""
    item = mixed(with_boxes(BOTH, None), labels="generated")
    assert (item["label"] == CAR).sum() == (BOTH.label == CAR).sum()  # type: ignore[attr-defined]


@pytest.mark.parametrize("made", [PasteObjects(BANK), PolarMix(width=30)])
def test_mixing_hands_out_no_object_without_a_box(made: object) -> None:
    policy = make_policy(made, real=[cast([car(9, 3)])], fields=FIELDS)
    train = MixedScans.wrap(
        [0],
        [with_boxes(BOTH, None)],
        0.5,
        labels=policy,
        to_sample=lambda s, _: s,
        compare=False,
    )
    [scan] = [s for s in (train[i] for i in range(2)) if isinstance(s, Scan)]
    assert scan.boxes is not None and len(scan.boxes) >= 1
    assert (
        edit.measure([scan]).objects
        == 0
        < edit.measure([with_boxes(BOTH, None)]).objects
    )


@pytest.mark.parametrize(("name", "left"), [("Car", 1), ("Pedestrian", 3)])
def test_only_objects_of_the_pasted_classes_are_removed(name: str, left: int) -> None:
    one = cast([car(8, 7)])
    assert one.boxes is not None
    objects = ObjectBank.from_scans([one])
    label = np.full_like(objects.label, LABELS[name])
    names = (name,) * len(objects)
    bank = replace(objects, label=label, boxes=replace(objects.boxes, names=names))
    scan = PasteObjects(bank, 1, clear="same")(with_boxes(BOTH, None), keyed_rng(0))
    assert scan.boxes is None, "a segmenter's scan stays without boxes"
    assert edit.measure([scan]).objects == left
    assert (scan.label == LABELS[name]).any()


def test_scans_with_boxes_and_no_labels_pass() -> None:
    """A detector needs no labels: ``generated`` refuses such scans, ``none`` would drop their
    boxes."""
    bare = replace(BOTH, label=None, instance=None)
    item = mixed(bare, labels="boxes")
    assert len(item["boxes"]) == 2 and len(item["points"]) == len(BOTH)  # type: ignore[arg-type]
    pasted = mixed(bare, labels=PasteObjects(BANK, count=2))
    assert len(pasted["boxes"]) > 2  # type: ignore[arg-type]


def test_a_source_without_boxes_is_refused_for_a_detector() -> None:
    assert (
        "boxes" in make_synthetic([BOTH]).fields
        and "boxes" not in make_synthetic([with_boxes(BOTH, None)]).fields
    )
    with pytest.raises(
        ConfigError,
        match="labels='boxes', but .* only have .*expected scans with boxes",
    ):
        MixedScans([BOTH], [with_boxes(BOTH, None)], labels="boxes")
    with pytest.raises(
        ConfigError, match="labels='boxes', but .*labels='paste' pastes objects"
    ):
        make_policy("boxes", fields=Endless().fields)
    with pytest.raises(
        ConfigError,
        match="neither labels nor boxes.*own objects cannot be found.*clear=False",
    ):
        make_policy("paste", fields=frozenset({"reflectance"}), bank=BANK)


def test_unboxed_objects_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    real = [cast([car(9, 1)])] * 3
    with caplog.at_level(logging.WARNING):
        train = MixedScans(
            real,
            [with_boxes(BOTH, None)] * 3,
            0.5,
            labels={"paste": {"bank": BANK}},
        )
        [train[i] for i in range(len(train))]
        assert (
            caplog.text.count(
                "2.0 objects without a box a scan (100% of the points of their classes)"
            )
            == 1
        )
        caplog.clear()
        train = MixedScans(real, [with_boxes(BOTH, None)] * 3, 0.5, labels="generated")
        [train[i] for i in range(len(train))]
        assert caplog.text.count("real scans have boxes, synthetic ones have none") == 1


def test_handling_is_a_function_of_the_scan() -> None:
    scan = with_boxes(BOTH, [0])
    points = scan.points.copy()
    first = HANDLING["close"](scan)
    second = HANDLING["close"](scan)
    assert np.array_equal(first.points, second.points) and np.array_equal(
        scan.points, points
    )
