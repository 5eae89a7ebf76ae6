"""The parts of ``prove``: places, arms, scores and intervals, the plan, a trainer as a command, the
page."""

import re
import shlex
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import yaml
from conftest import random_scan
from proofs import SENSOR, Scans, drives, job
from streets import street

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.errors import (
    ConfigError,
    DataError,
    FileError,
    LidarSynthError,
    ProcessError,
)
from lidar_synth.geometry.projection import project
from lidar_synth.lab.evaluate.segmentation import class_ious
from lidar_synth.lab.evaluate.segmenter import CircularConv, _Wrapped
from lidar_synth.lab.proof import ARMS, CommandTrainer, ProofSettings, planning
from lidar_synth.lab.proof.arms import Row, options_of, policy_of, rows
from lidar_synth.lab.proof.budget import estimate_minutes, within
from lidar_synth.lab.proof.command import describe
from lidar_synth.lab.proof.drawing import ticks
from lidar_synth.lab.proof.machine import machine
from lidar_synth.lab.proof.places import APART, SPLITS, choose, find_places
from lidar_synth.lab.proof.plan import describe as describe_plan
from lidar_synth.lab.proof.planning import make_plan
from lidar_synth.lab.proof.pools import read_pool
from lidar_synth.lab.proof.scores import (
    FEWEST_PLACES,
    GROUPS,
    group_ious,
    groups_of,
    interval,
    require_labels,
)
from lidar_synth.lab.proof.trial import reference, run_trainer, turn_scan
from lidar_synth.lab.town import Town
from lidar_synth.labels.edit.unboxed import join_cubes
from lidar_synth.labels.exchange import thin_scan
from lidar_synth.noise import keyed_rng


def test_a_figure_tells_the_device_that_was_used() -> None:
    assert ", no GPU used, torch" in machine("cpu")
    assert ", mps, torch" in machine("mps")


def test_wrapped_padding_is_circular_padding() -> None:
    x = torch.randn(2, 3, 4, 6, dtype=torch.float64, requires_grad=True)
    assert torch.equal(_Wrapped.apply(x), F.pad(x, (1, 1, 0, 0), mode="circular"))
    assert torch.autograd.gradcheck(_Wrapped.apply, (x,))
    layer = CircularConv(3, 2).double().eval()
    assert torch.allclose(layer(x).roll(2, -1), layer(x.roll(2, -1)))


SOURCES = {
    "drive": drives(3, 4),
    "pose": Scans(
        [f"00/{i:06d}" for i in range(9)], [0, 10, 40, 500, 510, 540, 900, 950, 960]
    ),
    "stretch": Scans([f"00/{i:06d}" for i in range(16)]),
}
"""A source for every split."""


@pytest.mark.parametrize("by", SPLITS)
def test_a_split_has_places_without_a_scan_in_common(by: str) -> None:
    places = find_places(SOURCES[by], by)
    members = [i for part in places.values() for i in part]
    assert (
        len(places) == 3
        and len(set(members)) == len(members)
        and set(members) <= set(range(len(SOURCES[by])))
    )


def test_places_by_pose_are_apart_from_each_other() -> None:
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 1500, (200, 3)) * (1, 1, 0) + 2e7
    cluster = join_cubes(positions, APART)
    distance = np.linalg.norm(positions[:, None, :2] - positions[None, :, :2], axis=-1)
    assert cluster.max() > 10
    assert distance[cluster[:, None] != cluster[None]].min() >= APART


def test_between_stretches_scans_are_left_out() -> None:
    places = find_places(Scans([f"002/{i:02d}" for i in range(39)]), "stretch:2")
    assert [len(p) for p in places.values()] == [15, 15]
    assert list(places.values()) == [list(range(15)), list(range(24, 39))]


def test_every_scan_of_a_long_source_is_of_a_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lidar_synth.lab.proof.places.MOST_POSES", 4)
    assert find_places(SOURCES["pose"], "pose") == {
        "00, place 1": [0, 1, 2, 3],
        "00, place 2": [4, 5],
        "00, place 3": [6, 7, 8],
    }


def test_auto_takes_drives_and_else_poses() -> None:
    assert find_places(SOURCES["drive"]) == find_places(SOURCES["drive"], "drive")
    assert find_places(SOURCES["pose"]) == find_places(SOURCES["pose"], "pose")


def test_drives_of_nuscenes_are_its_logs() -> None:
    names = [f"n{log}-2018__LIDAR_TOP__{i}" for log in ("008", "015") for i in (1, 2)]
    assert find_places(Scans(names)) == {"n008-2018": [0, 1], "n015-2018": [2, 3]}


