"""Banks: what is written is read, the bytes repeat, and whatever is damaged is found before a scan is handed out."""

import json
import multiprocessing
import pickle
import shutil
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from banks import SENSOR, numbers, some_facts, some_image, write_bank
from hypothesis import given, settings
from torch.utils.data import DataLoader

import lidar_synth.bank.reader as reader
from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import FORMAT, INDEX, Bank, Encoding, Entry, Index, ShardReader, ShardWriter
from lidar_synth.bank.chunks import checksum, deflate, fletcher32, inflate
from lidar_synth.bank.encoding import LEVELS, TYPES
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.files.disk import sha256
from lidar_synth.formats import WRITERS, BankScans, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import SYNTHETIC, RangeImage, Source
from lidar_synth.geometry.sensor import Sensor

ALL = ("reflectance", "label", "confidence")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    return tmp_path / "bank"


def edit_index(root: Path, **changes: Any) -> None:
    """Write an index that says something else, with a checksum that fits."""
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    (root / INDEX).write_bytes(replace(index, **changes).to_json())


# Encoding


def test_an_image_comes_back_to_half_a_step(sensor: Sensor) -> None:
    image = some_image(1, sensor)
    image.range[0, :4] = sensor.range_min, sensor.range_max, max(sensor.range_min, 1e-6), sensor.range_max * (1 - 1e-7)
    encoding = Encoding(sensor, ALL)
    decoded = encoding.decode(encoding.encode(image))
    assert np.abs(decoded.range - image.range).max() <= encoding.scale / 2 * 1.02
    assert np.array_equal(decoded.mask, image.mask)
    assert np.array_equal(project(unproject(decoded)).mask, image.mask)  # nothing leaves the sensor's limits
    assert np.array_equal(decoded.label, image.label)
    for name, levels in LEVELS.items():
        assert np.abs(decoded.channels[name] - image.channels[name]).max() <= 0.5001 / levels


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), near=st.floats(0, 3), far=st.floats(20, 300))
def test_encode_is_the_inverse_of_decode(seed: int, near: float, far: float) -> None:
    sensor = Sensor("any", 16, near, far, rows=4, fov_up=3.0, fov_down=-25.0)
    encoding, rng = Encoding(sensor, ALL), np.random.default_rng(seed)
    lowest = max(1, int(np.ceil(near * 1.000002 / encoding.scale)))
    arrays = {
        "range": rng.integers(lowest, 65536, sensor.shape).astype(np.uint16) * (rng.random(sensor.shape) < 0.8),
        "reflectance": rng.integers(0, 256, sensor.shape).astype(np.uint8),
        "label": rng.choice([*range(19), IGNORE], sensor.shape).astype(np.uint8),
        "confidence": rng.integers(0, 16, sensor.shape).astype(np.uint8),
    }
    again = encoding.encode(encoding.decode(arrays))
    for name, values in arrays.items():
        assert np.array_equal(again[name], values), name
        assert again[name].dtype == TYPES[name]


def test_the_numbers_of_the_format() -> None:
    """Exact: a bank of today is read by every later version."""
    sensor = Sensor("x", 2, 0.0, 65.535, rows=2, fov_up=3.0, fov_down=-25.0)
    image = RangeImage(
        np.array([(0, 1e-9), (0.0015001, 65.535)], np.float32), sensor,
        {"reflectance": np.array([(0, 1), (0.5, 0.25)], np.float32), "label": np.array([(255, 0), (18, 7)], np.uint8),
         "confidence": np.array([(0, 1), (0.5, 0.1)], np.float32)},
    )  # fmt: skip
    arrays = Encoding(sensor, ALL).encode(image)
    assert {name: values.tolist() for name, values in arrays.items()} == {
        "range": [[0, 1], [2, 65535]],
        "reflectance": [[0, 255], [128, 64]],
        "label": [[255, 0], [18, 7]],
        "confidence": [[0, 15], [8, 2]],
    }
    assert Encoding(sensor).metres(np.array([0, 1, 1000], np.uint16)).tolist() == pytest.approx([0, 0.001, 1.0])
    content = "07000000000000000000000000010000", "000001000200ffff00ff8040ff001207000f0802"
    expected = zlib.crc32(bytes.fromhex(content[0]) + b"seq/0001" + bytes.fromhex(content[1]))
    assert checksum(7, 2**40, arrays, b"seq/0001") == expected


