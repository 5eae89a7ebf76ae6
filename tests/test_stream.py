"""``MixedStream``: the plan's order for every number of workers, with an end or without, and going
on from a state."""

import copy
from collections.abc import Iterator
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mixtures import Endless, Scans, Told
from torch.utils.data import DataLoader

import lidar_synth.mixing.stream as module
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans, MixedStream
from lidar_synth.mixing.state import make_state

WORKERS = [0, 1, 2, 4]

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


def name(scan: Scan, rng: np.random.Generator) -> str:
    return f"{scan.id}/{rng.random()}"


def mixed(real: int = 9, **options: Any) -> MixedScans:
    """15 samples an epoch."""
    return MixedScans(
        Scans("r", real),
        Endless(),
        0.4,
        to_sample=lambda scan, rng: f"{scan.id}/{rng.random()}",
        **options,
    )


def state(epoch: int, position: int) -> dict[str, Any]:
    """The state at a position of ``mixed()``."""
    return make_state(mixed().mixture, epoch, position)


def sequence(epochs: int = 6) -> list[str]:
    """What stands in the plan, epoch after epoch."""
    scans = mixed()
    return [scans.sample(epoch, i) for epoch in range(epochs) for i in range(15)]


def load(stream: MixedStream, workers: int, **options: Any) -> DataLoader[Any]:
    return DataLoader(
        stream, stream.batch_size, num_workers=workers, collate_fn=list, **options
    )


def cut(samples: list[str], size: int) -> list[list[str]]:
    return [samples[i : i + size] for i in range(0, len(samples), size)]


@pytest.mark.parametrize("workers", WORKERS)
def test_without_end_epochs_follow_one_another(workers: int) -> None:
    stream = MixedStream(mixed(), batch_size=4)
    assert list(islice(load(stream, workers), 12)) == cut(sequence()[:48], 4)
    stream.set_epoch(3)
    assert list(islice(load(stream, workers), 5)) == cut(sequence()[45:65], 4)


