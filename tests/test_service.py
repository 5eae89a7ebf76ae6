"""Generation beside the trainer: the scans that the plan says, in every order, from every process
and in every way."""

import os
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from mixtures import SENSOR, Scans
from small_models import SENSOR as GRID
from test_generator import write, write_latent
from torch.utils.data import DataLoader, Dataset

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import ConfigError, DataError, FileError, ProcessError
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.mixing import MixedScans, Sources
from lidar_synth.mixing.service import BatchMixer, RollingBank, rolling
from lidar_synth.mixing.service.slots import Slots
from lidar_synth.mixing.state import make_state

SEED = 3


FIELDS = ("reflectance", "label", "confidence")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("service") / "small.safetensors")


@pytest.fixture(scope="module")
def generator(path: Path) -> Generator:
    return load_generator(path)


@pytest.fixture(scope="module")
def bank(path: Path) -> Iterator[RollingBank]:
    with RollingBank(path, seed=SEED, slots=6, threads=1, timeout=60) as bank:
        yield bank


def codes(scan: Scan) -> dict[str, np.ndarray]:
    """What a bank would hold of a scan."""
    fields = [name for name in FIELDS if name in scan.fields()]
    return Encoding(SENSOR, fields).encode(project(scan, SENSOR, fields))


def expected(generator: Generator, number: int) -> dict[str, np.ndarray]:
    return Encoding(SENSOR, FIELDS).encode(generator.range_images(SEED, [number])[0])


def agree(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """The contract: at least 99.99 % of the cells; of the range within a step, which points in
    float32 may cross."""
    steps = {name: abs(a[name].astype(int) - b[name].astype(int)) for name in b}
    return all((steps[name] <= (name == "range")).mean() >= 0.9999 for name in b)


def test_slots_notice_damage(generator: Generator) -> None:
    slots = Slots(Encoding(SENSOR, FIELDS), 2)
    [image] = generator.range_images(SEED, [1])
    checksum = slots.write(1, 1, image)
    back = slots.read(1, 1, checksum)
    assert all(
        np.array_equal(back[name], code)
        for name, code in Encoding(SENSOR, FIELDS).encode(image).items()
    )
    with pytest.raises(DataError, match="scan 2 in slot 1"):
        slots.read(1, 2, checksum)
    slots._slot(1)[100] ^= 1
    with pytest.raises(
        DataError, match="scan 1 in slot 1 of the rolling bank is damaged"
    ):
        slots.read(1, 1, checksum)


def test_last_words_fit() -> None:
    with torch.device("meta"):  # the trainer's default device
        slots = Slots(Encoding(SENSOR), 1)
    assert slots.last_words == ""
    slots.last_words = "ä" * 10_000
    assert set(slots.last_words) <= set("ä\N{REPLACEMENT CHARACTER}")
    assert not slots._slot(0).any()


@pytest.mark.slow
@settings(max_examples=15)
@given(
    numbers=st.lists(st.integers(0, 20) | st.integers(0, 2**62), min_size=1, max_size=5)
)
def test_a_rolling_bank_gives_the_generators_scans_in_every_order(
    bank: RollingBank, generator: Generator, numbers: list[int]
) -> None:
    for number in numbers:
        scan = bank[number]
        assert (scan.id, scan.domain, scan.sensor) == (
            f"small/{SEED}/{number}",
            SYNTHETIC,
            SENSOR,
        )
        assert agree(codes(scan), expected(generator, number))


class Codes(Dataset[Any]):
    """What workers of a loader read from a bank."""

    def __init__(self, bank: RollingBank, numbers: Sequence[int]) -> None:
        self.bank = bank
        self.numbers = numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> tuple[str, dict[str, np.ndarray]]:
        scan = self.bank[self.numbers[index]]
        return scan.id, codes(scan)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {
            "num_workers": 2,
            "multiprocessing_context": "fork",
            "persistent_workers": True,
        },
        {"num_workers": 1, "multiprocessing_context": "spawn"},
    ],
    ids=["main", "fork", "spawn"],
)
def test_workers_read_it(
    bank: RollingBank, generator: Generator, options: dict[str, Any]
) -> None:
    numbers = [3, 3, 40, 41, 42, 5, 43, 0]
    bank[7]  # so that a fork inherits an open connection
    bank.expect(numbers)
    loader = DataLoader(Codes(bank, numbers), batch_size=2, collate_fn=list, **options)
    for _ in range(2):
        given = [sample for batch in loader for sample in batch]
        assert [name for name, _ in given] == [f"small/{SEED}/{n}" for n in numbers]
        assert all(
            agree(c, expected(generator, n))
            for (_, c), n in zip(given, numbers, strict=True)
        )
    assert bank[1].id == f"small/{SEED}/1"


