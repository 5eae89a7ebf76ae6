"""The epoch of a sample: the one in which iteration began, even if ``set_epoch`` was called since.

``MixedBatches`` yields positions that carry their epoch. Other samplers yield plain integers, which
refer to the dataset's current epoch. DataLoader workers fetch ahead, so that ``set_epoch`` after
``iter(loader)`` would mix two epochs: some scans would come twice and others never. Such a call
therefore raises an error.
"""

import sys
import warnings
from types import FrameType
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Subset, get_worker_info
from torch.utils.data._utils.fetch import _MapDatasetFetcher

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.state import count_accelerated

REPEATED = (
    "epoch {} begins again, with the same scans in the same order as before. Make the mixture "
    "once, and call set_epoch(epoch) before each pass; epoch_size=N makes short epochs."
)

TOO_LONG = (
    "more than twice the {} samples of epoch {} were loaded without set_epoch, with the same scans "
    "each time. For a pass of several epochs, load MixedStream(train, batch_size=batch_size)."
)

SHARED_TWICE = (
    "of {} samples for rank {} of {}, only {} were fetched. Another library may divide the "
    "batches among the processes "
    "a second time; if so, call batches(...) with rank=0, world_size=1."
)

_COUNTERS = 256  # one counter for each worker, so that none has to wait for another

_EPOCH, _PASS, _WARNED, _USED = range(4)
"""What the shared integers hold: the current epoch, the epoch of the latest pass, 1 once a
repetition has been warned of, and 1 once the current epoch is used."""


class Position(int):
    """An integer position with the attribute ``epoch``.

    Args:
        position: 0 <= position < length of the epoch.
        epoch: the epoch to which the position refers.
    """

    epoch: int

    def __new__(cls, position: int, epoch: int) -> "Position":
        """Create the integer and set its epoch."""
        self = super().__new__(cls, position)
        self.epoch = epoch
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Position, (int(self), self.epoch)


def shared_integers(*values: int) -> Tensor:
    """(n,) int64 in shared memory, so that all DataLoader workers see changes: forked, spawned and
    persistent ones.

    A plain attribute does not work, because persistent workers keep the copy of the dataset with
    which they started.
    """
    tensor = torch.tensor(values, dtype=torch.int64, device="cpu")
    return tensor.share_memory_()  # type: ignore[no-untyped-call, no-any-return]


def share(tensor: Tensor) -> None:
    """Move a tensor to shared memory unless it is there. A deep copy is not; a tensor that was sent
    to a spawned worker is, and shares its values with the main process."""
    if not tensor.is_shared():  # type: ignore[no-untyped-call]
        tensor.share_memory_()  # type: ignore[no-untyped-call]