class Refreshed(Endless):
    """Remembers the epochs that it was told, as a pool that is refreshed does."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[int] = []

    def set_epoch(self, epoch: int) -> None:
        self.told.append(epoch)

    def expect(self, numbers: object) -> None:
        pass


def test_without_end_the_synthetic_source_hears_of_every_epoch() -> None:
    source = Refreshed()
    scans = MixedScans(Scans("r", 9), source, 0.4, to_sample=name)
    list(islice(iter(MixedStream(scans, batch_size=4)), 40))
    assert source.told == [0, 1, 2]
    assert scans.epoch == 0  # that of the data set stays


@pytest.mark.parametrize("workers", [0, 2, 3])
@pytest.mark.parametrize("nested", [False, True])
def test_without_end_real_sources_hear_of_every_epoch(
    nested: bool, workers: int
) -> None:
    """In every worker; also those of a mixture in the mixture."""

    def make() -> MixedScans:
        real: Any = Told(9)
        if nested:
            real = MixedScans.wrap(real, Endless(name="t"), 0.5, to_sample=name)
        return MixedScans.wrap(real, Endless(), 0.4, to_sample=name)

    scans = make()
    loader = load(MixedStream(scans, batch_size=4), workers)
    seen = [sample for batch in islice(loader, 15) for sample in batch]
    assert scans.epoch == 0
    expected = []
    scans = make()
    for epoch in range(4):
        scans.set_epoch(epoch)
        expected += [scans[i] for i in range(len(scans))]
    assert seen == expected[:60]


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize(("size", "ranks"), [(4, 1), (4, 2), (7, 2), (7, 4)])
def test_the_length_is_that_of_a_ranks_share(
    size: int, ranks: int, drop_last: bool
) -> None:
    for rank in range(ranks):
        stream = MixedStream(
            mixed(),
            batch_size=size,
            endless=False,
            drop_last=drop_last,
            rank=rank,
            world_size=ranks,
        )
        loader = load(stream, 2 if size < 7 else 0)
        batches = list(loader)
        assert len(stream) == sum(map(len, batches))
        assert len(loader) == len(batches)
    endless = MixedStream(mixed(), batch_size=size)
    assert endless
    with pytest.raises(TypeError, match="endless=False"):
        len(load(endless, 0))


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_and_workers_divide_the_stream(ranks: int, endless: bool) -> None:
    given: list[str] = []
    for rank in range(ranks):
        stream = MixedStream(
            mixed(), batch_size=2, endless=endless, rank=rank, world_size=ranks
        )
        # 30 samples, whole steps for 2 and 3 ranks, are two epochs
        given += [
            x
            for batch in islice(load(stream, rank), 12 // ranks if endless else None)
            for x in batch
        ]
    assert sorted(given) == sorted(sequence()[: 24 if endless else 15])


def test_the_last_samples_may_be_left_out() -> None:
    given = []
    for rank in range(2):
        stream = MixedStream(
            mixed(),
            batch_size=2,
            endless=False,
            drop_last=True,
            rank=rank,
            world_size=2,
        )
        given.append(list(load(stream, 0)))
    assert [len(batches) for batches in given] == [3, 3]
    assert sorted(x for batches in given for batch in batches for x in batch) == sorted(
        sequence()[:12]
    )


def test_the_remainder_is_a_batch_of_its_own() -> None:
    given = [
        MixedStream(mixed(), batch_size=7, endless=False, rank=rank, world_size=2)
        for rank in range(2)
    ]
    assert [[len(batch) for batch in load(stream, 0)] for stream in given] == [
        [7, 1],
        [7],
    ]
    assert given[0].state_dict(1) == state(0, 14)
    assert given[0].state_dict(2) == state(1, 0)


@pytest.mark.slow
@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("done", range(5))
@pytest.mark.parametrize(
    ("before", "after"),
    [((1, 0), (2, 1)), ((2, 2), (1, 0)), ((2, 1), (3, 2)), ((3, 0), (1, 2))],
)
def test_a_state_fits_any_number_of_ranks_and_workers(
    before: tuple[int, int], after: tuple[int, int], done: int, endless: bool
) -> None:
    seen = []
    states = []
    for rank in range(before[0]):
        stream = MixedStream(
            mixed(), batch_size=2, endless=endless, rank=rank, world_size=before[0]
        )
        iterator = iter(load(stream, before[1]))
        batches = list(islice(iterator, done))
        if len(batches) < done:
            return
        seen += [x for batch in batches for x in batch]
        states.append(stream.state_dict(done))
    assert states == [states[0]] * before[0]
    assert set(states[0]) == {"version", "seed", "epoch", "position", "plan", "mixture"}
    rest = []
    for rank in range(after[0]):
        stream = MixedStream(
            mixed(), batch_size=3, endless=endless, rank=rank, world_size=after[0]
        )
        stream.load_state_dict(states[0])
        rest += [
            x
            for batch in islice(
                load(stream, after[1]), 24 // 3 // after[0] if endless else None
            )
            for x in batch
        ]
    length = len(seen) + 24 // (3 * after[0]) * 3 * after[0] if endless else 15
    if states[0]["epoch"] == 1 and not endless:
        assert sorted(rest) == sorted(sequence()[15:30])
    else:
        assert sorted(seen + rest) == sorted(sequence()[:length])


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("given", range(15))
def test_without_workers_the_stream_tracks_its_position(
    given: int, endless: bool
) -> None:
    stream = MixedStream(mixed(), batch_size=4, endless=endless)
    iterator = iter(stream)
    seen = list(islice(iterator, given))
    after = stream.state_dict()
    again = MixedStream(mixed(), batch_size=4, endless=endless)
    again.load_state_dict(after)
    assert seen + list(islice(again, 15 - given)) == sequence()[:15]
    assert ("given" in after) == (given % 4 > 0)


def test_after_the_end_comes_the_next_epoch() -> None:
    stream = MixedStream(mixed(), batch_size=4, endless=False)
    assert len(list(stream)) == 15
    assert stream.state_dict(4) == state(1, 0)
    assert stream.state_dict() == state(0, 15)
    assert list(stream) == sequence()[:15]  # until set_epoch says otherwise
    stream.load_state_dict(state(1, 5))
    stream.set_epoch(1)
    assert list(stream) == sequence()[20:30]
    stream.scans.set_epoch(2)
    assert stream.state_dict() == state(2, 0)
    assert list(stream) == sequence()[30:45]


def test_an_epochs_end_that_is_loaded_after_the_next_has_begun() -> None:
    """As ``StatefulDataLoader`` does it, which loads when it begins to iterate."""
    end = state(0, 15)
    for make in (
        lambda: MixedStream(mixed(), batch_size=4, endless=False),
        lambda: mixed().batches(4),
    ):
        resumed = make()
        resumed.load_state_dict(end)
        assert list(resumed) == []
        resumed = make()
        resumed.set_epoch(1)
        resumed.load_state_dict(end)
        assert resumed.state_dict() == state(1, 0)
        assert len(list(resumed)) == (15 if isinstance(resumed, MixedStream) else 4)


def test_a_workers_state_leaves_the_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream = MixedStream(mixed(), batch_size=4, endless=False)
    stream.set_epoch(3)
    monkeypatch.setattr(
        module, "get_worker_info", lambda: SimpleNamespace(id=1, num_workers=2)
    )
    list(stream)
    after = stream.state_dict()
    stream.set_epoch(4)
    stream.load_state_dict(after)
    assert list(stream) == []
    assert stream.scans.epoch == 4
    assert list(stream) == sequence()[64:68] + sequence()[72:75]


def test_persistent_workers_hear_of_a_state() -> None:
    stream = MixedStream(mixed(), batch_size=4, endless=False)
    loader = load(stream, 2, persistent_workers=True)
    assert len(list(loader)) == 4
    stream.load_state_dict(state(2, 7))
    assert list(loader) == cut(sequence()[37:45], 4)


class Worker:
    """A worker as ``StatefulDataLoader`` drives it: a copy of the dataset whose state is taken
    after each batch."""

    def __init__(
        self, stream: MixedStream, id: int, workers: int, state: dict[str, Any] | None
    ) -> None:
        self.info = SimpleNamespace(id=id, num_workers=workers)
        self.stream = copy.deepcopy(stream)
        with self:
            if state is not None:
                self.stream.load_state_dict(state)
            self.samples = iter(self.stream)
            self.state = self.stream.state_dict()

    def __enter__(self) -> None:
        module.get_worker_info = lambda: self.info  # type: ignore[assignment]

    def __exit__(self, *_: object) -> None:
        module.get_worker_info = lambda: None  # type: ignore[assignment]

    def batch(self) -> list[str]:
        with self:
            samples = list(islice(self.samples, self.stream.batch_size))
            self.state = self.stream.state_dict()
            return samples


def driven(workers: list[Worker], turn: int = 0) -> Iterator[list[str]]:
    """Batches in the workers' turns until all have ended."""
    running = set(range(len(workers)))
    while running:
        for worker in [w for w in range(turn, len(workers)) if w in running]:
            if batch := workers[worker].batch():
                yield batch
            else:
                running.discard(worker)
        turn = 0


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("done", range(6))
def test_workers_with_a_state_each(
    workers: int, done: int, endless: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """torchdata's protocol without torchdata."""
    monkeypatch.setattr(module, "get_worker_info", lambda: None)
    stream = MixedStream(mixed(), batch_size=3, endless=endless)
    expected = cut(sequence()[: 30 if endless else 15], 3)
    first = [Worker(stream, w, workers, None) for w in range(workers)]
    seen = list(islice(driven(first), done))
    again = [Worker(stream, w, workers, first[w].state) for w in range(workers)]
    rest = islice(driven(again, done % workers), 10 - done if endless else None)
    assert seen + list(rest) == expected


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("done", [0, 3])
def test_torchdata_without_end(workers: int, done: int) -> None:
    """Under ``StatefulDataLoader``, with what workers prefetched thrown away; with an end:
    test_loaders.py."""
    torchdata = pytest.importorskip("torchdata.stateful_dataloader")

    def make() -> Any:
        stream = MixedStream(mixed(), batch_size=4)
        return torchdata.StatefulDataLoader(
            stream, 4, num_workers=workers, collate_fn=list
        )

    loader = make()
    seen = list(islice(loader, done))
    again = make()
    again.load_state_dict(loader.state_dict())
    assert seen + list(islice(again, 10 - done)) == cut(sequence()[:40], 4)


def test_invalid_options_and_states_of_a_stream_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ConfigError, match="batch_size 0"):
        MixedStream(mixed(), batch_size=0)
    stream = MixedStream(mixed(), batch_size=4, endless=False)
    with pytest.raises(ConfigError, match="5 batches done of 4"):
        stream.state_dict(5)
    with pytest.raises(ConfigError, match="a state of another mixture"):
        stream.load_state_dict({"seed": 3, "epoch": 0, "position": 0, "plan": ""})
    next(iter(stream))
    after = stream.state_dict()
    monkeypatch.setattr(
        module, "get_worker_info", lambda: SimpleNamespace(id=0, num_workers=2)
    )
    stream.load_state_dict(after)
    with pytest.raises(
        ConfigError, match=r"'workers': 1.*'workers': 2.*state_dict\(done=...\)"
    ):
        iter(stream)


class Ahead(Endless):
    """A source that works ahead."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[list[int]] = []

    def expect(self, numbers: list[int]) -> None:
        self.told.append(list(numbers))


def test_only_this_ranks_share_is_announced_to_a_source_that_works_ahead() -> None:
    source = Ahead()
    scans = MixedScans(Scans("r", 6), source, 0.5)
    asked = [
        [
            int(scans.sample(e, i)["id"][1:]) if scans.plan(e).domain[i] else -1
            for i in range(12)
        ]
        for e in (0, 1)
    ]
    stream = MixedStream(scans, batch_size=2, rank=1, world_size=2)
    source.told.clear()
    list(islice(stream, 8))
    mine = [2, 3, 6, 7, 10, 11]
    assert source.told == [[epoch[i] for i in mine if epoch[i] >= 0] for epoch in asked]


def test_it_says_what_it_is() -> None:
    first, second = repr(MixedStream(mixed(), batch_size=4)).splitlines()
    assert first == "MixedStream: batches of 4, rank 0 of 1, endless"
    assert (
        second.strip()
        == "MixedScans: 15 samples in epoch 0, 6 of them synthetic; seed 0"
    )
