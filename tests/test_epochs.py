"""What is fetched belongs to the epoch in which iterating began, or it raises; repeated epochs are
said once."""

import copy
import pickle
import sys
import time
import warnings
from collections.abc import Iterator
from itertools import islice
from multiprocessing import Queue
from threading import Thread
from typing import Any

import pytest
from mixtures import Endless, Scans, Told
from torch.utils.data import (
    ConcatDataset,
    DataLoader,
    DistributedSampler,
    RandomSampler,
    Subset,
    random_split,
)

from lidar_synth.errors import ConfigError
from lidar_synth.mixing import MixedScans, MixedStream
from lidar_synth.mixing.epochs import Position
from lidar_synth.mixing.state import make_state

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")

REAL = 200
queues: list[Any] = []
LATE = (
    r"set_epoch\(1\) while a DataLoader was iterating over epoch 0.*before iter.*"
    r"batch_sampler=train.batches"
)


def mixed(real: int = REAL, ratio: Any = 0.25, **options: Any) -> MixedScans:
    scans = Scans("r", 1) * real
    return MixedScans.wrap(
        [f"r{i}" for i in range(len(scans))],
        Endless(),
        ratio,
        to_sample=name,
        **options,
    )


def name(scan: Any, rng: Any) -> str:
    return str(scan.id)


def planned(train: MixedScans, epoch: int) -> list[str]:
    made = train.plan(epoch)
    return [
        f"{'s' if d else 'r'}{i}" for d, i in zip(made.domain, made.index, strict=True)
    ]


def samples(batches: Any) -> list[str]:
    return [sample for batch in batches for sample in batch]


def refused(iterator: Any, message: str, *, last: bool = True) -> None:
    """Going on raises; torch would then wait 5 s for each worker to end by itself."""
    with pytest.raises(ConfigError, match=message):
        list(iterator)
    for worker in getattr(iterator, "_workers", ()) if last else ():
        worker.terminate()


def samplers(train: MixedScans) -> dict[str, dict[str, Any]]:
    """Ways to go through it that do not carry the epoch."""
    return {
        "in order": {"batch_size": 4},
        "shuffled": {"batch_size": 4, "shuffle": True},
        "distributed": {"batch_size": 4, "sampler": DistributedSampler(train, 1, 0)},
        "random": {"batch_size": 4, "sampler": RandomSampler(train)},
    }


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("way", ["in order", "shuffled", "distributed", "random"])
@pytest.mark.parametrize("workers", [0, 2])
def test_an_epoch_that_is_set_after_iter_raises(
    workers: int, way: str, persistent: bool
) -> None:
    """In the first pass, and in a later one of persistent workers."""
    train = mixed()
    loader = DataLoader(
        train,
        num_workers=workers,
        collate_fn=list,
        persistent_workers=persistent and workers > 0,
        **samplers(train)[way],
    )
    iterator = iter(loader)
    next(iterator)
    train.set_epoch(1)
    refused(iterator, LATE, last=not loader.persistent_workers)
    assert sorted(samples(loader)) == sorted(planned(train, 1))  # set in time now
    iterator = iter(loader)
    next(iterator)
    train.set_epoch(2)
    refused(iterator, r"set_epoch\(2\) while .* epoch 1")


@pytest.mark.parametrize("workers", [0, 2])
def test_a_hook_at_the_beginning_of_an_epoch(workers: int) -> None:
    """As trainers call it: after ``iter``, before the first batch. Workers have begun to fetch."""
    train = mixed()
    iterator = iter(DataLoader(train, 4, num_workers=workers, collate_fn=list))
    time.sleep(0.3 * (workers > 0))
    train.set_epoch(1)
    if workers:
        refused(iterator, LATE)
    else:
        assert samples(iterator) == planned(train, 1)


def start_slowly(worker: int) -> None:
    """With threads of its own, such as a logger's and those of queues."""
    Thread(target=time.sleep, args=(60,), daemon=True).start()
    queues.append(Queue())
    queues[0].put(worker)
    time.sleep(0.5)