class CurrentEpoch:
    """The current epoch of a dataset in all its processes, and the epochs in which passes over it
    began.

    Args:
        length: number of samples in an epoch.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._shared = shared_integers(0, -1, 0, 0)
        # by worker: number of positions fetched, and of plain integers since the epoch was set
        self._fetched = shared_integers(*[0] * 2 * _COUNTERS).view(2, _COUNTERS)
        self.passed: dict[int, tuple[int, int]] = {}
        """By rank: epoch and position where its latest complete pass by ``batches`` began."""
        self.at_start = 0
        """The epoch that this process set, or that was current when it started: for a worker, at
        ``iter(loader)``."""
        # {fetcher: epoch of its pass}.
        self._passes: WeakKeyDictionary[Any, int] = WeakKeyDictionary()
        self._followers: WeakSet[Any] = WeakSet()

    def __int__(self) -> int:
        return int(self._shared[_EPOCH])

    @property
    def fetched(self) -> int:
        """Number of positions with an epoch that all workers together have fetched."""
        return int(self._fetched[0].sum())

    def set(self, epoch: int) -> None:
        """Set the epoch for all processes.

        Raises:
            ConfigError: if Accelerate sets an epoch before the one that was set or resumed and
                never used.
        """
        if (
            epoch < self.at_start
            and not self._shared[_USED]
            and not self._followers
            and count_accelerated()
        ):
            raise ConfigError(
                f"epoch {epoch} where epoch {self.at_start} was set or resumed: a loader of "
                "accelerator.prepare counts its passes from 0",
                "the epoch that was set or resumed",
                "from lidar_synth.integrations.accelerate import prepare; loader = "
                "prepare(accelerator, loader).",
            )
        self._shared[_EPOCH] = epoch
        self.at_start = epoch
        self._shared[_USED] = 0
        self._fetched[1] = 0
        for loader in self._followers:
            loader.iteration = epoch

    def follow(self, loader: Any) -> None:
        """Keep the attribute ``iteration`` of a loader, the epoch of its next pass, at the current
        epoch."""
        self._followers.add(loader)
        loader.iteration = int(self)

    def of(self, index: int) -> int:
        """The epoch of an index that is being fetched.

        Raises:
            ConfigError: if another epoch was set since the DataLoader's pass began, or if it loads
                a ``Subset``.
        """
        self._shared[_USED] = 1
        if isinstance(index, Position):
            self._count(0)
            return index.epoch
        epoch = int(self)
        fetch = _running_fetch()
        if fetch is None:  # not within a DataLoader's pass
            return epoch
        fetcher = fetch.f_locals["self"]
        if fetcher not in self._passes:
            check_whole(fetcher.dataset)
            self._passes[fetcher] = epoch if _has_sent(fetch) else self.at_start
            self.note_pass(self._passes[fetcher])
        check_pass(self._passes[fetcher], epoch)
        self._count(1)
        if self._fetched[1].sum() > 2 * self._length:
            self.warn(TOO_LONG.format(self._length, epoch))
        return epoch

    def _count(self, row: int) -> None:
        worker = get_worker_info()
        self._fetched[row, worker.id % _COUNTERS if worker else 0] += 1

    def warn(self, text: str) -> None:
        """Warn of a repetition, once in all processes."""
        if not self._shared[_WARNED]:
            self._shared[_WARNED] = 1
            warnings.warn(text, stacklevel=5)

    def note_pass(self, epoch: int) -> None:
        """Note that a pass begins, and warn if the pass before had the same epoch; only worker 0
        does this."""
        self._shared[_USED] = 1
        worker = get_worker_info()
        if worker and worker.id:
            return
        if self._shared[_PASS] == epoch:
            self.warn(REPEATED.format(epoch))
        self._shared[_PASS] = epoch

    def forget_pass(self) -> None:
        """Forget the latest pass: the next one resumes from a state and is not a repetition."""
        self._shared[_PASS] = -1
        self.passed.clear()

    def take_pass(self, other: "CurrentEpoch") -> None:
        """Adopt the latest pass of another mixture, so that a repetition is warned of, once."""
        self._shared[_PASS:_USED] = other._shared[_PASS:_USED]
        self.passed = dict(other.passed)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_passes": None, "_followers": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state | {
            "_passes": WeakKeyDictionary(),
            "_followers": WeakSet(),
        }
        share(self._shared)
        share(self._fetched)


def check_pass(begun: int, epoch: int) -> None:
    """Refuse an epoch that was set while a DataLoader iterated over another one.

    Raises:
        ConfigError: if they differ.
    """
    if begun != epoch:
        raise ConfigError(
            f"set_epoch({epoch}) while a DataLoader was iterating over epoch {begun}",
            "set_epoch before iter(loader), as the workers fetch ahead",
            "Call set_epoch before the loop over the loader. If a trainer's hook runs later, pass "
            "the DataLoader batch_sampler=train.batches(batch_size): its batches keep the epoch "
            "in which iteration began.",
        )


def check_whole(dataset: Any) -> None:
    """Refuse a ``Subset`` of a mixture.

    Raises:
        ConfigError: if a DataLoader's dataset is one, or a ``ConcatDataset`` with one in it.
    """
    if isinstance(dataset, ConcatDataset):
        for part in filter(_is_mixed, dataset.datasets):
            check_whole(part)
    if isinstance(dataset, Subset):
        raise ConfigError(
            "a Subset of a mixture, of random_split for instance: its indices mean other scans in "
            "every epoch, so that held-out real scans would be trained on",
            "the real scans split, then mixed",
            "kept, held_out = random_split(real, [0.9, 0.1]); train = MixedScans(kept, synth, ...)",
        )


def _is_mixed(dataset: Any) -> bool:
    """Whether a dataset is a mixture, or made of one; others may be split."""
    if isinstance(dataset, Subset):
        return _is_mixed(dataset.dataset)
    if isinstance(dataset, ConcatDataset):
        return any(map(_is_mixed, dataset.datasets))
    return hasattr(dataset, "tell_sources")


def _running_fetch() -> FrameType | None:
    """The call of ``fetch`` of a DataLoader's fetcher on the call stack, or None: torch makes a
    fetcher for each pass in each process."""
    frame: FrameType | None = sys._getframe(1)
    while frame and frame.f_code is not _MapDatasetFetcher.fetch.__code__:
        frame = frame.f_back
    return frame


def _has_sent(fetch: FrameType) -> bool:
    """Whether the caller of ``fetch`` is no worker, or one that has sent something to the main
    process, perhaps in an earlier pass: its queue has a thread by then."""
    caller: Any = fetch.f_back
    return getattr(caller.f_locals.get("data_queue"), "_thread", True) is not None
