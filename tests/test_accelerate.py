"""Mixtures in Accelerate's loaders with two processes: the epoch that was set or resumed, each
sample once."""

import itertools
import os
import socket
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from mixtures import Endless, Scans
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans, MixedStream
from lidar_synth.mixing.epochs import CurrentEpoch
from lidar_synth.mixing.state import make_state

pytest.importorskip("accelerate")

from lidar_synth.integrations.accelerate import prepare

FALLING = {0: 1.0, 5: 0.2}


def number(scan: Scan, rng: Any) -> torch.Tensor:
    """Of a scan, negative for synthetic ones."""
    own = int(scan.id[1:])
    return torch.tensor(-1 - own if scan.domain else own)


def mixed(epoch_size: int = 47) -> MixedScans:
    """Of 47 samples an epoch."""
    return MixedScans(
        Scans("r", 37),
        Endless(),
        FALLING,
        epoch_size=epoch_size,
        to_sample=number,
        collate=torch.stack,
    )


def planned(epoch: int, start: int = 0, size: int = 47) -> list[int]:
    made = mixed(size).plan(epoch)
    both = zip(made.domain.tolist(), made.index.tolist(), strict=True)
    return [-1 - i if d else i for d, i in both][start:]


def batched(train: MixedScans, workers: int, **options: Any) -> DataLoader[Any]:
    batches = train.batches(4, **options)
    return DataLoader(
        train, batch_sampler=batches, num_workers=workers, collate_fn=train.collate
    )


def streamed(train: MixedScans, workers: int, **options: Any) -> DataLoader[Any]:
    stream = MixedStream(train, batch_size=4, endless=False, **options)
    return DataLoader(stream, 4, num_workers=workers, collate_fn=train.collate)


def seen(loader: Any) -> Counter[int]:
    """By all processes."""
    every: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(every, [int(x) for batch in loader for x in batch])
    return Counter(x for part in every for x in part)


def run(rank: int, port: int) -> None:
    os.environ |= {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": "2",
    }
    os.environ |= {
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "ACCELERATE_USE_CPU": "true",
    }
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState, PartialState

    AcceleratorState._reset_state(True)  # forked from a process that may have had one
    PartialState._reset_state()
    accelerator = Accelerator(cpu=True)
    try:
        assert accelerator.num_processes == 2
        check_prepared(accelerator)
        check_skipped(accelerator)
        check_metrics(accelerator)
        check_refusals(accelerator)
        check_unprepared(accelerator)
    finally:
        dist.destroy_process_group()


def check_prepared(accelerator: Any) -> None:
    """The very samples that remain, then whole epochs, whether they are set or counted."""
    for make in (batched, streamed):
        for workers in (0, 1):
            train = mixed()
            plain = make(train, workers)
            order: Any = plain.dataset if make is streamed else plain.batch_sampler
            order.load_state_dict(make_state(train.mixture, 7, 24))
            loader = prepare(accelerator, plain)
            assert seen(loader) == Counter(planned(7, 24))
            assert seen(loader) == Counter(planned(8))
            train.set_epoch(2)
            state = loader.state_dict()
            assert (state["epoch"], state["position"]) == (2, 0)
            assert seen(loader) == Counter(planned(2))
            loader.set_epoch(6)
            assert seen(loader) == Counter(planned(6))
            loader.load_state_dict(make_state(train.mixture, 6, 8))
            assert loader.state_dict()["position"] == 8


