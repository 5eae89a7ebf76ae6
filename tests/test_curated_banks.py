"""Curated banks and parts of banks: they hold the kept scans, and merge, split, head and repair
keep the curation."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis.strategies as st
import numpy as np
import pytest
from banks import some_facts, some_image, write_bank
from hypothesis import given, settings
from test_generator import write
from test_verify import baked, flip, names_and_points, shards

from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.edit import drop, head, merge, split
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import verify
from lidar_synth.bank import INDEX, Bank, Entry, Index
from lidar_synth.errors import ConfigError, DataError, FileError

KEPT = [0, 2, 3, 6, 7]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture(scope="module")
def original(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scans in shards of three."""
    return baked(tmp_path_factory.mktemp("original") / "bank", model)


@pytest.fixture
def good(original: Path, tmp_path: Path) -> Path:
    """Scans 1, 4 and 5 are dropped: one in the middle of the first shard, the last two of the
    second one."""
    drop(Bank(original), [1, 4, 5], "by hand", tmp_path / "good", progress=False)
    return tmp_path / "good"


@settings(max_examples=50)
@given(scans=st.integers(1, 40), data=st.data())
def test_positions_of_kept_scans(scans: int, data: st.DataObject) -> None:
    dropped = sorted(data.draw(st.sets(st.integers(0, scans - 1), max_size=scans - 1)))
    entry = Entry("a.h5", 0, 0, scans, dropped=tuple(dropped))
    kept = np.setdiff1d(np.arange(scans), dropped).tolist()
    assert (entry.kept, [entry.position(rank) for rank in range(entry.kept)]) == (
        len(kept),
        kept,
    )


def test_a_curated_bank_is_the_bank_without_some_scans(
    original: Path, good: Path
) -> None:
    expected = [names_and_points(original)[i] for i in KEPT]
    bank = Bank(good)
    assert len(bank) == 5 and names_and_points(good) == expected
    assert list(bank.ids) == [f"small/0/{i}" for i in KEPT]
    assert np.array_equal(bank.image(4).range, Bank(original).image(7).range)
    assert (bank.index.curation, bank.index.sources) == (
        ("by hand",),
        Bank(original).index.sources,
    )
    assert (
        verify(good, progress=False) == [] and bank.identity != Bank(original).identity
    )
    for path in good.glob("*.h5"):  # hard links, not copies
        assert (
            path.stat().st_ino
            == (original / path.name.replace(".curated", "")).stat().st_ino
        )
    assert Index.from_json((good / INDEX).read_bytes(), "") == bank.index
    assert "| curation | by hand |" in (good / "README.md").read_text()


def test_an_index_without_curation_has_no_keys_for_it(original: Path) -> None:
    """Older versions can read it, but refuse the index of a curated bank."""
    text = (original / INDEX).read_text()
    assert "dropped" not in text and "curation" not in text


def test_a_fully_dropped_shard_is_omitted(original: Path, tmp_path: Path) -> None:
    index = drop(
        Bank(original), [0, 3, 4, 5], "by hand", tmp_path / "few", progress=False
    )
    assert [entry.dropped for entry in index.shards] == [(0,), ()]
    assert (
        len(list((tmp_path / "few").glob("*.h5"))) == 2
        and verify(tmp_path / "few", progress=False) == []
    )
    assert names_and_points(tmp_path / "few") == [
        names_and_points(original)[i] for i in (1, 2, 6, 7)
    ]
    with pytest.raises(
        ConfigError,
        match=r"all 4 scans of .*few left out \(all\); expected a rule that leaves some",
    ):
        drop(Bank(tmp_path / "few"), range(4), "all", tmp_path / "none", progress=False)
    with pytest.raises(
        ConfigError, match=r"scans \[-1, 4\] to leave out; expected 0 to 3"
    ):
        drop(
            Bank(tmp_path / "few"),
            [1, 4, -1],
            "some",
            tmp_path / "none",
            progress=False,
        )
    assert not (tmp_path / "none").exists()