def test_places_of_shuffled_frames_are_their_drives(
    caplog: pytest.LogCaptureFixture,
) -> None:
    source = drives(2, 2)
    source.drives = ("b", "a", "a", "b")
    assert find_places(source) == {"a": [1, 2], "b": [0, 3]}
    source.drives = None
    source.ids = [f"training/{i}" for i in range(4)]
    with pytest.raises(DataError, match=r"mapping/ of the devkit"):
        find_places(source)
    assert not caplog.messages
    assert len(find_places(source, "stretch:2")) == 2
    assert "a comparison is too good" in caplog.text


@pytest.mark.parametrize("count", [1, 2, 5, None])
def test_labelled_scans_come_from_many_places(count: int | None) -> None:
    places = find_places(drives(3, 5))
    picked = choose(places, count, np.random.default_rng(0))
    per_place = Counter(
        next(name for name, part in places.items() if i in part) for i in picked
    )
    assert len(picked) == (count or 15)
    assert (
        max(per_place.values())
        - (min(per_place.values()) if len(per_place) == 3 else 0)
        <= 1
    )


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_trains_for_its_iterations_with_its_shares(
    name: str, tmp_path: Path
) -> None:
    ratio = 0.5 if ARMS[name].ratio is None else None
    task = job(name, tmp_path, 21, ratio)
    for few in range(10, 21):
        counts = [count for _, count in replace(task, iterations=few).stages()]
        assert min(counts) > 0 and sum(counts) == few
    mixtures = list(task.mixtures(collate="range"))
    assert sum(count for _, count in mixtures) == task.iterations
    assert sum(stage.share for stage in task.row.stages()) == pytest.approx(1)
    for (stage, _), (mixed, count) in zip(task.stages(), mixtures, strict=True):
        domains = [mixed.domain(i) for i in range(len(mixed))]
        assert len(domains) == count * task.batch
        assert abs(sum(domains) - stage.ratio * len(domains)) < 1
    batch = mixtures[-1][0].collate([mixtures[-1][0][i] for i in range(task.batch)])
    assert (batch["label"] != 255).any()


@pytest.mark.parametrize("name", ["pretrain", "recipe"])
def test_the_reference_trainer_learns_and_repeats_itself(
    name: str, tmp_path: Path, one_thread: None
) -> None:
    task = job(name, tmp_path, iterations=20)
    [first] = reference(task).values()
    [second] = reference(task).values()
    assert np.array_equal(first.table, second.table)
    assert first.losses[-1] < first.losses[0]
    steps = [step for step, _ in first.curve]
    assert (
        steps == sorted(set(steps))
        and steps[-1] == 20
        and np.array_equal(first.curve[-1][1], first.table)
    )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_trains_as_the_processor_does(tmp_path: Path) -> None:
    here = job("pretrain-generator", tmp_path)
    there = replace(here, device="cuda", half=False)
    losses = [reference(one)["left out"].losses for one in (here, there)]
    assert np.allclose(*losses, rtol=0.05)


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match="device 'cuda:99'; expected an available"):
        make_plan(drives(), SMALL, None, 1, device="cuda:99")


