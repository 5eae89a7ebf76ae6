"""``MixedScans``: the same samples whatever the workers and ranks, real ones bit for bit, and clear refusals."""

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from mixtures import SENSOR, Endless, Scans, plain
from test_generator import SENSOR as GENERATED_SENSOR
from test_generator import write
from torch.utils.data import DataLoader

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import KITTI360, SemanticKITTI
from lidar_synth.generate.generator import Generator, load_generator
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.mixing import Generated, MixedScans, Sources, make_synthetic
from lidar_synth.mixing.state import make_state
from lidar_synth.noise import keyed_rng

WORKERS = [0, 1, 2, 4]

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


def shift(scan: Scan, rng: np.random.Generator) -> Scan:
    """An augmentation that draws."""
    return Scan(scan.points + rng.standard_normal(3).astype(np.float32), scan.reflectance, scan.sensor, scan.label,
                confidence=scan.confidence, id=scan.id, domain=scan.domain)  # fmt: skip


def mixed(real: int = 9, ratio: Any = 0.4, **options: Any) -> MixedScans:
    return MixedScans(Scans("r", real), Endless(), ratio, augment=shift, reuse=2, **options)


def loader(train: MixedScans, workers: int, **options: Any) -> DataLoader[Any]:
    return DataLoader(train, num_workers=workers, collate_fn=train.collate, **options)


def ids(train: MixedScans) -> list[str]:
    return [train[i]["id"] for i in range(len(train))]


def test_the_items_of_an_epoch() -> None:
    train = mixed()
    real = {scan.id: scan for scan in Scans("r", 9)}
    assert len(train) == 15
    items = [train[i] for i in range(15)]
    assert len({tuple(item) for item in items}) == 1
    assert sorted(i["id"] for i in items) == sorted([*real, *(f"s{i}" for i in range(6))])
    for i, item in enumerate(items):
        assert item["domain"] == train.domain(i) == (item["id"][0] == "s")
        if item["domain"] == 0:
            scan = real[item["id"]]
            assert item["points"].numpy().tobytes() == np.c_[scan.points, scan.reflectance].tobytes()
            assert np.array_equal(item["label"], scan.label)
            assert np.array_equal(item["confidence"], scan.label != IGNORE)
    assert train[-1]["id"] == items[-1]["id"]
    assert [item["id"] for item in train] == [item["id"] for item in items]  # iterating ends
    train.set_epoch(1)
    twice = [item["points"] for item in (*items, *train) if item["id"] == "s1"]
    assert not torch.equal(*twice)  # a scan that is given again is augmented anew


def test_what_is_drawn_for_a_sample_follows_from_seed_epoch_and_position() -> None:
    drawn: list[float] = []
    train = MixedScans(Scans("r", 3), Endless(), 0.5, seed=5, to_sample=lambda scan, rng: drawn.append(rng.random()))
    train.set_epoch(2)
    [train[i] for i in (4, 0)]
    assert drawn == [keyed_rng(5, 2, 4).random(), keyed_rng(5, 2, 0).random()]


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("workers", WORKERS)
def test_workers_change_nothing(workers: int, persistent: bool) -> None:
    train, alone = mixed(), mixed()
    load = loader(train, workers, batch_size=4, persistent_workers=persistent and workers > 0)
    for epoch in (0, 1, 5):
        train.set_epoch(epoch)
        alone.set_epoch(epoch)
        expected = [alone.collate([alone[i] for i in range(s, min(s + 4, 15))]) for s in range(0, 15, 4)]
        assert [plain(batch) for batch in load] == [plain(batch) for batch in expected]


def test_persistent_workers_that_were_spawned_see_the_epoch() -> None:
    train, alone = mixed(), mixed()
    load = loader(train, 1, batch_size=15, persistent_workers=True, multiprocessing_context="spawn")
    for epoch in (0, 3):
        train.set_epoch(epoch)
        alone.set_epoch(epoch)
        assert [batch["id"] for batch in load] == [ids(alone)]