def test_a_slow_worker_starts_in_the_epoch_in_which_its_pass_began() -> None:
    """It has fetched nothing yet, but the others may have."""
    train = mixed()
    loader = DataLoader(
        train, 4, num_workers=1, collate_fn=list, worker_init_fn=start_slowly
    )
    iterator = iter(loader)
    train.set_epoch(1)
    refused(iterator, LATE)


def test_a_worker_that_gets_its_first_sample_in_a_later_pass() -> None:
    train = mixed(9)
    both: Any = ConcatDataset([train, ["x"] * 2])
    order = [[0, 1], [len(train), len(train) + 1]]  # a batch for each worker
    loader = DataLoader(
        both,
        batch_sampler=order,
        num_workers=2,
        collate_fn=list,
        persistent_workers=True,
    )
    assert samples(loader) == [*planned(train, 0)[:2], "x", "x"]
    train.set_epoch(1)
    order.reverse()
    assert samples(loader) == ["x", "x", *planned(train, 1)[:2]]


def test_workers_that_resume_at_the_end_of_an_epoch_begin_with_the_next() -> None:
    kind = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
    options = {"num_workers": 2, "collate_fn": list, "persistent_workers": True}
    train = mixed(9)
    loader = kind(train, 4, **options)
    states = [loader.state_dict() for _ in loader]
    again = kind(train, 4, **options)
    again.load_state_dict(states[-1])
    assert samples(again) == []
    train.set_epoch(1)
    assert samples(again) == planned(train, 1)


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("workers", [0, 2])
def test_batches_keep_the_epoch_in_which_iterating_began(
    workers: int, persistent: bool
) -> None:
    train = mixed()
    batches = train.batches(4)
    loader = DataLoader(
        train,
        batch_sampler=batches,
        num_workers=workers,
        collate_fn=list,
        persistent_workers=persistent and workers > 0,
    )
    for epoch in range(3):
        iterator = iter(loader)
        train.set_epoch(epoch + 1)
        first = next(iterator)
        batches.set_epoch(epoch + 1)
        assert first + samples(iterator) == planned(train, epoch)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_part_of_a_mixture_is_refused_and_a_part_of_its_real_scans_stays_apart(
    workers: int,
) -> None:
    train = mixed()
    part, other = random_split(train, [0.8, 0.2])
    nested = Subset(ConcatDataset([train, train]), [0])
    for dataset in (
        part,
        ConcatDataset([train, other]),
        ConcatDataset([ConcatDataset([other, train]), train]),
        ConcatDataset([nested, train]),
    ):
        refused(
            iter(DataLoader(dataset, 4, collate_fn=list, num_workers=workers)),
            r"random_split\(real, \[0.9, 0.1\]\)",
        )
    others: Any = Subset(["x", "y"], [1])  # type: ignore[arg-type]
    joined = DataLoader(ConcatDataset([train, others]), 4, collate_fn=list)
    assert samples(joined) == [*planned(train, 0), "y"]
    kept, held = random_split(Scans("r", 20), [0.8, 0.2])  # type: ignore[arg-type]
    train = MixedScans(kept, Endless(), to_sample=name, collate=list)
    loader = DataLoader(
        train, batch_sampler=train.batches(4), collate_fn=list, num_workers=workers
    )
    for epoch in range(2):
        train.set_epoch(epoch)
        seen = {sample for sample in samples(loader) if sample[0] == "r"}
        assert seen == {scan.id for scan in Scans("r", 20)} - {scan.id for scan in held}


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_mixture_as_the_real_source_follows_the_epoch(
    workers: int, persistent: bool
) -> None:
    inner = mixed(4, 0.5)
    train = MixedScans.wrap(inner, Endless(name="t"), 0.5, to_sample=name)
    keep = persistent and workers > 0
    options: dict[str, Any] = {"collate_fn": list, "persistent_workers": keep}
    for loader in (
        train.loader(4, workers, **options),
        DataLoader(train, 4, num_workers=workers, **options),
    ):
        for epoch in (0, 1, 2):
            loader.dataset.set_epoch(epoch)
            seen = [sample for sample in samples(loader) if sample[0] != "t"]
            assert sorted(seen) == sorted(planned(inner, epoch))


