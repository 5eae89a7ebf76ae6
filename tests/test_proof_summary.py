"""The summary of ``prove``: places without the scored classes, and the arm that is chosen on the
other places."""

import json

import numpy as np
import pytest

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.datasets.recordings import Recordings
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.proof.arms import rows
from lidar_synth.lab.proof.page import body
from lidar_synth.lab.proof.plan import ProofPlan
from lidar_synth.lab.proof.scores import groups_of
from lidar_synth.lab.proof.settings import ProofSettings
from lidar_synth.lab.proof.summary import summarise
from lidar_synth.lab.proof.trial import TrialOutcome

PERSON = TRAIN_ID["person"]
ROAD = TRAIN_ID["road"]
FOUND = {"real": 300, "exchange": 320, "town": 200, "pretrain": 600, "alone": 100}
"""Persons of 1,000 that each arm finds."""


def outcome(found: int, persons: int) -> TrialOutcome:
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    table[ROAD, ROAD] = 5000
    table[PERSON, PERSON], table[PERSON, ROAD] = (
        min(found, persons),
        persons - min(found, persons),
    )
    return TrialOutcome(table)


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
def test_a_place_without_the_scored_class_does_not_count() -> None:
    arms = rows(tuple(FOUND), (0.5,))
    names = [f"p{i}" for i in range(7)]
    pairs = [(name, 0) for name in names]
    plan = ProofPlan(
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
    )
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
    assert by_key["pretrain"]["budget"].startswith("1 labelled scans; ")
    assert by_key["alone"]["budget"].startswith("1 unlabelled scans; ")
    chosen = values["chosen_elsewhere"]
    assert chosen["arms"] == ["pretrain"] * 7 and chosen["difference"] == pytest.approx(
        30
    )
    assert "NaN" not in json.dumps(values) and "nan" not in body(values)