def gathered(rank: int, ranks: int, port: int) -> None:
    """One rank: its epochs through workers, then all ranks' samples compared with one process's."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    dist.init_process_group("gloo", rank=rank, world_size=ranks)
    try:
        train = mixed()
        batches = train.batches(2)
        assert (batches.rank, batches.world_size) == (rank, ranks)
        load = loader(train, rank % 2, batch_sampler=batches, persistent_workers=rank % 2 > 0)
        for epoch in (0, 1):
            batches.set_epoch(epoch)
            mine = [item["points"].numpy().tobytes() for batch in load for item in _apart(batch)]
            every: list[Any] = [None] * ranks
            dist.all_gather_object(every, (len(batches), mine))
            assert len({steps for steps, _ in every}) == 1
            expected = [train[i]["points"].numpy().tobytes() for i in range(len(train))]
            assert sorted(x for _, part in every for x in part) == sorted(expected)
    finally:
        dist.destroy_process_group()


def _apart(batch: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for a, b in zip(batch["offsets"][:-1], batch["offsets"][1:], strict=True):
        yield {"points": batch["points"][a:b]}


@pytest.mark.parametrize(("ranks", "method"), [(2, "fork"), (3, "spawn")])
def test_ranks_divide_an_epoch_without_duplicates_or_loss(ranks: int, method: str, free_port: int) -> None:
    mp.start_processes(gathered, (ranks, free_port), nprocs=ranks, start_method=method)


@pytest.fixture
def free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.mark.parametrize("ranks", [1, 2, 3])
@pytest.mark.parametrize("done", range(5))
def test_going_on_with_other_ranks_and_workers_gives_the_rest(ranks: int, done: int) -> None:
    train = mixed(13)  # 22 samples
    train.set_epoch(1)
    every = ids(train)
    seen, state = [], {}
    for rank in range(ranks):
        sampler = train.batches(2, rank=rank, world_size=ranks)
        if len(sampler) < done:
            return
        seen += [every[i] for batch in list(sampler)[:done] for i in batch]
        state = sampler.state_dict(done)
    assert set(state) == {"version", "seed", "epoch", "position", "plan", "mixture"}
    for later in (1, 2, 3):
        rest = []
        for rank in range(later):
            again = mixed(13)
            sampler = again.batches(3, rank=rank, world_size=later)
            sampler.load_state_dict(state)
            again.set_epoch(state["epoch"])  # as a training loop does at the head of an epoch
            for batch in loader(again, (done + later) % 3, batch_sampler=sampler):
                rest += batch["id"]
        if state["epoch"] == 1:
            assert sorted(seen + rest) == sorted(every)
        else:
            train.set_epoch(2)
            assert sorted(rest) == sorted(ids(train))


def test_a_state_names_the_next_step_and_then_the_next_epoch() -> None:
    train = mixed()
    sampler = train.batches(4, rank=0, world_size=1)
    drawn = iter(sampler)
    assert sampler.state_dict() == make_state(train.mixture, 0, 0)
    next(drawn)
    assert sampler.state_dict() == make_state(train.mixture, 0, 4)
    assert len(list(drawn)) == 3
    assert sampler.state_dict() == make_state(train.mixture, 0, 15)
    assert sampler.state_dict(4) == make_state(train.mixture, 1, 0)
    sampler.load_state_dict(make_state(train.mixture, 2, 8))
    assert list(sampler) == [[8, 9, 10, 11], [12, 13, 14]]
    assert sampler.state_dict() == make_state(train.mixture, 2, 15)
    train.set_epoch(3)
    assert sampler.state_dict() == make_state(train.mixture, 3, 0)
    assert len(sampler) == 4
    assert len(train.batches(4, drop_last=True)) == 3


def test_balanced_batches() -> None:
    train = MixedScans(Scans("r", 24), Endless(), 0.25, balanced=True)
    for rank in range(2):
        for batch in train.batches(4, rank=rank, world_size=2):
            assert sum(train.domain(i) for i in batch) == 1


class Theirs:
    """A trainer's own dataset."""

    classes_of_theirs = ("car",)

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {"pts": np.full((3, 3), index, np.float32), "name": f"theirs{index}"}


def test_wrap_adds_nothing() -> None:
    def to_sample(scan: Scan, rng: np.random.Generator) -> dict[str, Any]:
        return {"pts": scan.points[:3].copy(), "name": scan.id}

    theirs = Theirs()
    train = MixedScans.wrap(theirs, Endless(), 0.5, to_sample=to_sample, seed=3)
    samples = [train[i] for i in range(len(train))]
    assert sorted(s["name"] for s in samples) == [*(f"s{i}" for i in range(5)), *(f"theirs{i}" for i in range(5))]
    for i, sample in enumerate(samples):
        if not train.domain(i):
            assert plain(sample) == plain(theirs[int(sample["name"][-1])])
        assert set(sample) == {"pts", "name"}
    assert train.classes_of_theirs == ("car",)
    assert not hasattr(train, "__getitems__")
    with pytest.raises(AttributeError, match="no_such_thing"):
        train.no_such_thing  # noqa: B018
    batches = list(DataLoader(train, batch_size=5, num_workers=2, collate_fn=train.collate))
    assert [name for batch in batches for name in batch["name"]] == [s["name"] for s in samples]