def test_encoding_into_given_memory() -> None:
    encoding = Encoding(SENSOR, ("label",))
    slots = {name: np.zeros((3, *shape), dtype) for name, (shape, dtype) in encoding.arrays().items()}
    encoding.encode(some_image(), {name: values[1] for name, values in slots.items()})
    for name, values in encoding.encode(some_image()).items():
        assert np.array_equal(slots[name][1], values)
        assert not slots[name][[0, 2]].any()


def spoiled(name: str, value: float) -> RangeImage:
    image = some_image()
    (image.range if name == "range" else image.channels[name])[3, 4] = value
    return image


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (spoiled("range", 80.1), r"ranges from .* to 80\.1 m; expected 1\.45 to 80 m, the limits of 'small'"),
        (spoiled("range", 1.4), r"ranges from 1\.4"),
        (spoiled("range", -1), "ranges from -1"),
        (spoiled("range", np.nan), "ranges from"),
        (spoiled("range", np.inf), "ranges from .* to inf"),
        (spoiled("reflectance", 1.01), r"reflectance from 0 to 1.01; expected values in \[0, 1\]"),
        (spoiled("reflectance", np.nan), "reflectance from"),
        (spoiled("confidence", -0.1), "confidence from -0.1"),
        (spoiled("label", 19), r"train ids \[19\]; expected 0..18, or 255"),
        (RangeImage(some_image().range, SENSOR, {}), r"without \['reflectance', 'label', 'confidence'\]"),
        (some_image(0, Sensor("other", 64, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)), r"of \(8, 64\); expected"),
    ],
)
def test_what_has_no_code_is_refused(image: RangeImage, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Encoding(SENSOR, ALL).encode(image)


def test_unknown_fields() -> None:
    with pytest.raises(ConfigError, match=r"fields \['ring'\] of a bank; expected some of range, reflectance"):
        Encoding(SENSOR, ("label", "ring"))


# Chunks


@pytest.mark.parametrize("size", [1, 2, 3, 4, 719, 720, 721, 50_001])
@pytest.mark.parametrize("fill", [None, 0, 255])
def test_fletcher32_is_that_of_hdf5(size: int, fill: int | None) -> None:
    data = np.random.default_rng(size).integers(0, 256, size) if fill is None else np.full(size, fill)
    with h5py.File("any", "w", driver="core", backing_store=False) as file:
        dataset = file.create_dataset("x", data=data.astype(np.uint8), chunks=(size,), fletcher32=True)
        file.flush()
        chunk = bytes(dataset.id.read_direct_chunk((0,))[1])
    assert fletcher32(chunk[:-4]) == int.from_bytes(chunk[-4:], "little")


@given(
    values=st.integers(0, 2**32 - 1).map(np.random.default_rng),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 700)),
    dtype=st.sampled_from([np.uint8, np.uint16, np.uint32]),
    most=st.sampled_from([1, 3, 256, 2**32 - 1]),
)
@settings(max_examples=60)
def test_inflate_is_the_inverse_of_deflate(
    values: np.random.Generator, shape: tuple[int, int], dtype: type[np.unsignedinteger[Any]], most: int
) -> None:
    array = values.integers(0, min(most, np.iinfo(dtype).max), shape).astype(dtype)
    again = inflate(deflate(array), shape, np.dtype(dtype))
    assert again.dtype == dtype and np.array_equal(again, array)


