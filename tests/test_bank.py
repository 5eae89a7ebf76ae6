"""Banks: scans are read as they were written, by every process, and the same scans give the same
bytes."""

import json
import multiprocessing
import pickle
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from banks import (
    SENSOR,
    edit_index,
    numbers,
    some_facts,
    some_image,
    spoiled,
    write_bank,
)
from torch.utils.data import DataLoader

import lidar_synth.bank.reader as reader
from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import (
    FORMAT,
    Bank,
    Encoding,
    Entry,
    Index,
    ShardReader,
    ShardWriter,
)
from lidar_synth.bank.card import card_files, croissant, summary
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.files.disk import sha256
from lidar_synth.formats import WRITERS, BankScans, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import SYNTHETIC, Source

ALL = ("reflectance", "label", "confidence")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    return tmp_path / "bank"


# Shards


def test_a_chunk_that_skipped_a_filter_is_refused(root: Path) -> None:
    path = root / "shard-00000.h5"
    with h5py.File(path, "r+") as file:
        chunk = bytes(file["range"].id.read_direct_chunk((1, 0, 0))[1])
        file["range"].id.write_direct_chunk((1, 0, 0), chunk + b"0", filter_mask=1)
    with pytest.raises(
        DataError, match=r"scan 1 cannot be read \(filters 1 were not applied\)"
    ):
        ShardReader(path, str(path)).read(1)


def test_plain_hdf5_reads_a_shard(tmp_path: Path) -> None:
    images = [some_image(i) for i in range(3)]
    [path] = write_bank(tmp_path, images, shard_size=3, fields=ALL)
    with h5py.File(path) as file:
        assert file.attrs["format"].decode() == FORMAT
        assert file.attrs["scale"] == 80 / 65535
        assert json.loads(file.attrs["sensor"]) == SENSOR.to_dict()
        assert (file.attrs["seed"], file.attrs["first"], file.attrs["scans"]) == (
            5,
            0,
            3,
        )
        assert file["index"][:].tolist() == [0, 1, 2] and file["seed"][:].tolist() == [
            5,
            5,
            5,
        ]
        for name in ("range", *ALL):
            dataset = file[name]
            assert (
                dataset.chunks,
                dataset.compression,
                dataset.shuffle,
                dataset.fletcher32,
            ) == (
                (1, 8, 32),
                "gzip",
                True,
                True,
            )
            expected = np.stack(
                [Encoding(SENSOR, ALL).encode(image)[name] for image in images]
            )
            assert np.array_equal(dataset[:], expected)


@pytest.mark.slow
def test_the_same_scans_give_the_same_bytes(tmp_path: Path) -> None:
    images = [some_image(i) for i in range(3)]
    first = [path.read_bytes() for path in write_bank(tmp_path / "a", images)]
    time.sleep(1.1)  # HDF5 stores times in seconds
    assert [path.read_bytes() for path in write_bank(tmp_path / "b", images)] == first


@pytest.mark.parametrize("threads", [1, 3])
def test_the_number_of_threads_changes_no_byte(tmp_path: Path, threads: int) -> None:
    facts = some_facts()
    entry = Entry("shard-00000.h5", 5, 0, 40)
    with ShardWriter(tmp_path / entry.file, facts, entry, threads=threads) as writer:
        for i in range(40):
            writer.append(some_image(i))
    [path] = write_bank(
        tmp_path / "one", [some_image(i) for i in range(40)], shard_size=40
    )
    assert (tmp_path / entry.file).read_bytes() == path.read_bytes()


def test_a_shard_with_too_few_scans_or_a_bad_one_is_not_left_behind(
    tmp_path: Path,
) -> None:
    path = tmp_path / "shard-00000.h5"
    entry = Entry("shard-00000.h5", 5, 0, 2)
    with (
        pytest.raises(DataError, match="1 scans for .*; expected 2"),
        ShardWriter(path, some_facts(), entry) as writer,
    ):
        writer.append(some_image())
    assert not path.exists()
    with (
        pytest.raises(DataError, match="reflectance from"),
        ShardWriter(path, some_facts(), entry) as writer,
    ):
        writer.append(spoiled("reflectance", 2))
        writer.append(some_image())
    assert not path.exists()


