"""``MixedScans``: the same samples whatever the workers and ranks, real ones bit for bit, and clear
refusals."""

import json
import logging
import os
import pickle
import warnings
from collections.abc import Iterator
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from mixed import Theirs, loader, mixed
from mixtures import SENSOR, Endless, Scans, plain
from torch.utils.data import DataLoader

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import SYNTHETIC, Boxes, Scan, model_provenance
from lidar_synth.lab.town import Town
from lidar_synth.mixing import MixedScans, MixedStream, Sources
from lidar_synth.mixing.collate import Form
from lidar_synth.mixing.state import make_state
from lidar_synth.noise import keyed_rng

WORKERS = [0, 1, 2, 4]

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


def ids(train: MixedScans) -> list[str]:
    return [train[i]["id"] for i in range(len(train))]


def test_the_items_of_an_epoch() -> None:
    train = mixed()
    real = {scan.id: scan for scan in Scans("r", 9)}
    assert len(train) == 15
    items = [train[i] for i in range(15)]
    assert len({tuple(item) for item in items}) == 1
    assert sorted(i["id"] for i in items) == sorted(
        [*real, *(f"s{i}" for i in range(6))]
    )
    for i, item in enumerate(items):
        assert item["domain"] == train.domain(i) == (item["id"][0] == "s")
        if item["domain"] == 0:
            scan = real[item["id"]]
            assert (
                item["points"].numpy().tobytes()
                == np.c_[scan.points, scan.reflectance].tobytes()
            )
            assert np.array_equal(item["label"], scan.label)
            assert np.array_equal(item["confidence"], scan.label != IGNORE)
    assert train[-1]["id"] == items[-1]["id"]
    # iterating ends
    assert [item["id"] for item in train] == [item["id"] for item in items]
    train.set_epoch(1)
    twice = [item["points"] for item in (*items, *train) if item["id"] == "s1"]
    assert not torch.equal(*twice)  # a scan that is given again is augmented anew