def test_real_sources_in_persistent_workers_hear_of_every_epoch() -> None:
    train = MixedScans.wrap(Told(9), Endless(), 0.25, to_sample=name)
    loader = train.loader(2, 2, collate_fn=list, persistent_workers=True)
    for epoch in range(3):
        real = [sample for sample in samples(loader) if sample[0] == "r"]
        assert sorted(real) == [f"r{i} of epoch {epoch}" for i in range(9)]


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("workers", [0, 1, 2])
def test_a_stream_keeps_the_epoch_in_which_iterating_began(
    workers: int, endless: bool
) -> None:
    train = mixed(40)
    stream = MixedStream(train, batch_size=4, endless=endless)
    stream.set_epoch(3)
    iterator: Any = iter(DataLoader(stream, 4, num_workers=workers, collate_fn=list))
    stream.set_epoch(5)
    assert samples(islice(iterator, 10)) == planned(train, 3)[:40]
    # torch would wait for those of an endless stream
    for worker in getattr(iterator, "_workers", ()):
        worker.terminate()


def test_a_streams_persistent_workers_keep_it_or_raise() -> None:
    train = mixed(40)
    stream = MixedStream(train, batch_size=4, endless=False)
    loader = DataLoader(
        stream, 4, num_workers=2, collate_fn=list, persistent_workers=True
    )
    assert samples(loader) == planned(train, 0)
    stream.set_epoch(1)
    iterator = iter(loader)
    next(iterator)
    stream.set_epoch(2)
    refused(iterator, r"set_epoch\(2\) while .* epoch 1")


@pytest.mark.parametrize("form", ["map", "stream"])
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_persistent_workers_of_a_copy_see_the_epoch(copied: Any, form: str) -> None:
    train = mixed(9)
    stream = MixedStream(train, batch_size=4, endless=False)
    ours = copied(stream if form == "stream" else train)
    loader = DataLoader(
        ours, 4, num_workers=1, collate_fn=list, persistent_workers=True
    )
    for epoch in range(2):
        ours.set_epoch(epoch)
        assert samples(loader) == planned(train, epoch)
    if form == "stream":
        ours.load_state_dict(make_state(train.mixture, 2, 8))
        assert samples(loader) == planned(train, 2)[8:]


def test_indexing_by_hand_takes_the_epoch_that_is_set() -> None:
    train = mixed(9)
    assert [train[i] for i in range(len(train))] == planned(train, 0)
    train.set_epoch(1)
    assert [train[i] for i in range(len(train))] == planned(train, 1)
    assert train[Position(2, 0)] == planned(train, 0)[2]
    assert train.domain(Position(2, 0)) == int(planned(train, 0)[2][0] == "s")


def test_a_position_survives_copies_and_is_an_integer() -> None:
    position = Position(5, 3)
    for copied in (pickle.loads(pickle.dumps(position)), copy.deepcopy(position)):
        assert (copied, copied.epoch, type(copied)) == (5, 3, Position)
    assert [10, 11, 12, 13, 14, 15][position] == 15


@pytest.fixture
def caught() -> Iterator[list[warnings.WarningMessage]]:
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        yield messages


AGAIN = "epoch 0 begins again"


def test_a_repeated_epoch_gives_one_warning(
    caught: list[warnings.WarningMessage],
) -> None:
    for carried in (False, True):
        train = mixed(9, seed=1 + carried)  # a plan that no other mixture has warned of
        how: dict[str, Any] = (
            {"batch_sampler": train.batches(4)} if carried else {"batch_size": 4}
        )
        loader = DataLoader(train, collate_fn=list, **how)
        [train[i] for i in range(3)]  # a look at some samples is no pass
        list(loader)
        assert not caught
        list(loader)
        list(loader)
        assert [str(w.message)[: len(AGAIN)] for w in caught] == [AGAIN]
        caught.clear()
        for epoch in range(1, 4):
            train.set_epoch(epoch)
            list(loader)
        assert not caught


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("way", ["in order", "batches", "stream"])
def test_a_mixture_that_is_made_anew_for_each_epoch_is_noticed(
    way: str, told: bool, caught: list[warnings.WarningMessage]
) -> None:
    for epoch in range(3):
        train = mixed(9, seed=len(way))
        if told:
            train.set_epoch(epoch)
        ways: dict[str, Any] = {
            "in order": DataLoader(train, 4, collate_fn=list),
            "batches": DataLoader(
                train, batch_sampler=train.batches(4), collate_fn=list
            ),
            "stream": DataLoader(
                MixedStream(train, batch_size=4, endless=False), 4, collate_fn=list
            ),
        }
        loader = ways[way]
        assert samples(loader) == planned(train, epoch if told else 0)
    assert [str(w.message)[: len(AGAIN)] for w in caught] == [AGAIN] * (not told)