def test_a_chunk_that_is_none_is_refused() -> None:
    array = np.random.default_rng(0).integers(0, 9, (8, 32)).astype(np.uint16)
    chunk, dtype = deflate(array), array.dtype
    for bit in range(8 * len(chunk)):
        damaged = bytearray(chunk)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ValueError, match="Fletcher-32"):
            inflate(bytes(damaged), array.shape, dtype)
    for length in range(len(chunk)):
        with pytest.raises(ValueError):
            inflate(chunk[:length], array.shape, dtype)

    def sealed(packed: bytes) -> bytes:
        return packed + fletcher32(packed).to_bytes(4, "little")

    with pytest.raises(ValueError, match="does not hold 256 bytes"):
        inflate(chunk, array.shape, np.dtype(np.uint8))
    with pytest.raises(ValueError, match="it holds 512 bytes and not 1024"):
        inflate(chunk, array.shape, np.dtype(np.uint32))
    for packed in (b"no zlib at all", chunk[:-9], zlib.compress(array.tobytes())[:40]):
        with pytest.raises(ValueError):
            inflate(sealed(packed), array.shape, dtype)


def test_a_chunk_that_passed_by_a_filter_is_refused(root: Path) -> None:
    path = root / "shard-00000.h5"
    with h5py.File(path, "r+") as file:
        chunk = bytes(file["range"].id.read_direct_chunk((1, 0, 0))[1])
        file["range"].id.write_direct_chunk((1, 0, 0), chunk + b"0", filter_mask=1)
    with pytest.raises(DataError, match=r"scan 1 cannot be read \(filters 1 were left out\)"):
        ShardReader(path, str(path)).read(1)


def test_plain_hdf5_reads_a_shard(tmp_path: Path) -> None:
    images = [some_image(i) for i in range(3)]
    [path] = write_bank(tmp_path, images, shard_size=3, fields=ALL)
    with h5py.File(path) as file:
        assert file.attrs["format"].decode() == FORMAT
        assert file.attrs["scale"] == 80 / 65535
        assert json.loads(file.attrs["sensor"]) == SENSOR.to_dict()
        assert (file.attrs["seed"], file.attrs["first"], file.attrs["scans"]) == (5, 0, 3)
        assert file["index"][:].tolist() == [0, 1, 2] and file["seed"][:].tolist() == [5, 5, 5]
        for name in ("range", *ALL):
            dataset = file[name]
            assert (dataset.chunks, dataset.compression, dataset.shuffle, dataset.fletcher32) == (
                (1, 8, 32), "gzip", True, True,
            )  # fmt: skip
            expected = np.stack([Encoding(SENSOR, ALL).encode(image)[name] for image in images])
            assert np.array_equal(dataset[:], expected)


def test_bytes_repeat(tmp_path: Path) -> None:
    images = [some_image(i) for i in range(3)]
    first = [path.read_bytes() for path in write_bank(tmp_path / "a", images)]
    time.sleep(1.1)  # HDF5 counts time in seconds
    assert [path.read_bytes() for path in write_bank(tmp_path / "b", images)] == first


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(tmp_path: Path, threads: int) -> None:
    facts, entry = some_facts(), Entry("shard-00000.h5", 5, 0, 40)
    with ShardWriter(tmp_path / entry.file, facts, entry, threads=threads) as writer:
        for i in range(40):
            writer.append(some_image(i))
    [path] = write_bank(tmp_path / "one", [some_image(i) for i in range(40)], shard_size=40)
    assert (tmp_path / entry.file).read_bytes() == path.read_bytes()


def test_a_shard_with_too_few_scans_or_a_bad_one_is_not_left_behind(tmp_path: Path) -> None:
    path, entry = tmp_path / "shard-00000.h5", Entry("shard-00000.h5", 5, 0, 2)
    with pytest.raises(DataError, match="1 scans for .*; expected 2"), ShardWriter(path, some_facts(), entry) as writer:
        writer.append(some_image())
    assert not path.exists()
    with pytest.raises(DataError, match="reflectance from"), ShardWriter(path, some_facts(), entry) as writer:
        writer.append(spoiled("reflectance", 2))
        writer.append(some_image())
    assert not path.exists()


# Reading


