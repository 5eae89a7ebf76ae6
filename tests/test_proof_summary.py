"""The settings of ``prove``, and its summary: places without the scored classes, and the arm that
is chosen on the other places."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.datasets.recordings import Recordings
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.proof.arms import Row, rows
from lidar_synth.lab.proof.page import body
from lidar_synth.lab.proof.plan import ProofPlan
from lidar_synth.lab.proof.scores import groups_of
from lidar_synth.lab.proof.settings import ProofSettings
from lidar_synth.lab.proof.summary import summarise
from lidar_synth.lab.proof.trial import TrialOutcome
from lidar_synth.lab.town.returns import CALIBRATED_ON

PERSON = TRAIN_ID["person"]
ROAD = TRAIN_ID["road"]
FOUND = {"real": 300, "exchange": 320, "town": 200, "pretrain": 600, "alone": 100}
"""Persons of 1,000 that each arm finds."""


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("labelled", 0, "labelled 0; expected a whole number, 1 or more"),
        ("widths", (), "number of widths 0; expected a whole number, 2 or more"),
        ("widths", (4, 8.0), "width 8.0; expected a whole number, 1 or more"),
        ("seed", -1, "seed -1; expected a whole number, 0 or more"),
        ("arms", ("real", "magic"), "arm 'magic'; expected one of 'real"),
        ("ratios", (1.0,), r"ratios \(1\.0,\); expected shares"),
        ("ratios", (), r"ratios \(\); expected shares"),
    ],
)
def test_wrong_settings_are_refused_at_once(
    name: str, value: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        ProofSettings(**{name: value})


def outcome(found: int, persons: int) -> TrialOutcome:
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    table[ROAD, ROAD] = 5000
    table[PERSON, PERSON], table[PERSON, ROAD] = (
        min(found, persons),
        persons - min(found, persons),
    )
    return TrialOutcome(table)


def a_plan(arms: list[Row], names: list[str], seeds: int = 1) -> ProofPlan:
    pairs = [(name, seed) for seed in range(seeds) for name in names]
    return ProofPlan(
        ProofSettings(only=("person",)),
        {n: [i] for i, n in enumerate(names)},
        tuple(names),
        load_sensor("hdl64e_kitti"),
        None,
        arms,
        groups_of("semantic_kitti", ("person",)),
        [],
        pairs,
        7,
        {pair: [0] for pair in pairs},
        {n: [i] for i, n in enumerate(names)},
        None,
        Recordings(),
        False,
        0.1,
        1.0,
        1,
        "cpu",
        {},
    )


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_a_place_without_the_scored_class_does_not_count() -> None:
    arms = rows(tuple(FOUND), (0.5,))
    names = [f"p{i}" for i in range(7)]
    plan = a_plan(arms, names)
    found = {
        (n, 0): {
            arm: outcome(FOUND[arm.name], 0 if n == "p6" else 1000) for arm in arms
        }
        for n in names
    }
    values = summarise(plan, found, {}, "reference").values
    by_key = {arm["key"]: arm for arm in values["arms"]}
    assert by_key["pretrain"]["better_in"] == "6 of 6 places"
    assert by_key["pretrain"]["difference"] == pytest.approx(30)
    assert by_key["pretrain"]["by_place"]["p6"] is None
    assert by_key["pretrain"]["budget"].startswith("1 labelled scan; ")
    assert by_key["alone"]["budget"].startswith("1 unlabelled scan; ")
    chosen = values["chosen_elsewhere"]
    assert chosen["arms"] == ["pretrain"] * 7 and chosen["difference"] == pytest.approx(
        30
    )
    assert "NaN" not in json.dumps(values) and "nan" not in body(values)


def test_one_training_in_all_places_has_wider_intervals_and_says_why() -> None:
    arms = rows(("exchange",), (0.5,))
    names = [f"p{i}" for i in range(6)]
    seeds = [100, 300, 500]
    apart = a_plan(arms, names, len(seeds))
    found = {
        (n, seed): {
            arm: outcome(gain if arm.name == "exchange" else 300, 1000) for arm in arms
        }
        for n in names
        for seed, gain in enumerate(seeds)
    }
    widths = []
    for plan in (apart, replace(apart, training={"town": [0]})):
        values = summarise(plan, found, {}, "reference").values
        low, high = values["arms"][1]["interval"]
        widths.append(high - low)
        told = any("over 3 seeds is too narrow" in text for text in values["limits"])
        assert told == (plan.training is not None)
    assert widths[1] > 1.5 * widths[0]


@pytest.mark.parametrize("seen", ["town seed 0", f"town seed 0 ({CALIBRATED_ON})"])
def test_what_the_town_owes_to_real_labels_is_named_once(seen: str) -> None:
    arms = rows(("recipe", "town"), (0.5,))
    names = ["p0", "p1"]
    found = {(n, 0): {arm: outcome(300, 1000) for arm in arms} for n in names}
    proof = summarise(a_plan(arms, names), found, {}, "reference", seen)
    for row in proof.values["arms"][1:]:
        assert row["budget"].count(CALIBRATED_ON) == 1
        assert "labels of the town, which cost nothing" in row["budget"]


def test_every_place_counts_alike_however_many_seeds_it_has() -> None:
    arms = rows(("exchange",), (0.5,))
    gains = {("p0", 0): 500, ("p0", 1): 500, ("p1", 0): 300}
    found = {
        pair: {
            arm: outcome(gain if arm.name == "exchange" else 300, 1000) for arm in arms
        }
        for pair, gain in gains.items()
    }
    row = summarise(a_plan(arms, ["p0", "p1"], 2), found, {}, "reference").values[
        "arms"
    ][1]
    assert row["difference"] == pytest.approx(10) and row["miou"] == pytest.approx(40)


def test_the_arm_is_chosen_on_the_other_places() -> None:
    """One that is best at one place alone, by much, is not chosen there."""
    arms = rows(("pretrain", "town"), (0.5,))
    names = [f"p{i}" for i in range(4)]
    persons = {"real": [300] * 4, "pretrain": [310] * 4, "town": [900, 200, 200, 200]}
    found = {
        (name, 0): {arm: outcome(persons[arm.name][i], 1000) for arm in arms}
        for i, name in enumerate(names)
    }
    chosen = summarise(a_plan(arms, names), found, {}, "reference").values[
        "chosen_elsewhere"
    ]
    keys = {arm.name: arm.key for arm in arms}
    assert chosen["arms"] == [keys["pretrain"]] + [keys["town"]] * 3
    assert chosen["difference"] == pytest.approx((1 - 3 * 10) / 4)