# Reading


def test_a_bank_returns_the_scans_that_were_written(root: Path) -> None:
    bank = Bank(root)
    assert isinstance(bank, Source)
    assert (len(bank), bank.length, bank.sensor, bank.fields) == (
        5,
        5,
        SENSOR,
        {"reflectance", "label"},
    )
    encoding = Encoding(SENSOR, bank.fields)
    for i in (3, 0, 4, 1, 2):
        expected = encoding.decode(encoding.encode(some_image(i)))
        image = bank.image(i)
        scan = bank[i]
        assert np.array_equal(image.range, expected.range) and np.array_equal(
            image.label, expected.label
        )
        assert (scan.id, scan.domain, scan.sensor) == (
            f"small/5/{i}",
            SYNTHETIC,
            SENSOR,
        )
        assert np.array_equal(scan.points, unproject(expected).points)
        assert (
            np.array_equal(scan.label, expected.label[expected.mask])
            and scan.confidence is None
        )
    assert bank[-1].id == "small/5/4" and len(list(iter(bank))) == 5
    assert list(bank.ids) == [f"small/5/{i}" for i in range(5)] and bank.ids[1:3] == [
        "small/5/1",
        "small/5/2",
    ]
    for wrong in (5, -6):
        with pytest.raises(IndexError):
            bank[wrong]
        with pytest.raises(IndexError):
            bank.image(wrong)
    assert (
        np.array_equal(bank.image(-1).range, bank.image(4).range)
        and bank.ids[-1] == bank.ids[4]
    )