def show_warnings(worker: int) -> None:
    """As outside of pytest, which keeps them to itself."""
    warnings.showwarning = lambda message, *_: print(
        message, file=sys.stderr, flush=True
    )  # type: ignore[assignment]


def test_workers_say_that_an_epoch_comes_again(
    capfd: pytest.CaptureFixture[str],
) -> None:
    loader = DataLoader(
        mixed(20), 4, num_workers=2, collate_fn=list, worker_init_fn=show_warnings
    )
    list(loader)
    assert AGAIN not in capfd.readouterr().err
    list(loader)
    list(loader)
    assert capfd.readouterr().err.count(AGAIN) == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_a_pass_of_several_epochs_points_to_a_stream(
    workers: int,
    caught: list[warnings.WarningMessage],
    capfd: pytest.CaptureFixture[str],
) -> None:
    train = mixed(20)
    for epochs in (2, 3):
        train.set_epoch(epochs)
        sampler = RandomSampler(train, num_samples=epochs * len(train))
        loader = DataLoader(
            train,
            4,
            sampler=sampler,
            num_workers=workers,
            collate_fn=list,
            worker_init_fn=show_warnings,
        )
        list(loader)
        said = capfd.readouterr().err + "".join(str(w.message) for w in caught)
        assert ("without set_epoch" in said) == (epochs == 3)


@pytest.mark.parametrize("done", [0, 1])
def test_resuming_in_an_epoch_is_no_repetition(
    done: int, caught: list[warnings.WarningMessage]
) -> None:
    for make in (
        lambda: mixed(9, seed=10 + done).batches(4),
        lambda: MixedStream(mixed(9, seed=20 + done), batch_size=4, endless=False),
    ):
        whole = make()
        list(whole)
        state = whole.state_dict(done)
        whole.load_state_dict(state)
        list(whole)
        assert not caught
        list(whole)
        assert [str(w.message)[: len(AGAIN)] for w in caught] == [AGAIN]
        caught.clear()


def test_a_long_plan_starts_at_once() -> None:
    """No list of all positions, steps or scans is made on the way to the first batch."""
    train = MixedScans.wrap(
        range(75_000_000), Endless(), 0.25, to_sample=name, compare=False
    )
    assert len(train) == 10**8
    loader = DataLoader(train, batch_sampler=train.batches(8), collate_fn=list)
    assert len(loader) == 10**8 // 8
    assert len(next(iter(loader))) == 8
    stream = MixedStream(train, batch_size=8, endless=False)
    stream.load_state_dict(train.batches(8).state_dict(12_499_999))
    assert len(list(stream)) == 8


class EverySecond:
    """A library that shares batches among two processes, whoever did so before."""

    def __init__(self, batches: Any) -> None:
        self.batches = batches

    def __iter__(self) -> Iterator[list[int]]:
        return islice(self.batches, 0, None, 2)


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_that_are_shared_twice_are_noticed_at_the_next_pass(
    workers: int, caught: list[warnings.WarningMessage]
) -> None:
    for ranks, shared in ((2, True), (2, False), (1, True)):
        train = mixed(39)
        batches = train.batches(4, rank=0, world_size=ranks)
        sampler: Any = EverySecond(batches) if shared else batches
        loader = DataLoader(
            train, batch_sampler=sampler, num_workers=workers, collate_fn=list
        )
        list(loader)
        train.set_epoch(1)
        list(loader)
        expected = ["of 26 samples for rank 0 of 2,"] if shared and ranks == 2 else []
        assert [
            str(w.message)[:30] for w in caught if "library" in str(w.message)
        ] == expected
        caught.clear()