def test_several_sources() -> None:
    real = Sources(Scans("a", 4), Scans("b", 8))
    assert [len(real), real[0].id, real[4].id, real[11].id] == [12, "a0", "b0", "b7"]
    synth = Sources(Endless(name="x"), Scans("held", 3), weights=[2, 1])
    train = MixedScans(real, synth, 0.5, epoch_size=24)
    names = ids(train)
    assert sorted(n for n in names if n[0] in "ab") == sorted(s.id for s in [*Scans("a", 4), *Scans("b", 8)])
    assert sorted(n for n in names if n[0] == "x") == [f"x{i}" for i in range(8)]
    assert sorted(n for n in names if n[0] == "h") == ["held0", "held0", "held1", "held2"]
    assert all(train.domain(i) == train[i]["domain"] == (n[0] in "xh") for i, n in enumerate(names))


@pytest.mark.parametrize("labels", ["none", "ignore", "generated"])
def test_every_policy_gives_the_same_keys(labels: str) -> None:
    train = MixedScans(Scans("r", 3), Endless(), 0.5, labels=labels)
    for i in range(len(train)):
        item = train[i]
        valid = bool((item["label"] != IGNORE).any())
        assert valid == (labels == "generated" or not item["domain"])
        assert len(item["label"]) == len(item["confidence"]) == len(item["points"])
        if labels == "generated" and item["domain"]:
            assert set(item["confidence"].tolist()) == {0.5}


def test_a_batch_without_a_valid_label_is_refused() -> None:
    def synthetic_only(**options: Any) -> Any:
        train = MixedScans(Scans("r", 1), Endless(), 1, epoch_size=2, **options)
        return next(iter(loader(train, 0, batch_size=2)))

    message = r"without one valid label or box \(scans .*'s0'.*balanced=True.*unlabelled='allow'"
    with pytest.raises(DataError, match=message):
        synthetic_only(labels="ignore")
    assert (synthetic_only(labels="ignore", unlabelled="allow")["label"] == IGNORE).all()
    assert (synthetic_only(labels="none")["label"] == IGNORE).all()
    assert (synthetic_only(labels="generated")["label"] != IGNORE).any()


def test_forms_of_batches() -> None:
    items = [MixedScans(Scans("r", 2), Endless(), 0.5)[i] for i in range(3)]
    sizes = [len(item["points"]) for item in items]
    forms = {
        form: MixedScans(Scans("r", 2), Endless(), 0.5, collate=form).collate(items)  # type: ignore[arg-type]
        for form in ("offsets", "padded", "range")
    }
    offsets, padded, images = forms.values()
    assert offsets["offsets"].tolist() == np.cumsum([0, *sizes]).tolist()
    assert padded["points"].shape == (3, max(sizes), 4)
    assert images["range"].shape == images["label"].shape == (3, *SENSOR.shape)
    for b, item in enumerate(items):
        part = slice(*offsets["offsets"][b : b + 2].tolist())
        for key in ("points", "label", "confidence"):
            assert torch.equal(offsets[key][part], item[key])
            assert torch.equal(padded[key][b][padded["mask"][b]], item[key])
        assert (padded["label"][b][~padded["mask"][b]] == IGNORE).all()
        mask = images["mask"][b]
        nearest = item["points"][:, :3].norm(dim=1)
        assert all((nearest - r).abs().min() < 1e-4 for r in images["range"][b][mask])
        assert (images["label"][b][~mask] == IGNORE).all()
    for batch in forms.values():
        assert batch["domain"].tolist() == [item["domain"] for item in items]
        assert batch["id"] == [item["id"] for item in items]
        assert batch["boxes"].shape == (0, 7)
        assert batch["box_offsets"].tolist() == [0, 0, 0, 0]


@pytest.fixture(scope="module")
def generator(tmp_path_factory: pytest.TempPathFactory) -> Generator:
    return load_generator(write(tmp_path_factory.mktemp("mixing") / "tiny.safetensors"))


