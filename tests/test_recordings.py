"""Which frames a set of scans holds: sets of drives and frames, and the mapping between
datasets."""

from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from lidar_synth.datasets.recordings import (
    KITTI,
    KITTI360,
    KITTI360_SPLITS,
    ODOMETRY,
    PLACES,
    Recordings,
    all_frames,
    frames_of,
)
from lidar_synth.errors import DataError
from lidar_synth.formats import semantic_kitti
from lidar_synth.lab.importers import lidm

Held = dict[str, set[int] | None]
DRIVES = st.dictionaries(
    st.sampled_from(["a", "b", "c"]),
    st.none() | st.sets(st.integers(0, 30), min_size=1),
    max_size=3,
)


def made(held: Held) -> Recordings:
    """None = the whole drive."""
    ids = [
        f"{d}/{n}"
        for d, frames in held.items()
        if frames is not None
        for n in sorted(frames)
    ]
    return frames_of(
        "kitti360", [*ids, *(d for d, frames in held.items() if frames is None)]
    )


def numbers(recordings: Recordings) -> Held:
    return {
        drive: None
        if runs is None
        else {n for first, last in runs for n in range(first, last + 1)}
        for (_, drive), runs in recordings.drives.items()
    }


@given(DRIVES, DRIVES)
def test_they_are_sets(some: Held, others: Held) -> None:
    a = made(some)
    b = made(others)
    assert numbers(a) == some
    joined = {
        d: None
        if None in (some.get(d, 0), others.get(d, 0))
        else some.get(d, set()) | others.get(d, set())  # type: ignore[operator]
        for d in some.keys() | others.keys()
    }
    assert numbers(a | b) == joined
    shared: Held = {}
    for d in some.keys() & others.keys():
        x = some[d]
        y = others[d]
        both = y if x is None else x if y is None else x & y
        if both is None or both:
            shared[d] = both
    assert numbers(a & b) == numbers(b & a) == shared
    assert bool(a & b) == bool(shared)
    assert Recordings.from_list(a.to_list()) == a


def test_splits_of_kitti360_leak_into_each_other() -> None:
    sets = {
        name: all_frames(KITTI360, drives)
        for name, drives in KITTI360_SPLITS.items()
        if drives is not None
    }
    assert [d[-9:-5] for _, d in (sets["lidm/train"] & sets["r2flow/test"]).drives] == [
        "0000",
        "0002",
    ]
    assert not sets["r2flow/train"] & sets["r2flow/test"]
    assert not sets["lidm/train"] & sets["lidm/val"]
    assert [d[-9:-5] for _, d in (sets["r2flow/train"] & sets["lidm/val"]).drives] == [
        "0003"
    ]


def test_a_sequence_of_the_benchmark_is_a_part_of_a_raw_drive() -> None:
    frames = frames_of("semantic_kitti", ["08/000000", "08/000001", "08/000007"])
    assert frames.drives == {
        (KITTI, "2011_09_30_drive_0028"): ((1100, 1101), (1107, 1107))
    }
    raw = frames_of(
        "kitti_raw", [f"2011_09_30_drive_0028_sync/{n:010d}" for n in range(1101, 1107)]
    )
    assert (frames & raw).drives == {(KITTI, "2011_09_30_drive_0028"): ((1101, 1101),)}
    before = frames_of(
        "kitti_raw", [f"2011_09_30_drive_0028_sync/{n:010d}" for n in range(1100)]
    )
    assert not frames_of("semantic_kitti", ["08"]) & before
    val, train = (
        frames_of("semantic_kitti", semantic_kitti.SPLITS[s] or ())
        for s in ("val", "train")
    )
    assert val and not val & train
    assert len({drive for drive, *_ in ODOMETRY.values()}) == len(ODOMETRY) == 11
    assert frames_of("semantic_kitti", ["13"]).drives == {(KITTI, "odometry 13"): None}


def test_frames_without_a_number_count_as_the_complete_drive() -> None:
    assert frames_of("kitti360", ["drive/left", "drive/0000000001"]).drives == {
        (KITTI360, "drive"): None
    }
    assert not frames_of("npz", ["drive/0000000001"])
    assert set(PLACES) == {
        "kitti360",
        "kitti_raw",
        "semantic_kitti",
        "kitti_object",
        "pandaset",
    }


def test_many_holes_are_kept_as_one_run() -> None:
    [frames] = frames_of(
        "kitti360", [f"d/{n}" for n in range(0, 10_000, 2)]
    ).drives.values()
    assert frames == ((0, 9998),)


def test_all_of_lidms_models_know_both_datasets() -> None:
    """Their autoencoder is trained on KITTI-360 and the odometry benchmark; validation is on drive
    03, sequence 08."""
    val = frames_of("semantic_kitti", ["08"]) | all_frames(
        KITTI360, KITTI360_SPLITS["lidm/val"] or ()
    )
    for data in ("KITTI-360", "SemanticKITTI", lidm.IMAGES):
        seen = lidm.seen(data, generates=True)
        assert not seen & val
        assert seen & frames_of("semantic_kitti", ["00", "19"])
        assert seen & all_frames(KITTI360, KITTI360_SPLITS["r2flow/test"] or ())


@pytest.mark.parametrize(
    "values",
    [
        3,
        [3],
        [{}],
        [{"dataset": "x"}],
        *(
            [{"dataset": "x", "drives": drives}]
            for drives in ([1], {"a": 5}, {"a": [[1]]}, {"a": [["b", 2]]})
        ),
    ],
)
def test_invalid_recordings_are_refused(values: Any) -> None:
    with pytest.raises(DataError, match="expected datasets, their drives and frames"):
        Recordings.from_list(values)


def test_recordings_are_described_in_words() -> None:
    some = frames_of("kitti360", ["a/1", "a/2", "a/5", "b", "c/7"])
    assert (
        str(some)
        == "KITTI-360 a (3 frames from 1 to 5), KITTI-360 b (all frames), KITTI-360 c (frame 7)"
    )
    assert str(all_frames(KITTI, map(str, range(8)))).endswith(
        "KITTI 5 (all frames) and 2 more drives"
    )
