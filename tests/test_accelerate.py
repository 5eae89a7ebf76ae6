"""Mixtures through ``Accelerator.prepare`` with two processes, which shares batches itself."""

import os
import socket
from collections import Counter
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

pytest.importorskip("accelerate")

REAL = 40


def number(scan: Scan, rng: Any) -> torch.Tensor:
    """Of a scan, negative for synthetic ones."""
    own = int(scan.id[1:])
    return torch.tensor(-1 - own if scan.domain else own)


def mixed() -> MixedScans:
    """54 samples in epoch 0, 53 in the next two."""
    return MixedScans(Scans("r", REAL), Endless(), 0.25, to_sample=number, collate=torch.stack)


def planned(epoch: int) -> list[int]:
    made = mixed().plan(epoch)
    return [-1 - i if d else i for d, i in zip(made.domain.tolist(), made.index.tolist(), strict=True)]


def seen(loader: Any) -> list[int]:
    """By all processes."""
    every: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(every, [int(x) for batch in loader for x in batch])
    return [x for part in every for x in part]


def run(rank: int, port: int) -> None:
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "RANK": str(rank)}
    os.environ |= {"LOCAL_RANK": str(rank), "ACCELERATE_USE_CPU": "true"}
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState, PartialState

    AcceleratorState._reset_state(True)  # forked from a process that may have had one
    PartialState._reset_state()
    accelerator = Accelerator(cpu=True)
    try:
        assert accelerator.num_processes == 2
        check(accelerator)
    finally:
        dist.destroy_process_group()


def check(accelerator: Any) -> None:
    for make in (lambda train: train.batches(4), lambda train: MixedStream(train, batch_size=4, endless=False)):
        train = mixed()
        by_default = make(train)
        twice = (
            DataLoader(by_default, 4, collate_fn=train.collate)
            if isinstance(by_default, MixedStream)
            else DataLoader(train, batch_sampler=by_default, collate_fn=train.collate)
        )
        with pytest.raises(ConfigError, match=r"of 2 and an Accelerator.*rank=0, world_size=1"):
            iter(by_default)
        prepared = accelerator.prepare(twice)
        if accelerator.is_main_process:  # that of a stream is the only one to read
            with pytest.raises(ConfigError, match="most samples would never be seen"):
                list(prepared.base_dataloader)

    for workers in (0, 1):
        train = mixed()
        batches = train.batches(4, rank=0, world_size=1)
        loader = DataLoader(train, batch_sampler=batches, num_workers=workers, collate_fn=train.collate)
        prepared = accelerator.prepare(loader)
        plain = accelerator.prepare(DataLoader(mixed(), 4, num_workers=workers, collate_fn=torch.stack))
        for epoch in (0, 1):  # which it counts itself
            for way in (prepared, plain):
                found = seen(way)
                assert set(found) == set(planned(epoch))
                assert len(found) == 56  # made even: 14 batches of 4
        own = DataLoader(train, batch_sampler=train.batches(
            4, rank=accelerator.process_index, world_size=accelerator.num_processes
        ), collate_fn=train.collate)  # fmt: skip
        train.set_epoch(2)
        assert Counter(seen(own)) == Counter(planned(2))
        stream = MixedStream(mixed(), batch_size=4, endless=False, rank=0, world_size=1)
        dispatched = accelerator.prepare(DataLoader(stream, 4, num_workers=workers))
        assert set(seen(dispatched)) == set(planned(0))


@pytest.mark.filterwarnings("ignore")
def test_two_processes_see_every_sample_or_refuse() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    mp.start_processes(run, (port,), nprocs=2, start_method="fork")