def test_a_curated_bank_can_be_curated_again(
    good: Path, original: Path, tmp_path: Path
) -> None:
    index = drop(Bank(good), [0, 2], "once more", tmp_path / "better", progress=False)
    assert (index.curation, index.scans) == (("by hand", "once more"), 3)
    assert names_and_points(tmp_path / "better") == [
        names_and_points(original)[i] for i in (2, 6, 7)
    ]
    with pytest.raises(ConfigError, match="good was filled with .*'by hand'"):
        drop(Bank(original), [0], "elsewhere", good, progress=False)


@pytest.mark.parametrize(
    "shares",
    [(float("nan"), 1.0), (float("inf"), 1.0), (0.0, 1.0), (-1.0, 2.0), (0.5, 0.4)],
)
def test_shares_that_are_none_are_refused(
    good: Path, tmp_path: Path, shares: tuple[float, ...]
) -> None:
    with pytest.raises(ConfigError, match="expected positive numbers that sum to 1"):
        split(
            Bank(good),
            {tmp_path / str(i): share for i, share in enumerate(shares)},
            progress=False,
        )


@pytest.mark.parametrize("shares", [(0.2, 0.2, 0.6), (0.4, 0.6), (0.8, 0.2)])
def test_parts_of_a_curated_bank_are_curated(
    good: Path, tmp_path: Path, shares: tuple[float, ...]
) -> None:
    parts = split(
        Bank(good),
        {tmp_path / str(i): share for i, share in enumerate(shares)},
        progress=False,
    )
    assert names_and_points(*parts) == names_and_points(good)
    assert all(verify(part, progress=False) == [] for part in parts)
    assert all(index.curation == ("by hand",) for index in parts.values())
    merge([Bank(part) for part in parts], tmp_path / "merged", progress=False)
    assert names_and_points(tmp_path / "merged") == names_and_points(good)
    assert Bank(tmp_path / "merged").index.curation == ("by hand",)
    assert all(
        path.name.endswith(".curated.h5") for path in (tmp_path / "merged").glob("*.h5")
    )
    assert head(Bank(good), 3, tmp_path / "head", progress=False).scans == 3
    assert names_and_points(tmp_path / "head") == names_and_points(good)[:3]


@settings(max_examples=25)
@given(kept=st.sets(st.integers(0, 7), min_size=1, max_size=7))
def test_curated_banks_that_share_no_scan_are_merged(
    original: Path, kept: set[int]
) -> None:
    """Whichever scans of the same shards they hold."""
    rest = {*range(8)} - kept
    with TemporaryDirectory() as folder:
        one, other, both, merged = (Path(folder, name) for name in "abcd")
        drop(Bank(original), rest, "one", one, progress=False)
        drop(Bank(original), kept, "other", other, progress=False)
        merge([Bank(one), Bank(other)], merged, progress=False)
        assert verify(merged, progress=False) == []
        assert names_and_points(merged) == names_and_points(one, other)
        shared = min(kept)
        drop(Bank(original), kept - {shared}, "both", both, progress=False)
        with pytest.raises(ConfigError, match=f"both hold scan {shared} of seed 0"):
            merge([Bank(one), Bank(both)], Path(folder, "none"), progress=False)


def test_a_part_of_a_shard_keeps_its_dropped_scans(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(9)], shard_size=9)
    drop(
        Bank(tmp_path / "bank"), [2, 4, 5], "by hand", tmp_path / "good", progress=False
    )
    parts = split(
        Bank(tmp_path / "good"),
        {tmp_path / "a": 2 / 6, tmp_path / "b": 4 / 6},
        progress=False,
    )
    [a], [b] = (index.shards for index in parts.values())
    assert (a.first, a.scans, a.dropped, b.first, b.scans, b.dropped) == (
        0,
        2,
        (),
        3,
        6,
        (1, 2),
    )
    assert [list(Bank(part).ids) for part in parts] == [
        ["small/5/0", "small/5/1"],
        list(Bank(tmp_path / "good").ids)[2:],
    ]
    assert names_and_points(*parts) == names_and_points(tmp_path / "good")
    assert all(verify(part, progress=False) == [] for part in parts)