def test_the_learning_rate_has_one_cycle_over_all_stages(
    tmp_path: Path, one_thread: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    cycle = torch.optim.lr_scheduler.OneCycleLR

    def record(
        *given: object, **options: object
    ) -> torch.optim.lr_scheduler.OneCycleLR:
        made.append(cycle(*given, **options))  # type: ignore[arg-type]
        return made[-1]

    monkeypatch.setattr(torch.optim.lr_scheduler, "OneCycleLR", record)
    task = job("pretrain", tmp_path, iterations=20)
    assert len(list(task.stages())) == 3
    reference(task)
    [schedule] = made
    assert schedule.total_steps == 20 and schedule.last_epoch == 20


def test_the_first_stage_does_not_depend_on_the_labelled_scans(
    tmp_path: Path, one_thread: None
) -> None:
    task = job("pretrain", tmp_path, iterations=20)
    other = replace(task, real=task.real[::-1])
    [some] = reference(task).values()
    [others] = reference(other).values()
    assert some.losses[:7] == others.losses[:7]  # of 14 iterations
    assert some.losses[8:] != others.losses[8:]


def test_turning_keeps_every_return_in_a_cell() -> None:
    scan = thin_scan(random_scan(SENSOR, 20_000), SENSOR)
    cells = np.count_nonzero(project(scan).range)
    for seed in range(5):
        kept = np.count_nonzero(
            project(turn_scan(scan, np.random.default_rng(seed))).range
        )
        assert abs(kept - cells) <= 0.001 * cells


@pytest.mark.parametrize("classes", GROUPS)
def test_groups_name_classes_once(classes: str) -> None:
    members = [m for part in GROUPS[classes].values() for m in part]
    assert len(set(members)) == len(members) and set(members) <= set(NAMES)


def test_iou_of_single_classes_is_that_of_the_table() -> None:
    table = np.random.default_rng(0).integers(0, 50, (19, 19))
    table[3] = 0
    ours = group_ious(table, GROUPS["semantic_kitti"])
    theirs = class_ious(table)
    assert np.isnan(ours[3]) and np.allclose(np.delete(ours, 3), np.delete(theirs, 3))


def test_pooled_classes_forgive_confusions_within_a_pool_and_no_others() -> None:
    table = np.zeros((19, 19), np.int64)
    table[TRAIN_ID["car"], TRAIN_ID["truck"]] = 10  # within "vehicle"
    table[TRAIN_ID["road"], TRAIN_ID["pole"]] = 5  # a prediction of no pool
    table[TRAIN_ID["road"], TRAIN_ID["road"]] = 5
    table[TRAIN_ID["pole"], TRAIN_ID["road"]] = 7  # a label of no pool does not count
    ious = dict(
        zip(GROUPS["pandaset"], group_ious(table, GROUPS["pandaset"]), strict=True)
    )
    assert ious["vehicle"] == 1 and ious["road"] == 0.5 and np.isnan(ious["building"])


@pytest.mark.parametrize(
    ("places", "seeds", "between", "within"),
    [(6, 1, 1, 1), (7, 2, 1, 1), (7, 2, 1, 0.1)],
)
def test_intervals_hold_the_truth_as_often_as_they_say(
    places: int, seeds: int, between: float, within: float
) -> None:
    rng = np.random.default_rng(0)
    held = 0
    count = 400
    for trial in range(count):
        d = (
            2
            + rng.normal(0, between, (places, 1))
            + rng.normal(0, within, (places, seeds))
        )
        low, high = interval(d, seed=trial, draws=800)  # type: ignore[misc]
        held += low <= 2 <= high
    assert 0.91 <= held / count <= 0.99


def test_intervals_hold_the_truth_where_one_training_is_tested_in_all_places() -> None:
    """What a seed adds is then the same in all places."""
    rng = np.random.default_rng(0)
    held = 0
    count = 400
    for trial in range(count):
        d = 2 + rng.normal(0, 1, (8, 1)) + rng.normal(0, 1, (1, 5))
        low, high = interval(d, seed=trial, draws=800, shared=True)  # type: ignore[misc]
        held += low <= 2 <= high
    assert 0.91 <= held / count <= 0.99


def test_too_few_places_have_no_interval_and_missing_seeds_do_not_count() -> None:
    d = np.random.default_rng(0).normal(size=(FEWEST_PLACES, 2))
    assert interval(d[1:]) is None
    d[0, 1] = np.nan
    for shared in (False, True):
        low, high = interval(d, shared=shared)  # type: ignore[misc]
        assert low < np.nanmean(d) < high


def test_ticks_are_round_and_few() -> None:
    assert (
        ticks(-3.2, 7.9) == [-2.0, 0.0, 2.0, 4.0, 6.0] and 3 <= len(ticks(0, 533)) <= 8
    )


SMALL = ProofSettings(
    arms=("real", "town"),
    iterations=10,
    batch=2,
    seeds=2,
    columns=64,
    widths=(4, 8),
    tested=2,
)


def test_a_plan_is_paired_and_tests_on_places_left_out() -> None:
    source = drives(4, 5)
    plan, scans = make_plan(source, SMALL, None, 1)
    assert len(plan.pairs) == plan.wanted == 8 and [row.key for row in plan.rows] == [
        "real",
        "town-50",
    ]
    for (place, _), indices in plan.labelled.items():
        assert not set(indices) & set(plan.places[place]) and {
            *indices,
            *plan.tested[place],
        } <= set(scans)
        assert not set(plan.skin_scans(place)) & set(plan.places[place])
    assert all(scan.sensor.columns == 64 for scan in scans.values())


def test_drives_without_labels_are_left_out(caplog: pytest.LogCaptureFixture) -> None:
    source = drives(3, 4)
    source[8:] = [replace(scan, label=None, raw_label=None) for scan in source[8:]]
    plan, _ = make_plan(source, SMALL, None, 1)
    assert list(plan.places) == ["00", "01"] and "without labels: 02" in caplog.text
    plan, _ = make_plan(source, SMALL, None, 1, tests=drives(1, 2, first=20))
    assert max(i for part in plan.labelled.values() for i in part) < 8
    source[4:8] = [replace(scan, label=None, raw_label=None) for scan in source[4:8]]
    with pytest.raises(DataError, match=r"of one place \(00\).*--places stretch"):
        make_plan(source, SMALL, None, 1)


def test_scans_of_other_pairs_are_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "measure_step", lambda *given: (False, 60.0))
    source = drives(6, 4)
    settings = replace(SMALL, labelled=2)
    plan, scans = make_plan(source, settings, 21 * 1.3 * 3, 1)
    assert len(plan.pairs) < plan.wanted and len(scans) < len(source)
    needed = {i for p in plan.pairs for i in (*plan.labelled[p], *plan.tested[p[0]])}
    assert scans.keys() == needed