def test_the_generator_in_workers_makes_the_same_scans(generator: Generator) -> None:
    real = Scans("r", 4, GENERATED_SENSOR)
    train = MixedScans(real, generator, 0.5, seed=11)
    expected = {f"tiny/11/{i}": scan for i, scan in enumerate(generator.scans(11, range(4)))}
    for workers in (0, 2):
        items = [item for batch in DataLoader(train, 2, num_workers=workers, collate_fn=list) for item in batch]
        made = [item for item in items if item["domain"]]
        assert sorted(item["id"] for item in made) == sorted(expected)
        for item in made:
            scan = expected[item["id"]]
            assert np.allclose(item["points"][:, :3], scan.points, atol=1e-3)
            assert np.array_equal(item["label"], scan.label)
    assert train.mixture.synthetic[0].identity.startswith(f"generated:{generator.hash}:11:")


def test_a_cache_keeps_the_latest(generator: Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    scans = Generator.scans
    monkeypatch.setattr(Generator, "scans", lambda self, seed, n, *a, **k: made.extend(n) or scans(self, seed, n))
    source = Generated(generator, cache=2)
    assert source[0] is source[0]
    [source[i] for i in (1, 0, 2, 0, 1)]
    assert made == [0, 1, 2, 1]
    with pytest.raises(ConfigError, match="cache=-1"):
        Generated(generator, cache=-1)


def test_a_conditional_model_takes_its_conditions_in_turn(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="conditions for 'tiny'; expected none"):
        Generated(generator, condition=["a map"])
    monkeypatch.setattr(Generator, "condition", "semantic")
    with pytest.raises(ConfigError, match=r"no conditions for 'tiny'; expected .*\(semantic\).*condition=real"):
        MixedScans(Scans("r", 2, GENERATED_SENSOR), generator)
    calls: list[Any] = []
    monkeypatch.setattr(Generator, "scans", lambda self, *given, **options: calls.append((given, options)) or [None])
    source = Generated(generator, 3, condition=["a", "b"], steps=2)
    [source[n] for n in (0, 3)]
    assert calls == [((3, [0], ["a"]), {"steps": 2}), ((3, [3], ["b"]), {"steps": 2})]
    others = [Generated(generator, 3, condition=["a", "b"]), Generated(generator, 3, condition=["a"], steps=2)]
    assert len({source.identity, *(other.identity for other in others)}) == 3


def test_a_gpu_in_a_worker_is_refused(generator: Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    train = MixedScans(Scans("r", 2, GENERATED_SENSOR), generator, 0.5)
    monkeypatch.setattr(Generator, "device", torch.device("cuda"))
    with pytest.raises(ConfigError, match=r"inside a DataLoader worker.*\(A\) bake .*\(B\) .*\(C\) mix in"):
        list(loader(train, 1, batch_size=4))


class Ahead(Endless):
    """A source that works ahead."""

    def __init__(self) -> None:
        super().__init__()
        self.epochs: list[int] = []
        self.expected: list[int] = []

    def set_epoch(self, epoch: int) -> None:
        self.epochs.append(epoch)

    def expect(self, numbers: list[int]) -> None:
        self.expected = list(numbers)


def test_a_source_that_works_ahead_is_told_what_will_be_asked_for() -> None:
    source = Ahead()
    train = MixedScans(Scans("r", 6), source, 0.5)

    def asked(positions: range) -> list[int]:
        return [int(train[i]["id"][1:]) for i in positions if train.domain(i)]

    assert (source.epochs, source.expected) == ([0], asked(range(12)))
    train.set_epoch(1)
    assert (source.epochs, source.expected) == ([0, 1], asked(range(12)))
    sampler = train.batches(2, rank=1, world_size=2)
    list(sampler)
    assert source.expected == [n for start in (2, 6, 10) for n in asked(range(start, start + 2))]


def test_the_plan_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    train = mixed()
    with caplog.at_level(logging.INFO, "lidar_synth"):
        train.set_epoch(2)
        [train[i] for i in range(4)]
    assert caplog.messages == [f"epoch 2: 15 samples, 6 of them synthetic, plan {train.plan().hash[:16]}"]


def test_real_scans_are_untouched(real_scans: Path) -> None:
    reader = SemanticKITTI(real_scans / "semantic_kitti", split="train")
    synth = Scans("s", 3, load_sensor("town"))
    train = MixedScans(reader, synth, 0.25)
    expected = {scan.id: scan for scan in reader}
    seen = set()
    for batch in DataLoader(train, 2, num_workers=2, collate_fn=list):
        for item in batch:
            if item["domain"] == 0:
                scan = expected[item["id"]]
                assert item["points"].numpy().tobytes() == np.c_[scan.points, scan.reflectance].tobytes()
                assert item["label"].numpy().astype(np.uint8).tobytes() == scan.label.tobytes()
                seen.add(item["id"])
    assert seen == set(expected)
    pool = MixedScans(KITTI360(real_scans / "kitti360"), synth, 0.5, labels="none")
    batch = next(iter(loader(pool, 0, batch_size=3)))
    assert (batch["label"] == IGNORE).all()
    assert pool.domain(0) == int(batch["domain"][0])


def other_classes() -> Scans:
    scans = Scans("r", 2)
    scans.classes = ("road", "car")  # type: ignore[attr-defined]
    return scans


def wrong_labels() -> Any:
    scans = Scans("r", 1)
    scans[0].label[:] = 40
    return MixedScans(scans, ratio=0)[0]


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: mixed(ratio=1.01), ConfigError, r"ratio 1.01"),
        (lambda: mixed(ratio=[0.5]).set_epoch(1), ConfigError, r"epoch 1 of a ratio schedule for 1 epochs"),
        (lambda: mixed(real=0), DataError, r"a source without scans \(Scans:0:"),
        (lambda: mixed(labels="gessed"), ConfigError, r"labels='gessed'; expected one of"),
        (lambda: mixed(collate="voxels"), ConfigError, r"form='voxels' of batches"),
        (lambda: mixed(unlabelled="skip"), ConfigError, r"unlabelled='skip'"),
        (lambda: mixed()[15], IndexError, r"sample 15 of 15"),
        (lambda: mixed().batches(0), ConfigError, r"batch_size=0"),
        (lambda: mixed().batches(2, rank=2, world_size=2), ConfigError, r"rank 2 of 2"),
        (lambda: mixed().batches(2, rank=1), ConfigError, r"rank 1 of None"),
        (lambda: mixed().batches(2).state_dict(9), ConfigError, r"9 batches done of 8"),
        (lambda: mixed().batches(2).load_state_dict({"epoch": 1}), ConfigError, r"seed, epoch and position"),
        (lambda: mixed().batches(2).load_state_dict({"seed": 1, "epoch": 0, "position": 0}), ConfigError,
         r"seed 1 for a mixture of seed 0"),
        (lambda: MixedScans(Scans("r", 2), Endless(("reflectance",))), ConfigError,
         r"carry \['reflectance'\].*'ignore'"),
        (lambda: MixedScans(Scans("r", 2, load_sensor("os1_128")), Endless()), ConfigError,
         r"'os1_128' \(128 x 1024.*'small' \(8 x 32.*sensor=generator.sensor"),
        (lambda: MixedScans(Sources(Scans("r", 2), other_classes()), Endless()), ConfigError,
         r"labels mean \('road', 'car'\).*Taxonomy.decode"),
        (lambda: MixedScans(Theirs(), Endless()), ConfigError, r"of the type dict.*MixedScans.wrap"),
        (lambda: MixedScans(Scans("r", 2), "town"), ConfigError, r"str as a source of synthetic scans.*load_generator"),
        (lambda: MixedScans(Scans("r", 2), label_options={"threshold": 2}), ConfigError, r"without a synthetic source"),
        (lambda: Sources(), ConfigError, r"0 sources"),
        (lambda: Sources(Scans("r", 1), weights=[1, 2]), ConfigError, r"1 sources with weights \[1, 2\]"),
        (wrong_labels, DataError, r"labels \[40\]; expected train ids 0..18, or 255"),
    ],
)  # fmt: skip
def test_what_cannot_be_mixed(make: Callable[[], object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def test_sensors_that_look_the_same_way_may_be_mixed() -> None:
    kitti, far = load_sensor("hdl64e_semantic_kitti"), load_sensor("town")
    assert len(MixedScans(Scans("r", 3, kitti), Scans("s", 2, far), 0.25)) == 4
    other = Sensor("other", 32, 1.45, 80.0, rows=8, fov_up=2.0, fov_down=-25.0)
    with pytest.raises(ConfigError, match=r"'small' .* and 'other'"):
        MixedScans(Scans("r", 3), Scans("s", 2, other), 0.25)


def test_held_scans_become_synthetic() -> None:
    held = make_synthetic(Scans("h", 2))
    assert (held.length, held[1].domain, held[1].id) == (2, SYNTHETIC, "h1")
    assert "label" in held.fields


def test_fewer_samples_than_ranks_is_said() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(mixed(1, 0.0).batches(1, rank=0, world_size=2))
    assert "1 samples left for 2 ranks" in str(caught[0].message)


def test_the_rank_is_known_before_the_process_group_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "3")
    batches = mixed().batches(2)
    assert (batches.rank, batches.world_size) == (2, 3)