def test_a_plan_is_that_of_the_epoch_while_another_is_planned(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As another thread does it; the message is logged between the two."""
    train = mixed()

    def plan_another(record: logging.LogRecord) -> bool:
        if "epoch 0" in record.getMessage():
            train.plan(1)
        return True

    logger = logging.getLogger("lidar_synth.mixing.scans")
    logger.addFilter(plan_another)
    try:
        with caplog.at_level(logging.INFO, logger.name):
            assert train.plan(0).epoch == 0
    finally:
        logger.removeFilter(plan_another)
    assert "epoch 1" in caplog.text


def test_random_numbers_of_a_sample_depend_only_on_seed_epoch_and_position() -> None:
    drawn: list[float] = []
    train = MixedScans(
        Scans("r", 3),
        Endless(),
        0.5,
        seed=5,
        to_sample=lambda scan, rng: drawn.append(rng.random()),
    )
    train.set_epoch(2)
    [train[i] for i in (4, 0)]
    assert drawn == [keyed_rng(5, 2, 4).random(), keyed_rng(5, 2, 0).random()]


@pytest.mark.slow
@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("workers", WORKERS)
def test_the_number_of_workers_does_not_change_batches(
    workers: int, persistent: bool
) -> None:
    train = mixed()
    alone = mixed()
    load = loader(
        train, workers, batch_size=4, persistent_workers=persistent and workers > 0
    )
    for epoch in (0, 1, 5):
        train.set_epoch(epoch)
        alone.set_epoch(epoch)
        expected = [
            alone.collate([alone[i] for i in range(s, min(s + 4, 15))])
            for s in range(0, 15, 4)
        ]
        assert [plain(batch) for batch in load] == [plain(batch) for batch in expected]


@pytest.mark.slow
def test_persistent_workers_that_were_spawned_see_the_epoch() -> None:
    train = mixed()
    alone = mixed()
    load = loader(
        train,
        1,
        batch_size=15,
        persistent_workers=True,
        multiprocessing_context="spawn",
    )
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
        load = loader(
            train, rank % 2, batch_sampler=batches, persistent_workers=rank % 2 > 0
        )
        for epoch in (0, 1):
            batches.set_epoch(epoch)
            mine = [
                item["points"].numpy().tobytes()
                for batch in load
                for item in _apart(batch)
            ]
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


@pytest.mark.slow
@pytest.mark.parametrize(("ranks", "method"), [(2, "fork"), (3, "spawn")])
def test_ranks_divide_an_epoch_without_duplicates_or_loss(
    ranks: int, method: str, free_port: int
) -> None:
    mp.start_processes(gathered, (ranks, free_port), nprocs=ranks, start_method=method)


def divided_late(rank: int, port: int) -> None:
    """One rank: what is made, asked and resumed before the process group is divided after it."""
    train = mixed()
    load = train.loader(2, collate_fn=list)
    stream = MixedStream(train, batch_size=2, endless=False)
    assert (len(load), load.state_dict()["position"], stream.world_size) == (8, 0, 1)
    load.load_state_dict(make_state(train.mixture, 1, 3))
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    dist.init_process_group("gloo", rank=rank, world_size=2)
    try:
        assert (len(load), stream.world_size) == (4, 2)
        streamed = DataLoader(stream, 2, num_workers=1, collate_fn=list)
        for loader, first in ((load, 3), (streamed, 0)):
            expected = ids(train)[first:]
            every: list[Any] = [None] * 2
            seen = [item["id"] for batch in loader for item in batch]
            dist.all_gather_object(every, seen)
            assert sorted(every[0] + every[1]) == sorted(expected)
    finally:
        dist.destroy_process_group()


def test_a_loader_made_before_the_process_group_loads_its_share(free_port: int) -> None:
    mp.start_processes(divided_late, (free_port,), nprocs=2, start_method="fork")


@pytest.fixture
def free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2, 3])
@pytest.mark.parametrize("done", range(5))
def test_resuming_with_other_ranks_and_workers_yields_the_remaining_samples(
    ranks: int, done: int
) -> None:
    train = mixed(13)  # 22 samples
    train.set_epoch(1)
    every = ids(train)
    seen = []
    state = {}
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
            # as a training loop does at the head of an epoch
            again.set_epoch(state["epoch"])
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


@pytest.mark.parametrize("by", ["to_sample", "augment", "labels"])
def test_a_sample_that_is_changed_in_place_changes_no_scan(by: str) -> None:
    """Of sources that keep their scans in memory."""
    real = Scans("r", 4)
    kept = Scans("s", 4, domain=SYNTHETIC)
    for scan in (*real, *kept):
        scan.boxes = Boxes(np.float32([[9, 0, 0, 4, 2, 2, 0]]), ("Car",))
        scan.pose = np.eye(4)

    def flip(scan: Scan, rng: np.random.Generator) -> Scan:
        assert scan.boxes is not None and scan.pose is not None
        for values in (*scan.fields().values(), *vars(scan.boxes).values()):
            if isinstance(values, np.ndarray):
                values[:] = 1
        scan.points[:, 1] *= -1
        scan.pose[1] *= -1
        return scan

    before = pickle.dumps((real, kept))
    options: dict[str, Any] = {"augment_real": True, "unboxed": "keep", by: flip}
    train = MixedScans(real, kept, 0.5, **options)
    for i in range(len(train)):
        train[i]
    assert before == pickle.dumps((real, kept))


def test_a_provenance_that_cannot_be_copied_is_shared() -> None:
    real = Scans("r", 2)
    for scan in real:
        scan.provenance = MappingProxyType({"model": "theirs"})
    train = MixedScans(real, ratio=0, to_sample=lambda scan, rng: scan)
    assert all(train[i].provenance == {"model": "theirs"} for i in range(2))


def test_wrap_returns_samples_of_the_wrapped_dataset_unchanged() -> None:
    def to_sample(scan: Scan, rng: np.random.Generator) -> dict[str, Any]:
        return {"pts": scan.points[:3].copy(), "name": scan.id}

    theirs = Theirs()
    train = MixedScans.wrap(theirs, Endless(), 0.5, to_sample=to_sample, seed=3)
    samples = [train[i] for i in range(len(train))]
    assert sorted(s["name"] for s in samples) == [
        *(f"s{i}" for i in range(5)),
        *(f"theirs{i}" for i in range(5)),
    ]
    for i, sample in enumerate(samples):
        if not train.domain(i):
            assert plain(sample) == plain(theirs[int(sample["name"][-1])])
        assert set(sample) == {"pts", "name"}
    assert train.classes_of_theirs == ("car",)
    assert not hasattr(train, "__getitems__")
    with pytest.raises(AttributeError, match="no_such_thing"):
        train.no_such_thing  # noqa: B018
    batches = list(
        DataLoader(train, batch_size=5, num_workers=2, collate_fn=train.collate)
    )
    assert [name for batch in batches for name in batch["name"]] == [
        s["name"] for s in samples
    ]


def test_numbers_may_be_numpys() -> None:
    made = []
    for number, weights in ((np.int64, np.array([3, 1])), (int, [3, 1])):
        sources = Sources(Endless(), Endless(name="t"), weights=weights)
        options = {"seed": number(1), "reuse": number(2)}
        train = MixedScans(Scans("r", 6), sources, ratio=0.5, **options)
        stream = MixedStream(train, batch_size=number(4))
        states = [of.state_dict(1) for of in (stream, train.batches(number(4)))]
        made.append((ids(train), train.plan(0).hash, json.dumps(states)))
    assert made[0] == made[1]
    assert Town(np.int64(1), scans=2).identity == Town(1, scans=2).identity
    json.dumps(model_provenance("town", "", np.int64(3)))


def test_several_sources() -> None:
    real = Sources(Scans("a", 4), Scans("b", 8))
    assert [len(real), real[0].id, real[4].id, real[-1].id] == [12, "a0", "b0", "b7"]
    synth = Sources(Endless(name="x"), Scans("held", 3), weights=[2, 1])
    train = MixedScans(real, synth, 0.5, epoch_size=24)
    names = ids(train)
    assert sorted(n for n in names if n[0] in "ab") == sorted(
        s.id for s in [*Scans("a", 4), *Scans("b", 8)]
    )
    assert sorted(n for n in names if n[0] == "x") == [f"x{i}" for i in range(8)]
    assert sorted(n for n in names if n[0] == "h") == [
        "held0",
        "held0",
        "held1",
        "held2",
    ]
    assert all(
        train.domain(i) == train[i]["domain"] == (n[0] in "xh")
        for i, n in enumerate(names)
    )


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

    message = r"without any valid label or box \(scans .*'s0'.*balanced=True.*unlabelled='allow'"
    with pytest.raises(DataError, match=message):
        synthetic_only(labels="ignore")
    assert (
        synthetic_only(labels="ignore", unlabelled="allow")["label"] == IGNORE
    ).all()
    assert (synthetic_only(labels="none")["label"] == IGNORE).all()
    assert (synthetic_only(labels="generated")["label"] != IGNORE).any()


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("form", ["map", "stream"])
def test_a_loader_without_collate_fn_is_told_which(form: str, workers: int) -> None:
    """Scans differ in size; those of one size make a batch as torch makes it."""
    train = MixedScans(Scans("r", 9), Endless(), 0.25)
    dataset: Any = train if form == "map" else MixedStream(train, batch_size=2)
    with pytest.raises(ConfigError, match=r"collate_fn=train\.collate"):
        next(iter(DataLoader(dataset, 2, num_workers=workers)))
    one = next(iter(DataLoader(dataset, 1, num_workers=workers)))
    assert one["points"].shape == (1, *train[0]["points"].shape) and one["id"] == [
        train[0]["id"]
    ]


def test_forms_of_batches() -> None:
    items = [MixedScans(Scans("r", 2), Endless(), 0.5)[i] for i in range(3)]
    sizes = [len(item["points"]) for item in items]
    forms = {
        form: MixedScans(
            Scans("r", 2),
            Endless(),
            0.5,
            collate=form,  # type: ignore[arg-type]
        ).collate(items)
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


def test_another_default_dtype_does_not_change_batches() -> None:
    train = MixedScans(Scans("r", 2), Endless(), 0.5)
    torch.set_default_dtype(torch.float64)
    try:
        batch = train.collate([train[0]])
    finally:
        torch.set_default_dtype(torch.float32)
    assert batch["loss_weight"].dtype == batch["points"].dtype == torch.float32


@pytest.mark.parametrize("form", ["offsets", "padded", "range"])
def test_another_default_device_does_not_change_batches(form: Form) -> None:
    def batch() -> Any:
        train = MixedScans(Scans("r", 2), Endless(), 0.5, collate=form)
        return train.collate([train[0], train[1]])

    with torch.device("meta"):
        elsewhere = batch()
    assert plain(elsewhere) == plain(batch())


def test_fewer_samples_than_ranks_gives_a_warning() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(mixed(1, 0.0).batches(1, rank=0, world_size=2))
    assert "1 samples left for 2 ranks" in str(caught[0].message)


def test_the_rank_is_known_before_the_process_group_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "3")
    batches = mixed().batches(2)
    assert (batches.rank, batches.world_size) == (2, 3)