def test_a_plan_says_how_many_labelled_scans_each_training_gets() -> None:
    names = [f"00/{frame:06d}" for frame in range(6)]
    source = Scans([*names, "01/000000", "02/000000"])
    plan, _ = make_plan(source, SMALL, None, 1)
    assert "each training gets 2 to 7 labelled scans" in describe_plan(plan)
    arms = ("pretrain", "pretrain-generator", "recipe")
    plan, _ = make_plan(source, replace(SMALL, labelled=1, arms=arms), None, 1)
    said = describe_plan(plan)
    assert "each training gets 1 labelled scan and" in said
    assert said.count("constants") == 1 and "constants" in said.splitlines()[-1]
    assert "  pretrain-generator  " in said


def test_scans_of_other_places_are_tested_by_one_training_for_each_seed() -> None:
    source = drives(1, 5)
    tests = drives(3, 2, first=20)
    plan, scans = make_plan(source, SMALL, None, 1, tests=tests)
    assert len(plan.trainings(plan.pairs)) == 2 and len(plan.pairs) == 6
    assert all(max(indices) < len(source) for indices in plan.labelled.values())
    assert plan.tested == {"00": [5, 6], "01": [7, 8], "02": [9, 10]}
    assert scans[7].id == tests[2].id and plan.skin_scans("00") == list(range(5))
    assert "all tested places" in describe_plan(plan)
    for minutes, seeds in ((1.4, 1), (1.5, 2)):
        short = within(replace(plan, step=0.2), minutes)
        assert short.pairs == plan.pairs[: 3 * seeds] and short.minutes <= minutes


def test_tests_that_are_trained_on_or_of_another_sensor_are_refused() -> None:
    source = drives(2, 3)
    with pytest.raises(ConfigError, match="tests that are labelled scans too: scan"):
        make_plan(source, SMALL, None, 1, tests=drives(1, 4))
    other = drives(1, 4, first=20)
    other[:] = [replace(s, sensor=replace(s.sensor, name="other")) for s in other]
    with pytest.raises(ConfigError, match="tests of sensor 'other'"):
        make_plan(source, SMALL, None, 1, tests=other)


def test_a_trainer_gives_a_table_for_every_tested_place(tmp_path: Path) -> None:
    task = replace(job("real", tmp_path), held_out={"a": [], "b": []})
    with pytest.raises(DataError, match="results of 'a'; expected one of each"):
        run_trainer(lambda job: np.zeros((19, 19)), task)


def test_a_plan_keeps_to_its_minutes_by_whole_pairs_and_places_come_before_seeds() -> (
    None
):
    whole, _ = make_plan(drives(4, 5), replace(SMALL, iterations=100), None, 1)
    plan = replace(whole, step=6.0)
    minutes = estimate_minutes(plan, plan.pairs[:3]) + 0.01
    short = within(plan, minutes)
    assert short.pairs == plan.pairs[:3] and short.minutes <= minutes
    assert {seed for _, seed in plan.pairs[:4]} == {0}
    few = estimate_minutes(plan, plan.pairs[:1]) + 0.01
    fewer = within(plan, few)
    assert fewer.pairs == plan.pairs[:2] and fewer.minutes <= few
    assert 10 <= fewer.settings.iterations < plan.settings.iterations
    resumed = within(plan, few, resumed=True)
    assert resumed.pairs == plan.pairs[:2] and resumed.settings == plan.settings
    with pytest.raises(ConfigError, match=r"fewer arms \(--arm\)\.$") as error:
        within(plan, 0.001)
    [least] = re.findall(r"about (\d+) or more", str(error.value))
    assert within(plan, int(least)).settings.iterations < 20


