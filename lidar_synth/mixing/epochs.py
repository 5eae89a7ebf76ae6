"""Which epoch a sample belongs to: that in which iterating began, whatever ``set_epoch`` says meanwhile.

``MixedBatches`` gives positions that carry their epoch. Other samplers give plain integers, which belong to the epoch
that the dataset is set to. DataLoader workers fetch ahead, so that an epoch that is set after ``iter(loader)`` would
mix two epochs: some scans would come twice and others never. That raises.
"""

import os
import sys
import warnings
from types import FrameType
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.utils.data import get_worker_info
from torch.utils.data._utils.fetch import _MapDatasetFetcher

from lidar_synth.errors import ConfigError

REPEATED = (
    "epoch {} begins once more: the same scans in the same order as before. Call set_epoch(epoch) before each pass."
)

SHARED_TWICE = (
    "of {} samples that rank {} of {} was to train on, {} were fetched. Does another library share the batches among "
    "processes once more? Then give batches(...) rank=0, world_size=1."
)

_COUNTERS = 256  # each worker has one of its own, so that none of them has to wait


class Position(int):
    """A position that knows its epoch; everywhere else a plain integer.

    Args:
        position: 0 <= position < length of the epoch.
        epoch: it belongs to.
    """

    epoch: int

    def __new__(cls, position: int, epoch: int) -> "Position":
        """An integer with an attribute."""
        made = super().__new__(cls, position)
        made.epoch = epoch
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        return Position, (int(self), self.epoch)


def shared_integers(*values: int) -> Tensor:
    """(n,) int64 that DataLoader workers see change, forked, spawned and persistent ones alike.

    A plain attribute would not do: persistent workers keep their copy of the dataset from when they started.
    """
    tensor = torch.tensor(values, dtype=torch.int64)
    tensor.share_memory_()  # type: ignore[no-untyped-call]
    return tensor


class CurrentEpoch:
    """The epoch that a dataset is set to, for all its processes, and those in which passes over it began."""

    def __init__(self) -> None:
        self._shared = shared_integers(0, -1, 0)  # the epoch; that of the latest pass; whether a warning was given
        self._fetched = shared_integers(*[0] * _COUNTERS)  # positions that were fetched, by worker
        self._own = 0  # as this process set it, or as it was when this process started
        self._process = os.getpid()
        self._passes: WeakKeyDictionary[Any, int] = WeakKeyDictionary()  # by what fetches: the epoch

    def __int__(self) -> int:
        return int(self._shared[0])

    @property
    def fetched(self) -> int:
        """How many positions with an epoch were fetched so far, by all workers."""
        return int(self._fetched.sum())

    @property
    def at_start(self) -> int:
        """The epoch when this process started, where it has not set another: in a worker, when ``iter`` was called."""
        return self._own

    def set(self, epoch: int) -> None:
        """For all processes."""
        self._shared[0], self._own = epoch, epoch

    def of(self, index: int) -> int:
        """The epoch of an index that is fetched.

        Raises:
            ConfigError: where another epoch was set since the pass of the DataLoader that fetches it began.
        """
        if isinstance(index, Position):
            worker = get_worker_info()
            self._fetched[worker.id % _COUNTERS if worker else 0] += 1
            return index.epoch
        epoch, fetcher = int(self), _running_fetcher()
        if fetcher is None:  # nobody's pass
            return epoch
        forked = self._process != os.getpid()
        if forked:
            self._process = os.getpid()
            self._passes.clear()
        if fetcher not in self._passes:
            self._passes[fetcher] = self._own if forked else epoch
            self.note_pass(self._passes[fetcher])
        check_pass(self._passes[fetcher], epoch)
        return epoch

    def note_pass(self, epoch: int) -> None:
        """A pass begins; where the one before was of the same epoch, warn once. The first worker speaks for all."""
        worker = get_worker_info()
        if worker is not None and worker.id > 0:
            return
        if self._shared[1] == epoch and not self._shared[2]:
            self._shared[2] = 1
            warnings.warn(REPEATED.format(epoch), stacklevel=4)
        self._shared[1] = epoch

    def forget_pass(self) -> None:
        """What begins next is no repetition: it goes on where a state says."""
        self._shared[1] = -1

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_passes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {"_passes": WeakKeyDictionary()}


def check_pass(begun: int, epoch: int) -> None:
    """Refuse an epoch that was set while a DataLoader was going through another.

    Raises:
        ConfigError: where they differ.
    """
    if begun != epoch:
        raise ConfigError(
            f"set_epoch({epoch}) while a DataLoader was going through epoch {begun}",
            "set_epoch before iter(loader), as the workers fetch ahead",
            "Call set_epoch before the loop over the loader. Where a trainer's hook comes later, give the DataLoader "
            "batch_sampler=train.batches(batch_size): its batches keep the epoch in which iterating began.",
        )


def _running_fetcher() -> Any:
    """What fetches for the DataLoader that asks right now: torch makes one for each pass, in each process."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if frame.f_code is _MapDatasetFetcher.fetch.__code__:
            return frame.f_locals["self"]
        frame = frame.f_back
    return None