def test_threads_read_it(bank: RollingBank) -> None:
    found: list[str] = []
    lines = set()

    def read(numbers: range) -> None:
        found.extend(bank[n].id for n in numbers)
        lines.add(bank._client._line())

    threads = [threading.Thread(target=read, args=(range(i, 40, 4),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sorted(found) == sorted(f"small/{SEED}/{n}" for n in range(40))
    # answers cannot be mixed up; nor between a process and its fork:
    assert len(lines) == 4
    assert {pid for pid, _ in bank._client._connections} == {os.getpid()}


@pytest.mark.slow
def test_announced_scans_are_made_before_they_are_requested(path: Path) -> None:
    with RollingBank(
        path, seed=SEED, slots=6, threads=1, timeout=60
    ) as bank:  # nothing else is announced to it
        wait_until(lambda: bank.counts()["made"] == 6)  # what it made ahead by itself
        before = bank.counts()
        bank.expect([100, 102, 101])
        wait_until(lambda: bank.counts()["made"] == before["made"] + 3)
        assert [bank[n].id for n in (102, 100, 101)] == [
            f"small/{SEED}/{n}" for n in (102, 100, 101)
        ]
        after = bank.counts()
        assert (
            after["served"] - before["served"],
            after["waited"] - before["waited"],
        ) == (3, 0)
        many = list(range(200, 20_200))
        bank.expect(many)  # more than one message
        wait_until(lambda: bank.counts()["made"] >= after["made"] + 6)
        assert bank[200].id == f"small/{SEED}/200"
        assert bank.counts()["waited"] == after["waited"]


def wait_until(what: Callable[[], bool], seconds: float = 60) -> None:
    pause = threading.Event()
    for _ in range(int(seconds / 0.02)):
        if what():
            return
        pause.wait(0.02)
    raise AssertionError("it did not happen")


@pytest.mark.slow
def test_micro_batches_change_rounding_only(path: Path, generator: Generator) -> None:
    with RollingBank(path, seed=SEED, slots=8, threads=1, timeout=60, batch=3) as bank:
        pairs = [(codes(bank[n]), expected(generator, n)) for n in range(30)]
    for name in ("range", *FIELDS):
        given, whole = (
            np.stack([p[k][name] for p in pairs]).astype(int) for k in (0, 1)
        )
        assert (
            abs(given - whole) <= 1
        ).mean() >= 0.999  # one step of the encoding: 1.2 mm


@pytest.mark.slow
def test_a_pool_is_refreshed_with_the_epoch(path: Path, generator: Generator) -> None:
    with RollingBank(
        path, seed=SEED, slots=4, refresh=0.5, threads=1, timeout=60
    ) as bank:
        assert [bank[n].id[-1] for n in range(8)] == list("01230123")
        bank.expect([17])  # a pool goes by epochs
        bank.set_epoch(1)
        assert [bank[n].id[-1] for n in range(4)] == list("4523")
        assert agree(codes(bank[0]), expected(generator, 4))
        assert bank.counts()["made"] <= 8


@pytest.mark.slow
def test_a_starved_bank_serves_scans_in_memory(
    path: Path, generator: Generator
) -> None:
    with RollingBank(
        path, seed=SEED, slots=4, starved="reuse", threads=1, timeout=60
    ) as bank:
        bank[0]
        for number in range(100, 160):
            scan = bank[number]
            assert agree(codes(scan), expected(generator, int(scan.id.split("/")[-1])))
        counts = bank.counts()
        assert counts["served"] == 61
        assert counts["reused"] >= 1
        assert counts["waited"] <= 1


def test_invalid_options_and_requests_are_refused(
    path: Path, bank: RollingBank, tmp_path: Path
) -> None:
    refusals: list[tuple[dict[str, Any], str]] = [
        ({"slots": 0}, "slots 0"),
        ({"slots": "4"}, "slots .4."),
        ({"devise": "cpu"}, "option .devise.*device"),
        ({"timeout": 0}, "timeout=0"),
        ({"seed": -1}, "seed -1"),
        ({"starved": "skip"}, r"starved='skip'; expected one of \('wait', 'reuse'\)"),
        ({"refresh": 1.5}, r"refresh=1.5; expected a share in \(0, 1\]"),
        ({"timeout": "1"}, "timeout='1'; expected more than 0 seconds"),
        ({"seed": 1.5}, "seed 1.5; expected .*an integer"),
        ({"threads": 1.5}, "threads 1.5; expected a whole number, 1 or more"),
        ({"steps": 0}, "steps 0; expected a whole number, 1 or more"),
        ({"steps": 2.5}, "steps 2.5; expected a whole number, 1 or more"),
        ({"solver": "rk4"}, "solver 'rk4'; expected one of 'euler', 'heun'"),
        ({"batch": 0}, "batch 0; expected a whole number, 1 or more"),
        ({"columns": 78}, "78 columns of 'small'; expected one of 32"),
    ]
    # No process is started for them.
    with patch.object(rolling, "Client", side_effect=AssertionError):
        for options, message in refusals:
            with pytest.raises(ConfigError, match=message):
                RollingBank(path, **options)
    with pytest.raises(FileError, match="nowhere"):
        RollingBank(tmp_path / "nowhere.safetensors")
    with pytest.raises(ConfigError, match="a conditional model"):
        RollingBank(write(tmp_path / "conditioned.safetensors", dropout=0.0))
    for number in (-1, 2**63):
        with pytest.raises(ConfigError, match=f"scan {number}"):
            bank[number]
    with pytest.raises(TypeError, match="scan 1.7; expected a whole number"):
        bank[1.7]  # type: ignore[index]
    with pytest.raises(RuntimeError, match="should only be shared between processes"):
        pickle.dumps(bank)


def test_a_rolling_bank_of_fewer_columns(tmp_path: Path) -> None:
    path = write_latent(tmp_path / "dense.safetensors", "surfaces")
    half = load_generator(path, columns=GRID.columns // 2)
    options: Any = {"columns": half.columns, "slots": 2, "threads": 1}
    with RollingBank(path, **options) as bank:
        [expected] = half.scans(0, [1])
        assert (bank.sensor, bank[1].sensor) == (half.sensor, half.sensor)
        assert bank[1].provenance == expected.provenance
        assert bank.identity.endswith(f":{half.columns} columns")


@pytest.mark.slow
def test_the_error_names_why_the_process_did_not_start(path: Path) -> None:
    with pytest.raises(
        ProcessError,
        match=r"died \(process \d+, exit code 1; .*device 'nowhere'|nowhere",
    ):
        RollingBank(path, device="nowhere", timeout=60)


@pytest.mark.slow
def test_a_closed_bank_raises_an_error(path: Path) -> None:
    bank = RollingBank(path, seed=SEED, slots=2, threads=1, timeout=60)
    assert bank[0].id == f"small/{SEED}/0"
    bank.close()
    bank.close()
    with pytest.raises(ConfigError, match="a rolling bank that is closed"):
        bank[1]
    assert bank.counts()["served"] == 1


def to_codes(scan: Scan, rng: np.random.Generator) -> tuple[str, dict[str, np.ndarray]]:
    return scan.id, codes(scan)


def mixed(synth: Any) -> MixedScans:
    return MixedScans(
        Scans("real", 12),
        synth,
        0.5,
        seed=SEED,
        reuse=2,
        to_sample=to_codes,
        collate=list,
        labels="generated",
    )


@pytest.mark.slow
def test_all_ways_of_loading_give_the_same_scans_for_the_same_plan(
    bank: RollingBank, generator: Generator
) -> None:
    inside = mixed(generator)
    rolling = mixed(bank)
    mixer = BatchMixer(mixed(generator), batch_size=5, num_workers=1)
    for epoch in (0, 2):
        for dataset in (inside, rolling, mixer.dataset):
            dataset.set_epoch(epoch)
        loaders = [
            DataLoader(inside, batch_size=5, num_workers=1, collate_fn=list),
            DataLoader(rolling, batch_size=5, num_workers=2, collate_fn=list),
            mixer,
        ]
        ways = [[sample for batch in loader for sample in batch] for loader in loaders]
        assert [len(way) for way in ways] == [24, 24, 24]
        # With reuse, the same ones come again in the next epoch.
        assert len({name for name, _ in ways[0] if name.startswith("small")}) == 12
        for first, *others in zip(*ways, strict=True):
            for other in others:
                assert other[0] == first[0]
                assert agree(other[1], first[1])


def test_batch_mixing_takes_a_batch_sampler_and_several_sources(
    bank: RollingBank, generator: Generator
) -> None:
    dataset = mixed(Sources(generator, bank))
    mixer = BatchMixer(dataset, batch_sampler=dataset.batches(4, rank=1, world_size=2))
    given = [sample for batch in mixer for sample in batch]
    assert len(mixer) == 3
    assert len(given) == 12
    positions = [i for batch in dataset.batches(4, rank=1, world_size=2) for i in batch]
    for position, (name, values) in zip(positions, given, strict=True):
        assert dataset[position][0] == name
        assert agree(values, dataset[position][1])
    resumed = dataset.batches(4)
    resumed.load_state_dict(make_state(dataset.mixture, 0, len(dataset)))
    assert list(BatchMixer(dataset, batch_sampler=resumed)) == []
    with pytest.raises(ConfigError, match="batch_size 0"):
        BatchMixer(dataset, 0)
    for options in ({}, {"batch_size": 2, "batch_sampler": resumed}):
        with pytest.raises(
            ConfigError,
            match="batch_size=.* and batch_sampler=.*; expected one of them",
        ):
            BatchMixer(dataset, **options)


def test_a_loop_that_is_left_early_leaves_no_thread(generator: Generator) -> None:
    mixer = BatchMixer(mixed(generator), batch_size=2)
    before = threading.active_count()
    for _ in mixer:
        break
    wait_until(lambda: threading.active_count() <= before)