def scans_with(**changes: object) -> Scans:
    source = drives(3, 4)
    source[5] = replace(source[5], **changes)  # type: ignore[arg-type]
    return source


BAD = {
    "one place": (Scans([f"00/{i}" for i in range(6)]), {}, "6 scans of one place"),
    "too few for stretches": (
        Scans(["00/0", "00/1"]),
        {"places": "stretch"},
        "2 scans of drives too short to cut.*sequences or scans",
    ),
    "one cluster of poses": (
        Scans([f"00/{i}" for i in range(4)], [0, 1, 2, 3]),
        {},
        "--places stretch",
    ),
    "no poses": (drives(), {"places": "pose"}, "without a pose"),
    "an unknown split": (
        drives(),
        {"places": "street"},
        "places by 'street'; expected one of auto, drive",
    ),
    "no number of stretches": (drives(), {"places": "drive:2"}, "places by 'drive:2'"),
    "more labelled than there are": (
        drives(),
        {"labelled": 9},
        "9 labelled scans; expected 1 to 8",
    ),
    "an unknown class": (
        drives(),
        {"only": ("tram",)},
        "class of semantic_kitti 'tram'",
    ),
    "a class that is nowhere": (
        drives(),
        {"only": ("road", "bicyclist")},
        "class bicyclist, which no label",
    ),
    "unknown pooled classes": (
        drives(),
        {"classes": "waymo"},
        "classes 'waymo'; expected one of",
    ),
    "no labels": (scans_with(label=None, raw_label=None), {}, "without labels"),
    "labels of another table": (
        scans_with(label=np.full(len(drives()[5]), 41, np.uint8), raw_label=None),
        {},
        r"with labels \[41\]",
    ),
}
"""{what is wrong: source, settings, message}."""


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_with_what_to_do(case: str) -> None:
    source, options, message = BAD[case]
    with pytest.raises(LidarSynthError, match=message):
        make_plan(source, replace(SMALL, **options), None, 1)


def test_groups_without_any_label_are_refused() -> None:
    with pytest.raises(DataError, match="without a label of any scored class"):
        require_labels(np.zeros(19, np.int64), groups_of("pandaset"), ())


def test_rows_have_one_key_each_and_the_base_comes_first() -> None:
    found = rows(("skin", "town"), (0.5, 0.25))
    assert [row.key for row in found] == [
        "real",
        "town-25",
        "town-50",
        "skin-25",
        "skin-50",
    ]


