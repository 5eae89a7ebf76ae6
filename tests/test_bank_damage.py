"""Damaged banks: no damaged byte, missing file or wrong index gives a wrong scan."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from banks import SENSOR, edit_index, some_facts, some_image, write_bank

from lidar_synth.bank import FORMAT, INDEX, Bank, Entry, Index, ShardReader, ShardWriter
from lidar_synth.bank.chunks import checksum
from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import sha256
from lidar_synth.formats import open_scans
from lidar_synth.geometry.scan import RangeImage


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    return tmp_path / "bank"


def read_all(root: Path) -> list[bytes]:
    return [
        scan.points.tobytes() + scan.label.tobytes() + scan.reflectance.tobytes()
        for scan in Bank(root)
    ]


@pytest.mark.slow
def test_no_flipped_bit_gives_a_wrong_scan(root: Path) -> None:
    expected = read_all(root)
    path = root / "shard-00001.h5"
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for bit in rng.choice(8 * len(content), 300, replace=False):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert read_all(root) == expected, f"bit {bit}: a wrong scan"
        except DataError as error:
            assert "shard-00001.h5" in str(error), error
            refused += 1
        # As verify does.
        assert (
            sha256(path)
            != Index.from_json((root / INDEX).read_bytes(), "").shards[1].sha256
        )
    assert refused > 90  # half of such a small shard is unused space for metadata


def test_a_truncated_shard_is_found(root: Path) -> None:
    path = root / "shard-00001.h5"
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    for length in rng.integers(0, len(content), 60).tolist():
        path.write_bytes(content[:length])
        with pytest.raises(
            DataError,
            match=rf"shard-00001.h5 is {length} bytes long; expected {len(content)}",
        ):
            Bank(root)
        # and without knowing the size
        with pytest.raises(DataError, match="shard-00001.h5"):
            shard = ShardReader(path, str(path), index.sources[0], index.shards[1])
            shard.read(0), shard.read(1)


def test_a_missing_shard_and_a_missing_index_are_reported(root: Path) -> None:
    (root / "shard-00002.h5").unlink()
    with pytest.raises(
        FileError, match=r"shard shard-00002.h5 is missing .*lidar-synth repair"
    ):
        Bank(root)
    (root / INDEX).unlink()
    with pytest.raises(
        FileError,
        match=r"holds no bank: index.json cannot be read .*Run an interrupted bake again",
    ):
        open_scans(root)


def with_shard(root: Path, path: Path) -> Bank:
    """The bank, its first shard replaced by a file whose size and hash are in the index."""
    if path.name != "shard-00000.h5":
        shutil.copyfile(path, root / "shard-00000.h5")
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    entry = replace(index.shards[0], bytes=path.stat().st_size, sha256=sha256(path))
    edit_index(root, shards=(entry, *index.shards[1:]))
    return Bank(root)


def test_files_that_do_not_belong_to_the_bank_are_refused(
    root: Path, tmp_path: Path
) -> None:
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["range"] = np.zeros((2, 8, 32), np.uint16)
    with pytest.raises(
        DataError, match=r"shard-00000.h5 is not part of a bank \(format ''\)"
    ):
        with_shard(root, foreign)[0]
    foreign.write_text("no HDF5 at all, but as long as two scans")
    with pytest.raises(
        DataError, match="shard-00000.h5 is truncated, damaged or not an HDF5 file"
    ):
        with_shard(root, foreign)[0]
    with pytest.raises(
        DataError,
        match="shard-00000.h5 holds scans 2 to 3 of seed 5; expected scans 0 to 1 of seed 5",
    ):
        with_shard(root, root / "shard-00001.h5")[0]
    for name, change in {
        "licence": {"licence": "none"},
        "checkpoint": {"checkpoint": "d" * 64},
        "sensor": {"sensor": replace(SENSOR, name="x", range_max=60.0)},
    }.items():
        facts = replace(some_facts(), **change)
        images = [
            RangeImage(i.range.clip(max=60), facts.sensor, i.channels)
            for i in (some_image(0), some_image(1))
        ]
        with ShardWriter(foreign, facts, Entry("shard-00000.h5", 5, 0, 2)) as writer:
            for image in images:
                writer.append(image)
        with pytest.raises(
            DataError, match=f"shard-00000.h5: .*{name} differ from the bank's index"
        ):
            with_shard(root, foreign)[0]


def test_scale_and_sensor_must_agree(root: Path) -> None:
    path = root / "shard-00000.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["scale"] = 0.002
    with pytest.raises(
        DataError, match=r"shard-00000.h5: scale 0.002 in place of 0.00122"
    ):
        with_shard(root, path)[0]


def test_another_version_is_refused(root: Path) -> None:
    text = (root / INDEX).read_text()
    (root / INDEX).write_text(text.replace(FORMAT, "lidar-synth-bank/3"))
    with pytest.raises(
        DataError,
        match=r"is of format 'lidar-synth-bank/3'; expected 'lidar-synth-bank/1' or "
        r"'lidar-synth-bank/2'. Use the",
    ):
        Bank(root)
    (root / INDEX).write_text(text)
    with h5py.File(root / "shard-00000.h5", "r+") as file:
        file.attrs["format"] = np.bytes_(b"lidar-synth-bank/3")
    with pytest.raises(
        DataError, match=r"shard-00000.h5 is of format 'lidar-synth-bank/3'"
    ):
        with_shard(root, root / "shard-00000.h5")[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"scans": 5', '"scans": 6', ": it does not match its checksum"),
        ('"seed": 5', '"seed": 4', ": it does not match its checksum"),
        ("{", "", ": Extra data"),
        ('"format"', '"gormat"', " is not part of a bank"),
    ],
)
def test_a_damaged_index_is_refused(
    root: Path, old: str, new: str, message: str
) -> None:
    (root / INDEX).write_text((root / INDEX).read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=f"index.json{message}"):
        Bank(root)


def test_an_index_with_invalid_shards_is_refused(root: Path) -> None:
    [first, *_] = Index.from_json((root / INDEX).read_bytes(), INDEX).shards
    for change in (
        {"file": "../other.h5"},
        {"file": ".hidden.h5"},
        {"source": 1},
        {"scans": 0},
    ):
        with pytest.raises(DataError, match="a bank"):
            edit_index(root, shards=(replace(first, **change),))
    with pytest.raises(DataError, match="at least one, each only once"):
        edit_index(root, shards=(first, first))


@pytest.mark.parametrize(
    ("name", "code"), [("label", 127), ("label", 19), ("confidence", 16)]
)
def test_invalid_codes_are_refused_despite_a_matching_checksum(
    tmp_path: Path, name: str, code: int
) -> None:
    [path] = write_bank(
        tmp_path, [some_image()], fields=("reflectance", "label", "confidence")
    )
    with h5py.File(path, "r+") as file:
        values = file[name][0]
        values[2, 3] = code
        file[name][0] = values
        arrays = {
            n: np.ascontiguousarray(file[n][0])
            for n in ("range", "reflectance", "label", "confidence")
        }
        file["crc"][0] = checksum(int(file["seed"][0]), int(file["index"][0]), arrays)
    with (
        ShardReader(path, "the shard") as shard,
        pytest.raises(DataError, match=f"the shard: scan 0: .*{code}"),
    ):
        shard.read(0)


def test_a_scan_at_the_place_of_another_is_refused(tmp_path: Path) -> None:
    [path] = write_bank(tmp_path, [some_image()], fields=())
    with h5py.File(path, "r+") as file:
        file["index"][0] = 5
        arrays = {"range": np.ascontiguousarray(file["range"][0])}
        file["crc"][0] = checksum(int(file["seed"][0]), 5, arrays)
    with (
        ShardReader(path, "the shard") as shard,
        pytest.raises(DataError, match="it is scan 5 of seed"),
    ):
        shard.read(0)


def test_a_number_in_place_of_text_allocates_no_memory(tmp_path: Path) -> None:
    """bytes(2**40) would be a terabyte of zeros."""
    [path] = write_bank(tmp_path, [some_image()])
    with h5py.File(path, "r+") as file:
        file.attrs["model"] = 2**40
    with pytest.raises(DataError, match="model is a int64"):
        ShardReader(path, "the shard")