def check_skipped(accelerator: Any) -> None:
    """Trap: batches that are left out look as if they were for another process."""
    loader = prepare(accelerator, batched(mixed(), 0))
    assert seen(accelerator.skip_first_batches(loader, 3)) == Counter(planned(0, 24))
    loader.set_epoch(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert seen(loader) == Counter(planned(1))


def check_metrics(accelerator: Any) -> None:
    """What is gathered for metrics are all samples, each once, also of a last step that is not
    full."""
    for size, make in ((9, batched), (11, batched), (11, streamed), (47, streamed)):
        train = mixed(size)
        loader = prepare(accelerator, make(train, 0))
        gathered = []
        for batch in loader:
            same = accelerator.pad_across_processes(batch, pad_index=1000)
            gathered += accelerator.gather_for_metrics(same).tolist()
        assert sorted(x for x in gathered if x != 1000) == sorted(planned(0, size=size))


def check_refusals(accelerator: Any) -> None:
    for make in (batched, streamed):
        for sharing in ({}, {"rank": 0, "world_size": 1}):
            train = mixed()
            train.set_epoch(5)
            loader = accelerator.prepare(make(train, 0, **sharing))
            # which alone reads a stream
            if make is batched or accelerator.is_main_process:
                with pytest.raises(
                    ConfigError, match="integrations.accelerate import prepare"
                ):
                    loader.set_epoch(loader.iteration)
        with pytest.raises(
            ConfigError, match=r"of 2 and an Accelerator.*accelerate import prepare"
        ):
            iter(make(mixed(), 0))
    with pytest.raises(ConfigError, match="batches come from BatchSampler"):
        prepare(accelerator, DataLoader(mixed(), 4))


def check_unprepared(accelerator: Any) -> None:
    """Accelerate's own sharing from epoch 0 on, which repeats samples; and a loader that it does
    not know."""
    ours = accelerator.prepare(batched(mixed(), 0, rank=0, world_size=1))
    theirs = accelerator.prepare(DataLoader(mixed(), 4, collate_fn=torch.stack))
    for epoch in (0, 1):
        for loader in (ours, theirs):
            found = seen(loader)
            assert set(found) == set(planned(epoch))
            assert found.total() == 48
    train = mixed()
    train.set_epoch(2)
    place = {"rank": accelerator.process_index, "world_size": accelerator.num_processes}
    assert seen(batched(train, 0, **place)) == Counter(planned(2))


@pytest.mark.filterwarnings("ignore")
def test_two_processes_see_every_sample_once_or_refuse() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    mp.start_processes(run, (port,), nprocs=2, start_method="fork")


@pytest.mark.parametrize("cut", [2, 12, 14])
@pytest.mark.parametrize("make", [batched, streamed, MixedScans.loader])
def test_a_prepared_loader_resumes_after_its_last_batch(
    make: Any, cut: int, tmp_path: Path
) -> None:
    from accelerate import Accelerator

    given = make(mixed(), 4) if make is MixedScans.loader else make(mixed(), 0)
    saved = Accelerator(cpu=True)
    loader = prepare(saved, given)
    saved.register_for_checkpointing(loader)
    passes = itertools.chain.from_iterable(loader for _ in range(2))
    for _ in itertools.islice(passes, cut):
        pass
    epoch, done = divmod(cut, 12)
    state = loader.state_dict()
    assert (state["epoch"], state["position"]) == (epoch, done * 4)
    assert given.state_dict() == state
    saved.save_state(tmp_path)
    again = Accelerator(cpu=True)
    loader = prepare(again, make(mixed(), 4 if make is MixedScans.loader else 0))
    again.register_for_checkpointing(loader)
    again.load_state(tmp_path)
    assert loader.state_dict() == state
    rest = [int(x) for batch in loader for x in batch]
    assert rest == planned(epoch, done * 4)
    next(iter(loader))
    assert loader.state_dict()["position"] == 4


def test_batches_are_skipped_in_the_epoch_that_was_set() -> None:
    """So resumes Hugging Face's Trainer."""
    from accelerate import Accelerator, skip_first_batches

    train = mixed()
    loader = prepare(Accelerator(cpu=True), batched(train, 0))
    loader.set_epoch(6)
    rest = skip_first_batches(loader, 5)
    rest.iteration = 0  # trap: as in Accelerate 1.10
    assert [int(x) for batch in rest for x in batch] == planned(6, 20)
    loader.set_epoch(7)
    assert [int(x) for batch in loader for x in batch] == planned(7)


def test_an_epoch_that_is_set_after_a_used_one_is_unused() -> None:
    from accelerate import Accelerator

    Accelerator(cpu=True)
    current = CurrentEpoch(9)
    current.set(3)
    current.of(0)
    current.set(0)  # passes over a used epoch are counted from 0
    current.of(0)
    current.set(5)
    with pytest.raises(ConfigError, match="epoch 0 where epoch 5 was set or resumed"):
        current.set(0)
