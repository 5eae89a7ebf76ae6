"""Curation of banks that do not fit into memory: approximate search for near duplicates, features
on disk."""

import os
import signal
import subprocess
import sys
import time
import tracemalloc
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import hypothesis.strategies as st
import numpy as np
import pytest
from banks import some_image, write_bank
from hypothesis import given, settings
from numpy.typing import NDArray
from test_curate import ALL, plain_image

import lidar_synth.lab.curate.duplicates as duplicates
import lidar_synth.lab.curate.neighbours as neighbours
import lidar_synth.lab.curate.store as store_module
from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Entry
from lidar_synth.errors import DataError
from lidar_synth.lab.cli.curate import curate
from lidar_synth.lab.curate import FILE, keep_features_in, read_scores, score
from lidar_synth.lab.curate.duplicates import compare_all, most_similar
from lidar_synth.lab.curate.features import SIGNATURE
from lidar_synth.lab.curate.neighbours import find_similar
from lidar_synth.lab.curate.store import FOLDER, Store

NAMES = ("empty",)


class Planted(NamedTuple):
    """Signatures with copies and near duplicates in the second half.

    Args:
        signatures: (N, SIGNATURE).
        near: {number: number of the similar earlier scan}, with a similarity of about 0.99.
        copies: the same for exact copies.
    """

    signatures: NDArray[np.float16]
    near: dict[int, int]
    copies: dict[int, int]


def some_signatures(
    count: int, rng: np.random.Generator, scenes: int = 30, own: float = 1.0
) -> NDArray[np.float32]:
    """Like the town's: the similarity of two is 0.76 to 0.91, that of the most similar ones 0.92 to
    0.95."""
    side = np.arange(32) - 15.5
    profile = 1 / (1 + side**2 + side[:, None] ** 2).reshape(-1)
    scene = np.random.default_rng(9).gamma(0.6, 1, (scenes, SIGNATURE))[
        rng.integers(0, scenes, count)
    ]
    roots = np.sqrt(
        profile * (scene + own * rng.standard_gamma(0.6, (count, SIGNATURE))),
        dtype=np.float32,
    )
    unit: NDArray[np.float32] = roots / np.linalg.norm(roots, axis=1)[:, None]
    return unit


