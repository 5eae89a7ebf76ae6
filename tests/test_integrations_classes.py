"""Trainers with other classes than SemanticKITTI's: the key ``classes`` of a mixture."""

from typing import Any

import numpy as np
import pytest
from lidar_synth.integrations.mixture import id_table, take_classes, trainer_ids

from lidar_synth.datasets.classes import (
    FILE_CLASSES,
    IGNORE,
    NAMES,
    SEMANTIC_KITTI,
    TRAIN_ID,
    Taxonomy,
)
from lidar_synth.errors import ConfigError, DataError

TRAIN = np.arange(len(NAMES), dtype=np.uint8)
POSS = dict.fromkeys((0, 1, 18, 19, 20), 0) | {
    4: 1,
    5: 1,
    6: 2,
    7: 3,
    8: 4,
    9: 5,
    10: 6,
    11: 6,
    12: 6,
    13: 7,
    14: 8,
    15: 9,
    16: 10,
    17: 11,
    21: 12,
    22: 13,
}
"""``learning_map`` of CENet's semantic-poss.yaml."""


@pytest.mark.parametrize("name", FILE_CLASSES)
def test_what_is_written_is_read_as_a_class_of_the_same_kind(name: str) -> None:
    """Each class comes back as itself or as the one that a lossy table names for all of its
    kind."""
    taxonomy = FILE_CLASSES[name]
    back = taxonomy.decode(taxonomy.encode(TRAIN).astype(np.uint16))
    again = taxonomy.decode(taxonomy.encode(back).astype(np.uint16))
    written = back != IGNORE
    assert np.array_equal(again, back) and written.sum() >= 16
    for own in ("car", "person", "bicyclist", "road", "building", "vegetation"):
        if (name, own) != ("nuscenes", "bicyclist"):  # there a bicycle holds its rider
            assert back[TRAIN_ID[own]] == TRAIN_ID[own]


def test_negative_train_ids_are_not_written() -> None:
    with pytest.raises(DataError, match=r"train ids \[-250, -1\]"):
        SEMANTIC_KITTI.encode(np.array([-1, 3, -250]))


def test_the_trainers_own_map_gives_the_ids() -> None:
    ids = trainer_ids(
        POSS, take_classes({"classes": "semantic_poss"}), id_table(1, 0, np.uint8)
    )
    named = dict(zip(NAMES, ids.tolist(), strict=False))
    assert (
        named["car"],
        named["person"],
        named["bicyclist"],
        named["road"],
        named["terrain"],
    ) == (
        3,
        1,
        2,
        13,
        13,
    )
    assert named["truck"] == 0 and (ids[len(NAMES) :] == 0).all()


def test_classes_of_ones_own() -> None:
    settings: dict[str, Any] = {"ratio": 0.5, "classes": {"car": 3, "road": 7}}
    ids = trainer_ids(
        {0: 255, 3: 0, 7: 1}, take_classes(settings), id_table(0, 255, np.int32)
    )
    assert (
        settings == {"ratio": 0.5}
        and ids[TRAIN_ID["car"]] == 0
        and ids[TRAIN_ID["road"]] == 1
    )
    assert (np.delete(ids, [TRAIN_ID["car"], TRAIN_ID["road"]]) == 255).all()


def test_classes_that_do_not_fit_are_refused() -> None:
    for wrong, said in (
        ("poss", "one of semantic_kitti"),
        (["car", "road"], "one of semantic_kitti"),
        ({"bus": 3}, "some of car, bicycle"),
        ({"car": 0}, "1 to 65"),
    ):
        with pytest.raises(ConfigError, match=f"classes: .*{said}"):
            take_classes({"classes": wrong})
    table = id_table(1, 0, np.uint8)
    with pytest.raises(ConfigError, match=r"without \[7\].*Set classes"):
        trainer_ids(
            {0: 0, 3: 1}, take_classes({"classes": {"car": 3, "road": 7}}), table
        )
    with pytest.raises(ConfigError, match="a map of classes with 10: 6"):
        trainer_ids(POSS, take_classes({}), table)
    assert take_classes({}) is SEMANTIC_KITTI


WRONG: dict[str, tuple[Any, ...]] = {
    "a train id beyond the classes": ({1: 19},),
    "one that would wrap": ({1: 300},),
    "one that is negative": ({1: -1},),
    "a share": ({1: 1.7},),
    "a name": ({1: "car"},),
    "an id beyond 16 bits": ({70_000: 3},),
    "an id that would be another": ({-1: 3},),
    "a name as id": ({"a": 3},),
    "a truth as id": ({True: 3},),
    "too few ids to write": ({1: 0}, (1, 2)),
    "a negative id to write": ({1: 0}, (-1,) * len(NAMES)),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_table_of_classes_is_checked_when_it_is_made(case: str) -> None:
    with pytest.raises(ConfigError, match="expected ids 0 to 65535, train ids 0 to 18"):
        Taxonomy("mine", *WRONG[case])
    assert (
        Taxonomy("mine", {np.int64(3): np.uint8(IGNORE)}).decode(np.array([3]))
        == IGNORE
    )