def test_few_files_are_open_and_each_shard_is_parsed_once(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_OPEN", 1)
    bank = Bank(root)
    first = bank.shard(0)
    for i in (0, 4, 1, 3, 2):
        assert bank[i].id == f"small/5/{i}"
        files = [shard._file for shard in bank._shards.values()]
        assert sum(file._opened is not None for file in files) == 1  # type: ignore[attr-defined]
    assert bank.shard(0) is first
    bank.close()
    assert bank[2].id == "small/5/2"


def test_threads_read_what_others_have_closed(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_OPEN", 1)
    bank = Bank(root)
    first = bank.shard(0)
    assert len(bank[4])  # closes it
    assert np.array_equal(first.read(0)["range"], bank.shard(0).read(0)["range"])
    with ThreadPoolExecutor(4) as pool:
        names = list(pool.map(lambda i: bank[i % 5].id, range(60)))
    assert names == [f"small/5/{i % 5}" for i in range(60)]


def test_memory_for_the_places_of_scans_is_bounded(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_OPEN", 1)
    monkeypatch.setattr(reader, "_KNOWN", 2 * reader._LEAST)
    bank = Bank(root)
    assert [bank[i].id for i in (0, 2, 4, 0)] == [f"small/5/{i}" for i in (0, 2, 4, 0)]
    assert list(bank._shards) == [2, 0]


@pytest.mark.parametrize("change", ["other scans", "damage", "shorter", "gone"])
def test_a_shard_that_changed_while_it_was_closed_is_checked_again(
    root: Path, change: str
) -> None:
    bank = Bank(root)
    content = bank[0].points
    path = root / bank.index.shards[0].file
    bank.close()
    if change == "other scans":  # in other places of the file
        path.unlink()
        write_bank(root, [some_image(i) for i in (1, 0)])
        assert not np.array_equal(bank[0].points, content) and np.array_equal(
            bank[1].points, content
        )
        return
    if change == "damage":
        path.write_bytes(path.read_bytes().replace(b"generated", b"Generated", 1))
    elif change == "shorter":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        path.unlink()
    with pytest.raises(
        FileError if change == "gone" else DataError, match="shard-00000.h5"
    ):
        bank[0]


def points(bank: Bank, queue: Any) -> None:
    queue.put(sum(len(scan) for scan in bank))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_read_a_bank(root: Path, method: str) -> None:
    bank = Bank(root)
    expected = sum(len(scan) for scan in bank)  # the parent has its shards open
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    worker = context.Process(target=points, args=(bank, queue))
    worker.start()
    assert queue.get(timeout=60) == expected
    worker.join()
    assert sum(len(scan) for scan in pickle.loads(pickle.dumps(bank))) == expected
    if method == "fork":
        loader = DataLoader(bank, batch_size=None, num_workers=2)  # type: ignore[arg-type]
        assert sum(len(scan) for scan in loader) == expected


def test_conditions_are_stored_by_name(tmp_path: Path) -> None:
    facts = some_facts(
        condition={"kind": "semantic", "source": "kitti360", "split": "r2flow/train"}
    )
    entry = Entry("shard-00000.h5", 5, 7, 2)
    with ShardWriter(
        tmp_path / entry.file, facts, entry, conditions=["drive/0000000007", "drive/8"]
    ) as writer:
        writer.append(some_image(0))
        writer.append(some_image(1))
    path = tmp_path / entry.file
    entry = replace(entry, bytes=path.stat().st_size, sha256=sha256(path))
    write_bank_files(tmp_path, Index((facts,), (entry,)))
    bank = Bank(tmp_path)
    assert [bank.condition(i) for i in range(2)] == ["drive/0000000007", "drive/8"]
    assert bank.facts.condition == facts.condition and bank[1].id == "small/5/8"
    bank.close()
    with h5py.File(path, "r+") as file:
        file["condition"][1] = b"drive/9"
    with pytest.raises(DataError, match="scan 1 cannot be read .*CRC"):
        ShardReader(path, str(path)).read(1)


def test_a_bank_can_be_opened_and_converted_like_any_source(
    root: Path, tmp_path: Path
) -> None:
    scans = open_scans(root)
    assert type(scans) is BankScans and scans.ids[4] == "small/5/4"
    with pytest.raises(ConfigError, match="sensor os1_128 for .*; expected 'small'"):
        open_scans(root, sensor="os1_128")
    with pytest.raises(ConfigError, match="expected 'small', whose scans it holds"):
        open_scans(root, sensor=replace(SENSOR, fov_up=SENSOR.fov_up + 1))
    assert len(open_scans(root, sensor=replace(SENSOR, name="mine"))) == len(scans)
    convert(scans, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    back = open_scans(tmp_path / "out", sensor=SENSOR)
    assert len(list(tmp_path.rglob("*.label"))) == 5
    for a, b in zip(scans, back, strict=True):
        assert np.array_equal(a.points, b.points) and np.array_equal(a.label, b.label)


def test_a_bank_that_was_begun_is_none_yet(tmp_path: Path) -> None:
    (tmp_path / ".bake.json").write_text("{}")
    with pytest.raises(FileError, match="holds no bank: index.json .*resume it"):
        open_scans(tmp_path)


def test_a_bank_without_reflectance_warns(tmp_path: Path) -> None:
    """Not: scans of constant reflectance, which a network would learn."""
    write_bank(tmp_path, [some_image()], fields=("label",))
    with pytest.warns(UserWarning, match="have no reflectance: it is read as 0"):
        scans = open_scans(tmp_path)
    assert not scans[0].reflectance.any()


@pytest.mark.parametrize("number", [slice(3), [1, 2], None, 1.0])
def test_a_scan_has_a_whole_number(root: Path, number: Any) -> None:
    for scans in (Bank(root), open_scans(root)):
        with pytest.raises(TypeError, match="scan .*; expected a whole number"):
            scans[number]


def test_a_paged_bank_reads_over_a_network(tmp_path: Path) -> None:
    import fsspec

    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)], layout="paged")
    with h5py.File(tmp_path / "bank" / "shard-00000.h5") as file:
        strategy, *_ = file.id.get_create_plist().get_file_space_strategy()
        assert strategy == h5py.h5f.FSPACE_STRATEGY_PAGE
    store = fsspec.filesystem("memory")
    store.put(str(tmp_path / "bank"), "/remote", recursive=True)
    scans = open_scans("memory://remote")
    for a, b in zip(scans, open_scans(tmp_path / "bank"), strict=True):
        assert np.array_equal(a.points, b.points)
    with pytest.raises(FileError, match="memory://nowhere holds no bank"):
        open_scans("memory://nowhere")
    with pytest.raises((FileError, LibraryError), match="nosuch://"):
        Bank("nosuch://bank")


def test_missing_libraries_are_reported(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(
        LibraryError,
        match=r"s3://bucket/bank/index.json cannot be opened .*fsspec.*pip install",
    ):
        Bank("s3://bucket/bank")
    facts = some_facts(compression="blosc2")
    with pytest.raises(
        LibraryError,
        match=r"hdf5plugin cannot be imported .*pip install 'lidar_synth\[blosc2\]'",
    ):
        ShardWriter(root / "new.h5", facts, Entry("new.h5", 0, 0, 1))
    # whose copy of a file in memory has a wrong checksum
    monkeypatch.setattr(h5py.version, "hdf5_version_tuple", (1, 14, 6))
    with pytest.raises(LibraryError, match=r"HDF5 2\.0.*pip install"):
        ShardWriter(root / "old.h5", some_facts(), Entry("old.h5", 0, 0, 1))
    assert not (root / "old.h5").exists()


def test_blosc2_banks_are_read(tmp_path: Path) -> None:
    pytest.importorskip("hdf5plugin")
    write_bank(tmp_path, [some_image(i) for i in range(3)], compression="blosc2")
    encoding = Encoding(SENSOR, ("reflectance", "label"))
    for i in range(3):
        assert np.array_equal(
            Bank(tmp_path).image(i).range,
            encoding.decode(encoding.encode(some_image(i))).range,
        )


# Identity, card and golden bank


def test_the_identity_depends_on_the_content_of_the_index(root: Path) -> None:
    before = Bank(root).identity
    write_bank_files(root, Bank(root).index)
    assert Bank(root).identity == before
    edit_index(root, repairs=("shard-00000.h5 was made again",))
    assert Bank(root).identity != before


def test_card_and_croissant(root: Path) -> None:
    card = (root / "README.md").read_text()
    for text in (
        'license: "mit"',
        "| scans | 5 |",
        "| data licence | none |",
        "checkpoint cccc",
        "none was measured",
    ):
        assert text in card
    described = json.loads((root / "croissant.json").read_text())
    assert described["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    files = {
        f["name"]: (f["sha256"], f["contentSize"]) for f in described["distribution"]
    }
    assert files == {
        e.file: (e.sha256, f"{e.bytes} B") for e in Bank(root).index.shards
    }
    assert described["license"] == "MIT"


def test_cards_name_what_each_source_says(root: Path) -> None:
    index = Bank(root).index
    others = {"licence": "CC BY-NC-SA 4.0", "label_policy": "condition"}
    sources = (*index.sources, replace(index.sources[0], **others))
    index = replace(index, sources=sources)
    assert summary(index)["label policy"] == "generated; condition"
    assert croissant("mixed", index)["license"] == ["MIT", "CC BY-NC-SA 4.0"]
    files = card_files("mixed", index, licence="cc-by-4.0")
    assert json.loads(files["croissant.json"])["license"] == "cc-by-4.0"


def test_the_golden_bank_is_still_read() -> None:
    """Made by version 0.1.0 with a tiny sensor; see tests/golden/README.md."""
    golden = Path(__file__).parent / "golden" / "bank"
    bank = Bank(golden)
    known = json.loads((golden / "numbers.json").read_text())
    assert bank.identity == known["identity"]
    assert [numbers(bank, i) for i in range(len(bank))] == known["scans"]