def like(
    signature: NDArray[np.float32], similarity: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Another unit vector with about this similarity."""
    noise = rng.normal(size=SIGNATURE) * signature
    noise -= signature * (noise @ signature)
    noise *= np.sqrt(1 / similarity**2 - 1) / np.linalg.norm(noise)
    other = np.clip(signature + noise, 0, None)
    unit: NDArray[np.float32] = (other / np.linalg.norm(other)).astype(np.float32)
    return unit


def planted(count: int, seed: int, each: int = 200, scenes: int = 30) -> Planted:
    rng = np.random.default_rng(seed)
    signatures = some_signatures(count, rng, scenes)
    sources = rng.choice(count // 2, 2 * each, replace=False).tolist()
    places = (
        count // 2 + rng.choice(count - count // 2, 2 * each, replace=False)
    ).tolist()
    near, copies = (
        dict(zip(places[k::2], sources[k::2], strict=True)) for k in range(2)
    )
    for place, source in near.items():
        signatures[place] = like(signatures[source], 0.9902, rng)
    for place, source in copies.items():
        signatures[place] = signatures[source]
    return Planted(signatures.astype(np.float16), near, copies)


@pytest.fixture(scope="module")
def many() -> Planted:
    return planted(8_000, 1)


# Near duplicates


@pytest.mark.slow
@pytest.mark.parametrize("scenes", [1, 30, 1000])
def test_near_duplicates_are_found(scenes: int) -> None:
    """At least 95 % of the scans with a similarity at the threshold, and every copy."""
    signatures, near, copies = planted(8_000, scenes, scenes=scenes)
    similarity, twin = find_similar(signatures, progress=False)
    true = [
        float(signatures[a].astype(float) @ signatures[b].astype(float))
        for a, b in near.items()
    ]
    assert min(true) > 0.9895 and max(true) < 0.9915
    assert np.mean([twin[a] == b for a, b in near.items()]) >= 0.95
    assert all(twin[a] == b and similarity[a] > 0.999 for a, b in copies.items())


@pytest.mark.slow
def test_the_approximate_similarity_never_exceeds_the_exact_one(many: Planted) -> None:
    signatures = many.signatures[:4000]
    similarity, twin = find_similar(signatures, progress=False)
    exact, _ = compare_all(signatures, progress=False)
    assert (similarity <= exact + 1e-5).all() and (similarity[0], twin[0]) == (0, -1)
    assert ((twin < np.arange(4000)) & (similarity >= 0)).all()
    found = twin >= 0
    products = np.einsum(
        "nd,nd->n", signatures.astype(np.float64), signatures[twin].astype(np.float64)
    )
    assert np.allclose(similarity[found], products.clip(max=1)[found], atol=1e-5)
    assert np.median(exact - similarity) < 0.03


@pytest.mark.slow
def test_the_block_size_changes_nothing(
    many: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = find_similar(many.signatures, progress=False)
    for rows in (97, 5000):
        monkeypatch.setattr(neighbours, "ROWS", rows)
        monkeypatch.setattr(neighbours, "PAIRS", 300 * rows)
        for one, other in zip(
            expected, find_similar(many.signatures, progress=False), strict=True
        ):
            assert np.array_equal(one, other)


def test_nearly_identical_scans_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Like the scans of a collapsed model: one cell holds most scans, and only its first ones are
    compared."""
    rng = np.random.default_rng(3)
    one = some_signatures(1, rng)[0]
    same = np.stack([like(one, 0.9999, rng) for _ in range(1500)])
    signatures = np.concatenate([some_signatures(500, rng), same]).astype(np.float16)
    monkeypatch.setattr(neighbours, "CROWD", 8)
    similarity, _ = find_similar(signatures, progress=False)
    assert np.mean(similarity[501:] > 0.999) >= 0.95 and (similarity[:500] < 0.99).all()
    empty = np.zeros((100, SIGNATURE), np.float16)
    similarity, twin = find_similar(empty, progress=False)
    assert not similarity.any() and twin.tolist() == [-1] + [0] * 99


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40))
def test_the_search_among_few_scans(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    signatures = rng.random((count, SIGNATURE)) * (
        rng.random((count, SIGNATURE)) < 0.05
    )
    signatures = (signatures / np.linalg.norm(signatures, axis=1)[:, None]).astype(
        np.float16
    )
    signatures[rng.random(count) < 0.3] = signatures[0]
    similarity, twin = find_similar(signatures, progress=False)
    exact, _ = compare_all(signatures, progress=False)
    assert (similarity <= exact + 1e-5).all() and (twin < np.arange(count)).all()
    for number in range(1, count):
        if any(
            np.array_equal(signatures[number], signatures[i]) for i in range(number)
        ):
            assert np.array_equal(signatures[number], signatures[twin[number]])


@pytest.mark.slow
def test_large_banks_use_the_approximate_search(
    many: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(duplicates, "compare_all", None)
    monkeypatch.setattr(duplicates, "ALL_PAIRS", len(many.signatures) - 1)
    assert np.array_equal(
        most_similar(many.signatures, False)[1], find_similar(many.signatures, False)[1]
    )


def peak(store: Store) -> int:
    """Peak memory of a search in bytes."""
    tracemalloc.start()
    try:
        find_similar(store, progress=False)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def stored(folder: Path, count: int) -> Store:
    """A store with this many signatures."""
    store = Store(folder, count, NAMES)
    rng = np.random.default_rng(0)
    for block, start in enumerate(range(0, count, store_module.BLOCK)):
        rows = np.zeros(min(store_module.BLOCK, count - start), store.dtype)
        rows["signature"] = rng.integers(
            0, 256, (len(rows), SIGNATURE), np.uint8
        ) * np.float16(1 / 4096)
        store.write(block, rows)
    return store


@pytest.mark.slow
def test_memory_grows_slowly_with_the_number_of_scans(tmp_path: Path) -> None:
    """By at most 400 bytes per scan, although a signature has 2,048 bytes."""
    few, more = (
        peak(stored(tmp_path / str(count), count)) for count in (15_000, 30_000)
    )
    assert (more - few) / 15_000 < 400


# Features on disk


@pytest.fixture
def small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "BLOCK", 8)
    monkeypatch.setattr(store_module, "_UNIT", 4)


@pytest.fixture
def bank(tmp_path: Path) -> Bank:
    write_bank(
        tmp_path / "bank",
        [plain_image(seed) for seed in range(20)],
        shard_size=7,
        fields=ALL,
    )
    return Bank(tmp_path / "bank")


@pytest.mark.slow
def test_the_size_of_the_files_changes_no_score(
    bank: Bank, request: pytest.FixtureRequest
) -> None:
    expected = score(bank, progress=False)
    request.getfixturevalue("small_files")
    for jobs in (1, 2):
        parts = score(bank, jobs=jobs, progress=False)
        assert list(parts.values) == list(expected.values) and np.array_equal(
            parts.twin, expected.twin
        )
        assert all(
            np.array_equal(parts.values[name], values)
            for name, values in expected.values.items()
        )


@pytest.mark.usefixtures("small_files")
def test_a_stopped_run_resumes(
    bank: Bank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = score(bank, progress=False)
    read: list[int] = []
    image = Bank.image

    def stopping(bank: Bank, number: int) -> object:
        read.append(number)
        if len(read) == 18:
            raise KeyboardInterrupt
        return image(bank, number)

    monkeypatch.setattr(Bank, "image", stopping)
    with pytest.raises(KeyboardInterrupt):
        score(bank, progress=False, folder=tmp_path / "kept")
    read.clear()
    scores = score(bank, progress=False, folder=tmp_path / "kept")
    assert read == [16, 17, 18, 19]  # two files of eight scans existed
    assert all(
        np.array_equal(scores.values[name], values)
        for name, values in expected.values.items()
    )
    damaged = next((tmp_path / "kept").rglob("features-000001.npy"))
    damaged.write_bytes(damaged.read_bytes()[:-50])
    read.clear()
    scores = score(bank, progress=False, folder=tmp_path / "kept")
    assert read[0] == 8 and all(
        np.array_equal(scores.values[n], v) for n, v in expected.values.items()
    )


@pytest.mark.usefixtures("small_files")
def test_features_of_another_bank_are_not_reused(bank: Bank, tmp_path: Path) -> None:
    score(bank, progress=False, folder=tmp_path / "kept")
    write_bank(
        tmp_path / "other",
        [some_image(seed) for seed in range(20)],
        shard_size=7,
        fields=ALL,
    )
    other = Bank(tmp_path / "other")
    scores = score(other, progress=False, folder=tmp_path / "kept")
    assert np.array_equal(
        scores.values["empty"], score(other, progress=False).values["empty"]
    )


def test_the_command_removes_its_features(bank: Bank) -> None:
    root = Path(bank.root)
    with keep_features_in(root) as other:  # another run is at work
        curate(root, as_json=True)
        assert other.is_dir() and (root / FILE).is_file()
    assert not (root / FOLDER).exists()
    (root / FILE).unlink()
    curate(root, as_json=True)
    assert not (root / FOLDER).exists()


def test_a_damaged_file_of_features_is_reported(tmp_path: Path) -> None:
    store = stored(tmp_path, 10)
    np.save(tmp_path / "features-000000.npy", np.zeros(10))
    with pytest.raises(
        DataError, match=r"holds \(10,\) of float64; expected what was measured"
    ):
        store[np.arange(3)]


def wait_for(path: Path, pattern: str, process: subprocess.Popen[bytes]) -> None:
    while not list(path.glob(pattern)):
        assert process.poll() is None
        time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_killed_command_resumes(tmp_path: Path) -> None:
    """Killed as soon as one file of 4,096 scans exists."""
    root = tmp_path / "bank"
    write_bank(
        root, [plain_image(seed) for seed in range(20)], shard_size=20, fields=ALL
    )
    _repeat(root, 220)
    command = [sys.executable, "-m", "lidar_synth", "curate", str(root), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    wait_for(root / FOLDER, "*/features-000000.npy", process)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (root / FILE).exists()
    [first] = (root / FOLDER).glob("*/features-000000.npy")
    before = first.stat().st_mtime_ns
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None:
        with suppress(OSError):  # it is removed in the end
            assert first.stat().st_mtime_ns == before
        time.sleep(0.01)
    assert process.returncode == 0 and not (root / FOLDER).exists()
    scores = read_scores(root / FILE)
    assert np.array_equal(scores.values["empty"][:20], scores.values["empty"][-20:])


def _repeat(root: Path, times: int) -> None:
    """Turn the single shard of a bank into many shards with the same content."""
    index = Bank(root).index
    [entry] = index.shards
    entries: list[Entry] = []
    for number in range(times):
        entries.append(replace(entry, file=f"shard-{number:05d}.h5"))
        if number:
            os.link(root / entry.file, root / entries[-1].file)
    write_bank_files(root, replace(index, shards=tuple(entries)))
