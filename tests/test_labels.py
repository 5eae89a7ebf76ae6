"""Label policies: each on the town's scans, whose labels and boxes are exact, and on real ones."""

import pickle
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scenes import CAR, ROAD, SENSOR, car, cast, wall

from lidar_synth import LaserMix, PasteObjects, PolarMix
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import KITTI360, KITTIObject, SemanticKITTI
from lidar_synth.geometry.projection import locate, project, unproject
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Boxes, Scan, Source
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.town import Town
from lidar_synth.labels import (
    POLICIES,
    ObjectBank,
    make_policy,
    swap_bands,
    swap_sector,
    thin_scan,
)
from lidar_synth.noise import keyed_rng

FIELDS = frozenset({"reflectance", "label", "confidence"})


def teacher(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Road below, building above; sure of what is near."""
    label = np.where(scan.points[:, 2] < -1.5, ROAD, 12)
    return label, 1 / (1 + np.abs(scan.points[:, 0]) / 10)


CALLS: dict[str, dict[str, Any]] = {
    "none": {},
    "ignore": {},
    "generated": {"threshold": 0.5},
    "condition": {},
    "pseudo": {"teacher": teacher},
    "paste": {"count": 6, "turn": 180.0},
    "polarmix": {},
    "polarmix_or_lasermix": {},
    "lasermix": {},
    "boxes": {},
}


@pytest.fixture(scope="module")
def real() -> list[Scan]:
    """Labelled scans in the place of real ones."""
    town = Town(2, scans=60)
    return [replace(town[i], domain=REAL) for i in (3, 44)]


@pytest.fixture(scope="module")
def synthetic() -> Scan:
    """What a model gives: one return per cell at its centre, label and confidence, no boxes."""
    scan = unproject(project(Town(5, scans=30)[21], channels=["reflectance", "label"]))
    confidence = keyed_rng(1).random(len(scan)).astype(np.float32)
    return replace(scan, confidence=confidence, id="model/0/7", domain=SYNTHETIC)


def arrays(scan: Scan) -> dict[str, np.ndarray]:
    """All that a scan holds."""
    held = {"points": scan.points, **scan.fields()}
    if scan.boxes is not None:
        held |= {f.name: np.asarray(getattr(scan.boxes, f.name)) for f in fields(Boxes)}
    return held


def same(a: Scan, b: Scan) -> bool:
    """Bit for bit."""
    left = arrays(a)
    right = arrays(b)
    return left.keys() == right.keys() and all(
        np.array_equal(left[n], right[n]) for n in left
    )


MIXES = ("paste", "polarmix", "lasermix", "polarmix_or_lasermix")
"""Policies that insert parts of real scans."""


def test_every_policy_is_called_here() -> None:
    assert set(CALLS) == set(POLICIES)


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_a_policy_is_a_function_of_scan_and_generator(
    name: str, synthetic: Scan, real: list[Scan]
) -> None:
    known = FIELDS
    if name == "boxes":
        synthetic = replace(synthetic, boxes=real[0].boxes)
        known = FIELDS | {"boxes"}
    before = [{n: a.copy() for n, a in arrays(s).items()} for s in (synthetic, *real)]
    policy = make_policy(name, real=real, fields=known, **CALLS[name])
    first = policy(synthetic, keyed_rng(4, 1))
    again = policy(synthetic, keyed_rng(4, 1))
    # As spawned workers get it.
    copied = pickle.loads(pickle.dumps(policy))(synthetic, keyed_rng(4, 1))
    assert same(first, again) and same(first, copied)
    other = policy(synthetic, keyed_rng(4, 2))
    assert same(first, other) == (name not in MIXES)
    for scan, held in zip((synthetic, *real), before, strict=True):
        assert all(np.array_equal(a, held[n]) for n, a in arrays(scan).items())
    assert (first.domain, first.id, first.sensor) == (
        SYNTHETIC,
        "model/0/7",
        synthetic.sensor,
    )
    assert first.fields().keys() == other.fields().keys()
    assert (first.boxes is None) == (other.boxes is None)
    for field_name, values in first.fields().items():
        assert values.dtype == {"label": np.uint8, "instance": np.int32}.get(
            field_name, np.float32
        )
    if first.label is not None:
        assert first.confidence is not None
        assert ((first.label < 19) | (first.label == IGNORE)).all()
        assert (first.confidence >= 0).all() and (first.confidence <= 1).all()


def test_none_and_ignore_leave_no_label(synthetic: Scan) -> None:
    scan = replace(
        synthetic,
        boxes=cast([car(9, 0)]).boxes,
        instance=np.ones(len(synthetic), np.int32),
    )
    none = make_policy("none")(scan, keyed_rng(0))
    assert none.fields().keys() == {"reflectance"} and none.boxes is None
    ignored = make_policy("ignore")(scan, keyed_rng(0))
    assert (
        ignored.label is not None
        and ignored.confidence is not None
        and ignored.boxes is None
    )
    assert (ignored.label == IGNORE).all() and (ignored.confidence == 0).all()


def test_generated_labels_need_confidence(synthetic: Scan) -> None:
    assert synthetic.label is not None and synthetic.confidence is not None
    kept = make_policy("generated", fields=FIELDS)(synthetic, keyed_rng(0))
    assert np.array_equal(kept.label, synthetic.label) and np.array_equal(
        kept.confidence, synthetic.confidence
    )
    sure = make_policy("generated", fields=FIELDS, threshold=0.7)(
        synthetic, keyed_rng(0)
    )
    assert np.array_equal(
        sure.label, np.where(synthetic.confidence >= 0.7, synthetic.label, IGNORE)
    )
    plain = make_policy("generated", fields=frozenset({"label"}))(
        replace(synthetic, confidence=None), keyed_rng(0)
    )
    assert np.array_equal(
        plain.confidence, (synthetic.label != IGNORE).astype(np.float32)
    )


def test_labels_of_a_condition_are_certain(synthetic: Scan) -> None:
    scan = make_policy("condition", fields=FIELDS)(synthetic, keyed_rng(0))
    assert np.array_equal(scan.label, synthetic.label)
    assert np.array_equal(
        scan.confidence, (synthetic.label != IGNORE).astype(np.float32)
    )


def test_a_files_own_labels_never_outlive_a_policy(real: list[Scan]) -> None:
    for name, options in (
        ("generated", {}),
        ("condition", {}),
        ("ignore", {}),
        ("none", {}),
    ):
        assert (
            make_policy(name, fields=FIELDS, **options)(real[0], keyed_rng(0)).raw_label
            is None
        )


def test_pseudo_labels_are_the_teachers_where_it_is_sure(synthetic: Scan) -> None:
    label, confidence = teacher(synthetic)
    scan = make_policy("pseudo", teacher=teacher, threshold=0.6)(
        synthetic, keyed_rng(0)
    )
    assert np.array_equal(
        scan.label, np.where(confidence.astype(np.float32) >= 0.6, label, IGNORE)
    )
    assert scan.confidence is not None and np.allclose(scan.confidence, confidence)

    def whole(scan: Scan) -> Scan:
        return replace(scan, label=np.full(len(scan), ROAD, np.uint8), confidence=None)

    certain = make_policy("pseudo", teacher=whole)(synthetic, keyed_rng(0))
    assert (certain.label == ROAD).all() and (certain.confidence == 1).all()


@pytest.mark.parametrize(
    "answer",
    [
        lambda s: None,
        lambda s: replace(s, label=None),
        lambda s: (np.zeros(len(s), int),),
        lambda s: (np.zeros(len(s) - 1, int), None),
        lambda s: (np.full(len(s), 19), None),
        lambda s: (np.full(len(s), -1), None),
        lambda s: (np.zeros(len(s), int), np.full(len(s), 1.5)),
        lambda s: (np.zeros(len(s), int), np.full(len(s), np.nan)),
        lambda s: (np.zeros(len(s), int), np.ones(3)),
    ],
)
def test_a_teacher_that_answers_nonsense_is_refused(
    answer: Callable[[Scan], Any], synthetic: Scan
) -> None:
    with pytest.raises(DataError, match="the teacher's"):
        make_policy("pseudo", teacher=answer)(synthetic, keyed_rng(0))


def test_a_sector_is_the_others_and_the_rest_is_kept() -> None:
    ours = cast([], [wall(20, 0, 1.5, 60)])
    theirs = cast([], [wall(-10, 8, 0.3, 30)])
    theirs = replace(theirs, reflectance=theirs.reflectance + np.float32(0.01))
    for start, width in ((100, 300), (900, 400), (0, 1024), (5, 0)):
        mixed = swap_sector(ours, theirs, start, width)
        inside = np.zeros(1024, bool)
        inside[(start + np.arange(width)) % 1024] = True
        a = project(ours)
        b = project(theirs)
        got = project(mixed)
        for name in ("range", "label", "reflectance"):
            values = [
                i.range if name == "range" else i.channels[name] for i in (a, b, got)
            ]
            assert np.allclose(
                values[2], np.where(inside, values[1], values[0]), atol=1e-4
            )
        assert len(mixed) == got.mask.sum() and mixed.domain == SYNTHETIC


def test_objects_that_the_edge_of_a_sector_cuts_leave() -> None:
    ours = cast([car(0, 10), car(10, 0.5), car(12, -12)])
    theirs = cast([car(0, -9), car(10, 0, np.pi / 2), car(-8, -5)])
    # The right half is theirs; the edges are straight ahead and behind.
    mixed = swap_sector(ours, theirs, 512, 512)
    assert (
        mixed.boxes is not None
        and mixed.instance is not None
        and mixed.label is not None
    )
    assert np.allclose(mixed.boxes.values[:, :2], [[0, 10], [0, -9], [-8, -5]])
    assert mixed.boxes.instance.tolist() == [1, 2, 3]
    for box, instance in zip(mixed.boxes.values, mixed.boxes.instance, strict=True):
        grown = Boxes(
            box + np.array([0, 0, 0, 0.01, 0.01, 0.01, 0], np.float32), ("Car",)
        )
        own = mixed.instance == instance
        assert own.any() and np.array_equal(
            grown.contain(mixed.points)[0] & (mixed.label == CAR), own
        )
    assert ((mixed.label == CAR) == (mixed.instance > 0)).all()
    cars = mixed.points[mixed.label == CAR]
    assert not (
        (cars[:, 0] > 5) & (abs(cars[:, 1]) < 3)
    ).any()  # nor is half a car left


def test_boxes_of_two_scans_never_share_a_place() -> None:
    ours = cast([car(3, 10.0)])
    theirs = cast([car(-3, 10.2)])
    edge = int(locate(np.array([[0, 10, 0]], np.float32), SENSOR).cell[0] % 1024)
    mixed = swap_sector(ours, theirs, edge - 512, 512)
    assert mixed.boxes is not None and len(mixed.boxes) == 2
    ours.boxes.values[0, 3] = theirs.boxes.values[0, 3] = (
        7  # overlapping boxes, each with its own returns
    )
    mixed = swap_sector(ours, theirs, edge - 512, 512)
    assert mixed.boxes is not None and mixed.boxes.values[:, 0].tolist() == [3]
    assert mixed.instance.max() == 1


def test_boxes_hold_all_returns_of_their_objects(real: list[Scan]) -> None:
    """The town's boxes are tight and its sensor noisy: a few returns of each scan lie outside by
    centimetres."""
    ours, theirs = real
    tight = [
        (s.boxes[[i]], s.instance == s.boxes.instance[i])
        for s in real
        for i in range(len(s.boxes))
    ]
    points = [*[ours.points] * len(ours.boxes), *[theirs.points] * len(theirs.boxes)]
    assert (
        sum(
            (own & ~box.contain(p)[0]).sum()
            for (box, own), p in zip(tight, points, strict=True)
        )
        > 20
    )
    for start in range(0, 1024, 128):
        mixed = swap_sector(ours, theirs, start, 512)
        assert mixed.boxes is not None and len(mixed.boxes)
        for number, instance in enumerate(mixed.boxes.instance):
            assert (
                mixed.boxes[[number]]
                .contain(mixed.points[mixed.instance == instance])
                .all()
            )
    before = {tuple(v[[0, 1, 2, 6]]): v[3:6] for s in real for v in s.boxes.values}
    for value in mixed.boxes.values:
        assert (value[3:6] - before[tuple(value[[0, 1, 2, 6]])] >= 0).all()
        assert (value[3:6] - before[tuple(value[[0, 1, 2, 6]])] < 0.3).all(), (
            "no more than noise on either side"
        )


def test_bands_alternate_from_top_to_bottom() -> None:
    ours = cast([car(9, 2)])
    theirs = cast([], [wall(8, 0, 1.5, 30)])
    for bands, odd in ((2, False), (3, True), (6, False), (64, True)):
        mixed = swap_bands(ours, theirs, bands, odd)
        mine = (np.arange(64) * bands // 64) % 2 == odd
        expected = np.where(mine[:, None], project(ours).range, project(theirs).range)
        assert np.allclose(project(mixed).range, expected, atol=1e-4)
        assert mixed.boxes is None and mixed.instance is not None


def test_a_partner_is_thinned_to_the_grid() -> None:
    scan = Town(1, scans=1)[0]
    thin = thin_scan(scan, SENSOR)
    assert len(thin) == project(scan).mask.sum() < len(scan)
    assert np.array_equal(project(thin).range, project(scan).range)
    with pytest.raises(
        DataError, match="returns of sensor 'town' for a scan of 'os1_128'"
    ):
        thin_scan(scan, presets()["os1_128"])


def test_a_partner_of_other_lasers_lends_no_rings() -> None:
    host = Town(1, scans=1)[0]
    other = Town(1, "os1_128", scans=1)[0]
    assert thin_scan(other, host.sensor).ring is None
    assert (
        thin_scan(host, replace(host.sensor, name="fewer", columns=512)).ring
        is not None
    )
    mixed = swap_sector(host, thin_scan(other, host.sensor), 0, 512)
    assert mixed.ring.max() < 64


def test_one_device_on_two_grids_keeps_its_rings() -> None:
    lasers = Town(1, "hdl64e_lasers", scans=1)[0]
    thinned = thin_scan(lasers, presets()["hdl64e_semantic_kitti"])
    assert thinned.ring is not None
    assert set(thinned.ring) <= set(lasers.ring)


def test_mixed_in_labels_are_certain_and_the_rest_keeps_its_own(
    synthetic: Scan, real: list[Scan]
) -> None:
    policy = make_policy(LaserMix(bands=[4], threshold=0.5), real=real, fields=FIELDS)
    mixed = policy(synthetic, keyed_rng(3))
    own = np.isin(
        mixed.points.view("V12").ravel(), synthetic.points.view("V12").ravel()
    )
    assert (
        mixed.confidence is not None
        and mixed.label is not None
        and 0.2 < own.mean() < 0.8
    )
    assert (mixed.confidence[~own] == (mixed.label[~own] != IGNORE)).all()
    assert ((mixed.confidence[own] >= 0.5) | (mixed.label[own] == IGNORE)).all()
    unlabelled = replace(synthetic, label=None, confidence=None)
    policy = make_policy("lasermix", real=real, fields=frozenset({"reflectance"}))
    mixed = policy(unlabelled, keyed_rng(3))
    own = np.isin(
        mixed.points.view("V12").ravel(), synthetic.points.view("V12").ravel()
    )
    assert (mixed.label[own] == IGNORE).all() and (
        mixed.label[~own] != IGNORE
    ).mean() > 0.9


def test_polar_turns_objects_about_the_sensor() -> None:
    real = [cast([car(9, 0), car(14, -6)])]
    policy = make_policy(PolarMix(width=0), real=real, fields=FIELDS)
    mixed = policy(cast(), keyed_rng(1))
    assert mixed.boxes is not None
    assert np.allclose(
        np.hypot(*mixed.boxes.values[:, :2].T), [9, np.hypot(14, 6)], atol=1e-3
    )
    assert abs(np.arctan2(*mixed.boxes.values[0, 1::-1])) > 0.05
    bare = [replace(real[0], boxes=None)]
    mixed = make_policy({"PolarMix": {"WIDTH": 0}}, real=bare, fields=FIELDS)(
        cast(), keyed_rng(1)
    )
    assert (mixed.label == CAR).sum() > 500 and mixed.boxes is None


def test_objects_by_name_and_in_place_of_the_scans_own() -> None:
    scan = cast([car(8, 6), car(-9, 5)])
    scan.boxes = Boxes(scan.boxes.values, ("Car", "Van"), instance=scan.boxes.instance)
    bank = ObjectBank.from_scans([scan])
    host = replace(cast([car(20, 0)]), boxes=None)
    mixed = make_policy(
        PasteObjects(bank, count={"Van": 3}, clear=False), fields=FIELDS
    )(host, keyed_rng(0))
    assert mixed.boxes is not None and mixed.boxes.names == ("Van",)
    assert (mixed.label == CAR).sum() == (host.label == CAR).sum() + bank.counts[1]
    clear = make_policy(PasteObjects(bank), fields=FIELDS)(host, keyed_rng(0))
    assert clear.boxes is not None and sorted(clear.boxes.names) == ["Car", "Van"]
    assert clear.boxes.contain(clear.points[clear.label == CAR]).any(0).all()


def refusals() -> list[tuple[str, dict[str, Any], str]]:
    """Policies that these sources cannot serve, and what the error says."""
    bare = [replace(cast(), label=None, boxes=None)]
    labelled = [replace(cast(), boxes=None, instance=None)]
    plain = frozenset({"reflectance"})
    return [
        (
            "generated",
            {"fields": plain},
            "labels='generated', but .* the synthetic scans only have.*Use labels='none'",
        ),
        (
            "generated",
            {"fields": frozenset({"label"}), "threshold": 0.5},
            "without confidence",
        ),
        (
            "generated",
            {"threshold": 1.5},
            "threshold 1.5; expected a number from 0 to 1",
        ),
        (
            "condition",
            {"fields": plain},
            "labels='condition', but .* the synthetic scans only have",
        ),
        (
            "pseudo",
            {},
            "missing a required argument: 'teacher'; expected arguments teacher, threshold",
        ),
        ("pseudo", {"teacher": teacher, "threshold": -1}, "threshold -1"),
        (
            "none",
            {"threshold": 0.5},
            "labels='none'.*'threshold'; expected no arguments",
        ),
        (
            "generated",
            {"treshold": 0.5},
            "'treshold'; expected arguments threshold. Did you mean 'threshold'",
        ),
        ("pseudo", {"teacher": 3}, "teacher=3; expected a function"),
        (
            "paste",
            {"count": "many"},
            "count 'many'; expected a whole number, 1 or more",
        ),
        ("paste", {"turn": "far"}, "turn 'far'; expected a number from 0 to 180"),
        ("polarmix", {"width": None}, "width None; expected a number from 0 to 360"),
        ("lasermix", {"bands": 4}, "bands 4; expected numbers of bands"),
        ("polermix", {}, "Did you mean 'polarmix'"),
        ("best", {}, "labels='best'; expected one of 'none', 'ignore'"),
        ("paste", {}, "without real scans to take objects from. bank= gives .*town"),
        (
            "paste",
            {"real": bare},
            "no box with 5 points in 1 scans.*ObjectBank.from_scans",
        ),
        (
            "paste",
            {"real": [cast([car(8, 2)])], "count": {"Tram": 1}},
            "names and points",
        ),
        ("paste", {"real": [cast([car(8, 2)])], "count": 0}, "count 0"),
        ("paste", {"real": [cast([car(8, 2)])], "clear": "all"}, "clear='all'"),
        (
            "paste",
            {"real": [cast([car(8, 2)])], "fields": plain},
            "neither labels nor boxes.*clear=False",
        ),
        (
            "polarmix",
            {"real": bare},
            "PolarMix with real scans without labels",
        ),
        (
            "lasermix",
            {"real": []},
            r"LaserMix with no real scans.*LaserMix\(real=scans\)",
        ),
        ("lasermix", {}, r"LaserMix with no real scans.*LaserMix\(real=scans\)"),
        ("polarmix", {"real": labelled}, "neither boxes nor instances"),
        ("polarmix", {"real": labelled, "width": 400}, "width 400"),
        (
            "lasermix",
            {"real": labelled, "bands": [1]},
            "bands 1; expected a whole number, 2 or more",
        ),
    ]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    refusals(),
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_policies_that_the_sources_cannot_support_are_refused(
    name: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_policy(name, **({"fields": FIELDS} | options))


def test_scans_that_break_their_promise_are_refused(synthetic: Scan) -> None:
    with pytest.raises(DataError, match="'model/0/7' has no labels"):
        make_policy("generated", fields=FIELDS)(
            replace(synthetic, label=None), keyed_rng(0)
        )
    real = [cast(), replace(cast(id="second"), label=None)]
    policy = make_policy("lasermix", real=real, fields=FIELDS)
    with pytest.raises(DataError, match="scan 'second' has no labels"):
        for seed in range(9):
            policy(synthetic, keyed_rng(seed))


def test_a_policy_of_ones_own_is_taken_as_it_is(synthetic: Scan) -> None:
    def own(scan: Scan, rng: np.random.Generator) -> Scan:
        return scan

    assert make_policy(own) is own
    with pytest.raises(ConfigError, match="a policy that is an object"):
        make_policy(own, threshold=0.5)


@pytest.mark.parametrize("name", MIXES)
def test_mixed_scans_lose_their_times(
    name: str, synthetic: Scan, real: list[Scan]
) -> None:
    """PandaSet's scans have times; those of two scans count from different moments."""
    timed = [
        replace(scan, time=np.linspace(0, 0.1, len(scan), dtype=np.float32))
        for scan in (synthetic, *real)
    ]
    policy = make_policy(name, real=timed[1:], fields=FIELDS | {"time"})
    mixed = policy(timed[0], keyed_rng(4, 1))
    assert mixed.time is None and len(mixed) != len(synthetic)


@pytest.mark.slow
@pytest.mark.parametrize("name", MIXES)
def test_real_scans_as_the_labelled_side(
    name: str, real_scans: Path, synthetic: Scan
) -> None:
    source: Source = SemanticKITTI(real_scans / "semantic_kitti", split="train")
    if name == "paste":
        source = KITTIObject(real_scans / "kitti_object")
    # Else the scan's own objects leave holes, which are filled.
    options = {"clear": False} if name == "paste" else {}
    policy = make_policy(name, real=source, fields=FIELDS, **options)
    for seed in range(3):
        mixed = policy(synthetic, keyed_rng(seed))
        assert (
            mixed.domain == SYNTHETIC
            and mixed.label is not None
            and mixed.confidence is not None
        )
        own = np.isin(
            mixed.points.view("V12").ravel(), synthetic.points.view("V12").ravel()
        )
        assert (~own).sum() > (50 if name == "paste" else 5000) and own.sum() > 5000
        assert (mixed.confidence[~own & (mixed.label != IGNORE)] == 1).all()
        cells = locate(mixed.points, mixed.sensor).cell
        assert (
            np.bincount(cells[cells >= 0]) <= 1
        ).all()  # as the model's own scans: one return per cell
        assert (mixed.boxes is not None) == (name == "paste")


@pytest.mark.parametrize("name", MIXES)
def test_real_scans_that_cannot_serve(name: str, real_scans: Path) -> None:
    source = (
        KITTI360(real_scans / "kitti360")
        if name == "paste"
        else KITTIObject(real_scans / "kitti_object")
    )
    named = "labels='paste'" if name == "paste" else POLICIES[name].split(".")[1]
    with pytest.raises(ConfigError, match=f"{named}.* with"):
        make_policy(name, real=source, fields=FIELDS)