def test_repair_keeps_the_curation(good: Path, original: Path, model: Path) -> None:
    before = shards(good)
    index = (good / INDEX).read_bytes()
    (good / "shard-00000.curated.h5").unlink()  # removes a hard link, not the original
    flip_copy(good / "shard-00001.curated.h5")
    assert [problem.file for problem in verify(good, progress=False)][:2] == [
        "shard-00000.curated.h5",
        "shard-00001.curated.h5",
    ]
    assert set(repair(good, str(model), progress=False)) == {
        "shard-00000.curated.h5",
        "shard-00001.curated.h5",
    }
    assert (shards(good), (good / INDEX).read_bytes()) == (before, index)
    assert verify(original, progress=False) == []


def flip_copy(path: Path) -> None:
    """Damage a file, but not its hard links."""
    copy = path.with_suffix(".copy")
    shutil.copyfile(path, copy)
    copy.replace(path)
    flip(path, 8 * 5000)


def test_a_lost_index_never_restores_dropped_scans(
    good: Path, original: Path, model: Path
) -> None:
    (good / INDEX).unlink()
    with pytest.raises(FileError, match="holds no bank"):
        Bank(good)
    with pytest.raises(
        DataError, match=r"are of different bakes; expected a copy of the index"
    ):
        repair(good, str(model), progress=False)
    shutil.copyfile(original / INDEX, good / INDEX)
    with pytest.raises(FileError, match="shard-00000.h5 is missing"):
        Bank(good)


def test_a_bake_refuses_the_folder_of_a_curated_bank(good: Path, model: Path) -> None:
    with pytest.raises(
        ConfigError, match="holds another bank; expected an empty folder"
    ):
        bake(
            make_plan(good, BakeJob(model=str(model), count=8, shard_size=3)),
            progress=False,
        )


@pytest.mark.parametrize("dropped", [(0, 0), (2, 1), (0, 1, 2), (3,), (-1,)])
def test_an_index_with_invalid_dropped_positions_is_refused(
    dropped: tuple[int, ...],
) -> None:
    with pytest.raises(DataError, match="ascending positions that leave a scan"):
        Index(
            (some_facts(),),
            (Entry("a.h5", 0, 0, 3, dropped=dropped),),
            curation=("by hand",),
        )
    with pytest.raises(DataError, match="and the rule"):
        Index((some_facts(),), (Entry("a.h5", 0, 0, 3, dropped=(1,)),))


def test_a_part_without_its_index_does_not_get_the_other_parts(
    original: Path, model: Path, tmp_path: Path
) -> None:
    """A part has the names, and may have the first shards, of the whole bake."""
    split(
        Bank(original),
        {tmp_path / "train": 3 / 8, tmp_path / "val": 5 / 8},
        progress=False,
    )
    (tmp_path / "train" / INDEX).unlink()
    with pytest.raises(
        DataError,
        match="shard-00001.h5 is not there, nor .bake.json.*a copy of the index",
    ):
        repair(tmp_path / "train", str(model), progress=False)
    assert [path.name for path in (tmp_path / "train").glob("*.h5")] == [
        "shard-00000.h5"
    ]


def test_the_same_scans_by_other_settings_are_not_merged(
    model: Path, tmp_path: Path
) -> None:
    banks = []
    for name, steps in (("own", None), ("named", 2)):
        bake(
            make_plan(tmp_path / name, BakeJob(model=str(model), count=2, steps=steps)),
            progress=False,
        )
        banks.append(Bank(tmp_path / name))
    with pytest.raises(ConfigError, match="both hold scan 0 of seed 0"):
        merge(banks, tmp_path / "both", progress=False)