TRAINER = """
import sys, yaml, numpy as np
from pathlib import Path
from lidar_synth import MixedScans, SemanticKITTI
job = yaml.safe_load(open(sys.argv[1]))
real, seen = SemanticKITTI(job["real"]), 0
for stage in job["stages"]:
    synth = SemanticKITTI(stage["synthetic"]) if stage["synthetic"] else None
    given = {k: v for k, v in stage.items() if k not in ("iterations", "synthetic")}
    mixed = MixedScans(real, synth, seed=job["seed"], **given)
    seen += sum(len(mixed[i]["points"]) > 0 for i in range(2)) > 0
assert seen == len(job["stages"])
held_out = SemanticKITTI(job["held_out"])
Path(job["predictions"]).mkdir()
for i in range(len(held_out)):
    assert (held_out[i].label == 255).all()
    np.full(len(held_out[i]), 40, "<u4").tofile(Path(job["predictions"]) / f"{i:06d}.label")
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrain", "recipe"])
def test_a_command_trains_on_the_mixture_of_its_file(name: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(TRAINER)
    task = job(name, tmp_path)
    task = replace(
        task,
        held_out={
            "one": [street(9, boxes=False)],
            "another": [street(8, boxes=False), street(7, boxes=False)],
        },
    )
    tables = CommandTrainer(f"{sys.executable} {tmp_path / 'mine.py'} {{job}}")(task)
    road = TRAIN_ID["road"]
    for place, scans in task.held_out.items():
        label = np.concatenate([scan.label for scan in scans])
        table = tables[place]
        assert table.sum() == (label != 255).sum() == table[:, road].sum()
        assert table[road, road] == (label == road).sum()


def test_a_command_gets_the_pools_that_its_training_changed(tmp_path: Path) -> None:
    """Such as generated scans with the reflectance of the labelled ones."""
    task = job("pretrain-generator", tmp_path)
    pool = [
        replace(scan, reflectance=scan.reflectance / 2)
        for scan in task.pools["generator"]
    ]
    task = replace(task, pools={"generator": pool}, pool_folders={})
    command = shlex.join([sys.executable, "-c", FAILING["one prediction"][0], "{job}"])
    with pytest.raises(DataError, match="with 1 predictions"):
        CommandTrainer(command)(task)
    values = yaml.safe_load((task.folder / "job.yaml").read_text())
    read = read_pool(Path(values["stages"][0]["synthetic"]))
    assert [
        np.array_equal(*pair)
        for pair in zip(
            (s.reflectance for s in read), (s.reflectance for s in pool), strict=True
        )
    ] == [True] * len(pool)


def test_scans_without_instances_exchange_parts_without_whole_objects(
    tmp_path: Path,
) -> None:
    task = job("exchange", tmp_path)
    bare = [replace(scan, instance=None, boxes=None) for scan in task.real]
    task = replace(task, real=bare)
    [stage] = describe(task)["stages"]
    assert stage["labels"] == {"polarmix_or_lasermix": {"objects": 0}}
    [(mixed, _)] = task.mixtures()
    assert len(mixed[0]["points"]) > 0


@pytest.mark.parametrize("classes", GROUPS)
def test_returns_without_a_prediction_are_errors_in_every_pool(
    classes: str, tmp_path: Path
) -> None:
    program = (
        "import sys, yaml, pathlib, numpy as np; job = yaml.safe_load(open(sys.argv[1])); "
        "out = pathlib.Path(job['predictions']); out.mkdir(); "
        "n = len(np.fromfile(next(pathlib.Path(job['held_out']).rglob('*.bin')), 'f4')) // 4; "
        "(out / '000000.label').write_bytes(bytes(4 * n))"
    )
    task = job("real", tmp_path)
    [[scan]] = task.held_out.values()
    everything = replace(scan, label=np.arange(len(scan)).astype(np.uint8) % len(NAMES))
    task = replace(task, held_out={"left out": [everything]})
    command = shlex.join([sys.executable, "-c", program, "{job}"])
    [table] = CommandTrainer(command)(task).values()
    assert (
        table.sum() == len(scan)
        and np.nanmax(group_ious(table, groups_of(classes))) == 0
    )


FAILING = {
    "a failure": (
        "import sys; print('out of memory', file=sys.stderr); sys.exit(7)",
        ProcessError,
        "status 7: out of",
    ),
    "no predictions": ("", FileError, "000000.label cannot be read"),
    "one prediction": (
        "import sys, yaml, pathlib; p = "
        "pathlib.Path(yaml.safe_load(open(sys.argv[1]))['predictions']); p.mkdir(); "
        "(p / '000000.label').write_bytes(bytes(4))",
        DataError,
        "with 1 predictions; expected",
    ),
}
"""{what a command does: its program, the error, its message}."""


@pytest.mark.parametrize("case", FAILING)
def test_a_command_that_fails_is_named(case: str, tmp_path: Path) -> None:
    program, kind, message = FAILING[case]
    with pytest.raises(kind, match=message):
        CommandTrainer(shlex.join([sys.executable, "-c", program, "{job}"]))(
            job("real", tmp_path)
        )


def test_a_command_names_its_job(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="a command with {job}"):
        CommandTrainer("python mine.py")
    with pytest.raises(ProcessError, match="does not start"):
        CommandTrainer("no-such-program {job}")(job("real", tmp_path))


@pytest.mark.parametrize("name", ARMS)
def test_a_job_is_plain_values(name: str, tmp_path: Path) -> None:
    task = job(name, tmp_path, ratio=0.25 if ARMS[name].ratio is None else None)
    values = describe(task)
    assert yaml.safe_load(yaml.safe_dump(values)) == values
    assert [stage["iterations"] for stage in values["stages"]] == [
        count for _, count in task.stages()
    ]


def test_real_scans_without_instances_exchange_no_objects() -> None:
    """PolarMix turns whole objects, which SemanticKITTI's labels without instances lack."""
    scan = Town(1, scans=1)[0]
    bare = [replace(scan, instance=None, boxes=None)]
    [stage] = Row("exchange").stages()
    assert options_of(stage, bare) == {"objects": 0}
    policy = policy_of(stage, bare, frozenset({"label"}))
    assert len(policy(bare[0], keyed_rng(0))) > 0
    assert options_of(stage, [scan]) == {}