def test_scans_come_back(root: Path) -> None:
    bank = Bank(root)
    assert isinstance(bank, Source)
    assert (len(bank), bank.length, bank.sensor, bank.fields) == (5, 5, SENSOR, {"reflectance", "label"})
    encoding = Encoding(SENSOR, bank.fields)
    for i in (3, 0, 4, 1, 2):
        expected = encoding.decode(encoding.encode(some_image(i)))
        image, scan = bank.image(i), bank[i]
        assert np.array_equal(image.range, expected.range) and np.array_equal(image.label, expected.label)
        assert (scan.id, scan.domain, scan.sensor) == (f"small/5/{i}", SYNTHETIC, SENSOR)
        assert np.array_equal(scan.points, unproject(expected).points)
        assert np.array_equal(scan.label, expected.label[expected.mask]) and scan.confidence is None
    assert bank[-1].id == "small/5/4" and len(list(iter(bank))) == 5
    assert list(bank.ids) == [f"small/5/{i}" for i in range(5)] and bank.ids[1:3] == ["small/5/1", "small/5/2"]
    for wrong in (5, -6):
        with pytest.raises(IndexError):
            bank[wrong]


def test_few_shards_are_open_at_a_time(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_OPEN", 1)
    bank = Bank(root)
    for i in (0, 4, 1, 3):
        assert bank[i].id == f"small/5/{i}"
        assert len(bank._shards) == 1
    bank.close()
    assert bank[2].id == "small/5/2"


def points(bank: Bank, queue: Any) -> None:
    queue.put(sum(len(scan) for scan in bank))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_banks_go_into_workers(root: Path, method: str) -> None:
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


def test_conditions_stand_by_name(tmp_path: Path) -> None:
    facts = some_facts(condition={"kind": "semantic", "source": "kitti360", "split": "r2flow/train"})
    entry = Entry("shard-00000.h5", 5, 7, 2)
    with ShardWriter(tmp_path / entry.file, facts, entry, conditions=["drive/0000000007", "drive/8"]) as writer:
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


def test_a_bank_is_a_source_among_the_others(root: Path, tmp_path: Path) -> None:
    scans = open_scans(root)
    assert type(scans) is BankScans and scans.ids[4] == "small/5/4"
    with pytest.raises(ConfigError, match="sensor os1_128 for .*; expected 'small'"):
        open_scans(root, sensor="os1_128")
    convert(scans, WRITERS["semantic_kitti"](tmp_path / "out"), progress=False)
    back = open_scans(tmp_path / "out", sensor=SENSOR)
    assert len(list(tmp_path.rglob("*.label"))) == 5
    for a, b in zip(scans, back, strict=True):
        assert np.array_equal(a.points, b.points) and np.array_equal(a.label, b.label)


def test_a_paged_bank_reads_over_a_network(tmp_path: Path) -> None:
    import fsspec

    write_bank(tmp_path / "bank", [some_image(i) for i in range(3)], layout="paged")
    store = fsspec.filesystem("memory")
    store.put(str(tmp_path / "bank"), "/remote", recursive=True)
    scans = open_scans("memory://remote")
    for a, b in zip(scans, open_scans(tmp_path / "bank"), strict=True):
        assert np.array_equal(a.points, b.points)
    with pytest.raises(FileError, match="memory://nowhere/index.json cannot be read"):
        open_scans("memory://nowhere")
    with pytest.raises((FileError, LibraryError), match="nosuch://"):
        Bank("nosuch://bank")


def test_missing_libraries_say_so(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(LibraryError, match=r"s3://bucket/bank/index.json cannot be opened .*fsspec.*pip install"):
        Bank("s3://bucket/bank")
    facts = some_facts(compression="blosc2")
    with pytest.raises(LibraryError, match=r"hdf5plugin cannot be imported .*pip install 'lidar_synth\[blosc2\]'"):
        ShardWriter(root / "new.h5", facts, Entry("new.h5", 0, 0, 1))


def test_blosc2(tmp_path: Path) -> None:
    pytest.importorskip("hdf5plugin")
    write_bank(tmp_path, [some_image(i) for i in range(3)], compression="blosc2")
    encoding = Encoding(SENSOR, ("reflectance", "label"))
    for i in range(3):
        assert np.array_equal(Bank(tmp_path).image(i).range, encoding.decode(encoding.encode(some_image(i))).range)


# Damage


def read_all(root: Path) -> list[bytes]:
    return [scan.points.tobytes() + scan.label.tobytes() + scan.reflectance.tobytes() for scan in Bank(root)]


def test_no_flipped_bit_gives_a_wrong_scan(root: Path) -> None:
    whole = read_all(root)
    path = root / "shard-00001.h5"
    content, rng, found = path.read_bytes(), np.random.default_rng(0), 0
    for bit in rng.choice(8 * len(content), 300, replace=False):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert read_all(root) == whole, f"bit {bit}: a wrong scan"
        except DataError as error:
            assert "shard-00001.h5" in str(error), error
            found += 1
        assert sha256(path) != Index.from_json((root / INDEX).read_bytes(), "").shards[1].sha256  # what verify looks at
    assert found > 90  # of so small a shard half is room for metadata, in which nothing stands


def test_a_cut_shard_is_found(root: Path) -> None:
    path = root / "shard-00001.h5"
    content, rng = path.read_bytes(), np.random.default_rng(0)
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    for length in rng.integers(0, len(content), 60).tolist():
        path.write_bytes(content[:length])
        with pytest.raises(DataError, match=rf"shard-00001.h5 is {length} bytes long; expected {len(content)}"):
            Bank(root)
        with pytest.raises(DataError, match="shard-00001.h5"):  # and without knowing the size
            shard = ShardReader(path, str(path), index.sources[0], index.shards[1])
            shard.read(0), shard.read(1)


def test_a_missing_shard_and_a_missing_index(root: Path) -> None:
    (root / "shard-00002.h5").unlink()
    with pytest.raises(FileError, match=r"shard shard-00002.h5 is missing .*lidar-synth repair"):
        Bank(root)
    (root / INDEX).unlink()
    with pytest.raises(FileError, match=r"holds no bank: index.json cannot be read .*goes on by the same command"):
        open_scans(root)


def with_shard(root: Path, path: Path) -> Bank:
    """The bank, its first shard replaced by a file whose size and hash are in the index."""
    if path.name != "shard-00000.h5":
        shutil.copyfile(path, root / "shard-00000.h5")
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    entry = replace(index.shards[0], bytes=path.stat().st_size, sha256=sha256(path))
    edit_index(root, shards=(entry, *index.shards[1:]))
    return Bank(root)


def test_files_that_are_no_shard_of_the_bank(root: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["range"] = np.zeros((2, 8, 32), np.uint16)
    with pytest.raises(DataError, match=r"shard-00000.h5 is no part of a bank \(format ''\)"):
        with_shard(root, foreign)[0]
    foreign.write_text("no HDF5 at all, but as long as two scans")
    with pytest.raises(DataError, match="shard-00000.h5 is cut, damaged or no HDF5 file"):
        with_shard(root, foreign)[0]
    with pytest.raises(DataError, match="shard-00000.h5 holds scans 2 to 3 of seed 5; expected scans 0 to 1 of seed 5"):
        with_shard(root, root / "shard-00001.h5")[0]
    for name, change in {
        "licence": {"licence": "none"},
        "checkpoint": {"checkpoint": "d" * 64},
        "sensor": {"sensor": replace(SENSOR, name="x", range_max=60.0)},
    }.items():
        facts = replace(some_facts(), **change)
        images = [RangeImage(i.range.clip(max=60), facts.sensor, i.channels) for i in (some_image(0), some_image(1))]
        with ShardWriter(foreign, facts, Entry("shard-00000.h5", 5, 0, 2)) as writer:
            for image in images:
                writer.append(image)
        with pytest.raises(DataError, match=f"shard-00000.h5: .*{name} are not those of the bank's index"):
            with_shard(root, foreign)[0]


def test_scale_and_sensor_have_to_agree(root: Path) -> None:
    path = root / "shard-00000.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["scale"] = 0.002
    with pytest.raises(DataError, match=r"scale 0.002; expected 0.00122.* for sensor 'small'"):
        with_shard(root, path)[0]


def test_another_version_is_refused(root: Path) -> None:
    text = (root / INDEX).read_text()
    (root / INDEX).write_text(text.replace(FORMAT, "lidar-synth-bank/2"))
    with pytest.raises(DataError, match=r"is of format 'lidar-synth-bank/2'; expected 'lidar-synth-bank/1'. Use the"):
        Bank(root)
    (root / INDEX).write_text(text)
    with h5py.File(root / "shard-00000.h5", "r+") as file:
        file.attrs["format"] = np.bytes_(b"lidar-synth-bank/2")
    with pytest.raises(DataError, match=r"shard-00000.h5 is of format 'lidar-synth-bank/2'"):
        with_shard(root, root / "shard-00000.h5")[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"scans": 5', '"scans": 6', "does not have its own checksum"),
        ('"seed": 5', '"seed": 4', "does not have its own checksum"),
        ("{", "", "is damaged"),
        ('"format"', '"gormat"', "is no part of a bank"),
    ],
)
def test_a_damaged_index(root: Path, old: str, new: str, message: str) -> None:
    (root / INDEX).write_text((root / INDEX).read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=f"index.json {message}"):
        Bank(root)


def test_an_index_that_leads_elsewhere(root: Path) -> None:
    [first, *_] = Index.from_json((root / INDEX).read_bytes(), INDEX).shards
    for change in ({"file": "../other.h5"}, {"file": ".hidden.h5"}, {"source": 1}, {"scans": 0}):
        with pytest.raises(DataError, match="a bank"):
            edit_index(root, shards=(replace(first, **change),))
    with pytest.raises(DataError, match="at least one, each once"):
        edit_index(root, shards=(first, first))


def test_an_index_is_known_by_its_content(root: Path) -> None:
    before = Bank(root).identity
    write_bank_files(root, Bank(root).index)
    assert Bank(root).identity == before
    edit_index(root, repairs=("shard-00000.h5 was made again",))
    assert Bank(root).identity != before


# What goes with a bank


def test_card_and_croissant(root: Path) -> None:
    card = (root / "README.md").read_text()
    for text in ('license: "mit"', "| scans | 5 |", "| data licence | none |", "checkpoint cccc", "none was measured"):
        assert text in card
    described = json.loads((root / "croissant.json").read_text())
    assert described["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    files = {f["name"]: (f["sha256"], f["contentSize"]) for f in described["distribution"]}
    assert files == {e.file: (e.sha256, f"{e.bytes} B") for e in Bank(root).index.shards}


def test_the_golden_bank_is_still_read() -> None:
    """Made by version 0.1.0 with a tiny sensor; see tests/golden/README.md."""
    golden = Path(__file__).parent / "golden" / "bank"
    bank = Bank(golden)
    known = json.loads((golden / "numbers.json").read_text())
    assert bank.identity == known["identity"]
    assert [numbers(bank, i) for i in range(len(bank))] == known["scans"]


@pytest.mark.parametrize(("name", "code"), [("label", 127), ("label", 19), ("confidence", 16)])
def test_codes_that_no_writer_writes_are_refused_whatever_the_checksum(tmp_path: Path, name: str, code: int) -> None:
    [path] = write_bank(tmp_path, [some_image()], fields=("reflectance", "label", "confidence"))
    with h5py.File(path, "r+") as file:
        values = file[name][0]
        values[2, 3] = code
        file[name][0] = values
        arrays = {n: np.ascontiguousarray(file[n][0]) for n in ("range", "reflectance", "label", "confidence")}
        file["crc"][0] = checksum(int(file["seed"][0]), int(file["index"][0]), arrays)
    with ShardReader(path, "the shard") as shard, pytest.raises(DataError, match=f"the shard: scan 0: .*{code}"):
        shard.read(0)


def test_a_number_in_the_place_of_text_takes_no_memory(tmp_path: Path) -> None:
    """bytes(2**40) would be a terabyte of zeros."""
    [path] = write_bank(tmp_path, [some_image()])
    with h5py.File(path, "r+") as file:
        file.attrs["model"] = 2**40
    with pytest.raises(DataError, match="model is a int64"):
        ShardReader(path, "the shard")
