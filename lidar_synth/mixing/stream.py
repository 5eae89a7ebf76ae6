"""``MixedStream``: the same plan as an ``IterableDataset``, epoch by epoch or endlessly."""

import os
import sys
from collections.abc import Iterator, Mapping
from itertools import chain, islice, takewhile
from typing import Any

from torch.utils.data import IterableDataset, get_worker_info

from lidar_synth.errors import ConfigError, check_count
from lidar_synth.mixing.batches import (
    AHEAD,
    CutSteps,
    check_mixture,
    cut_steps,
    rank_share,
    resume_epoch,
)
from lidar_synth.mixing.epochs import check_pass, share, shared_integers
from lidar_synth.mixing.scans import MixedScans
from lidar_synth.mixing.state import (
    Divided,
    after_batches,
    check_state,
    make_state,
)


class MixedStream(Divided, IterableDataset[Any]):
    """The samples of a ``MixedScans`` as an iterable dataset, in the order of its plan.

    Worker w of W yields every W-th batch, so that ``DataLoader(stream, batch_size=B,
    num_workers=W)`` with the same B yields the same batches in the same order for every W. Over all
    ranks and workers every sample is yielded once.

    ``set_epoch`` takes effect with the next pass: a pass stays in the epoch in which it began. If
    persistent workers cannot determine that epoch, an error is raised.

    The state (state.py) holds the position after the batches yielded so far. The state of a worker,
    which torchdata's ``StatefulDataLoader`` saves, adds the number of samples that the worker has
    yielded since; it fits only the same ranks and workers.

    Args:
        scans: the mixed dataset; also one that ``MixedScans.wrap`` made.
        batch_size: that of the ``DataLoader``, on each rank.
        endless: whether the next epoch follows without a pause; otherwise iterating ends with the
            epoch, and ``set_epoch`` chooses the next one.
        drop_last: without ``endless``, whether to drop the samples that do not fill a batch on
            every rank. If they are kept, the last batches of the ranks differ in size and some
            ranks may have none, so that trainers whose ranks wait for one another hang.
        rank, world_size: rank of this process and number of ranks (see ``place`` for the defaults);
            they must be known before workers start.

    Raises:
        ConfigError: on another dataset, a batch size below 1 or a rank out of range; on iterating
            with default ranks where an ``Accelerator`` is set up for several processes.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> from lidar_synth import Bank, MixedScans, MixedStream, open_scans
        >>> real, synth = open_scans("demo_out/town"), Bank("demo_out/bank")
        >>> train = MixedScans(real, synth, ratio=0.5, balanced=True)
        >>> stream = MixedStream(train, batch_size=2, endless=False)
        >>> loader = DataLoader(stream, batch_size=2, collate_fn=stream.collate)
        >>> [sorted(batch["domain"].tolist()) for batch in loader]
        [[0, 1], [0, 1], [0, 1]]
    """

    call = "MixedStream(...)"

    def __init__(
        self,
        scans: MixedScans,
        *,
        batch_size: int,
        endless: bool = True,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        check_mixture(scans)
        check_count("batch_size", batch_size, 1)
        self.scans = scans
        self.batch_size = int(batch_size)
        self.endless = endless
        self.drop_last = drop_last
        self.collate = scans.collate
        self.divide(rank, world_size)
        self._process = os.getpid()  # the process that has iterated last
        self._start = shared_integers(0, 0)  # epoch and position of the loaded state
        # samples that this process has yielded since it began to iterate
        self._yielded = 0
        self._begun: tuple[int, int] | None = None  # epoch and position where it began
        # the state from which the process that loaded it has to resume
        self._resume: dict[str, Any] = {}
        self._loaded_by = 0  # the id of that process

    def __repr__(self) -> str:
        kind = "endless" if self.endless else "epoch by epoch"
        place = f"batches of {self.batch_size}, rank {self.rank} of {self.world_size}"
        mixture = repr(self.scans).partition("\n")[0]
        return f"{type(self).__name__}: {place}, {kind}\n  {mixture}"

    def __len__(self) -> int:
        """Number of samples of this rank in a complete epoch.

        Raises:
            TypeError: if the stream is endless.
        """
        if self.endless:
            raise TypeError(
                "an endless MixedStream has no length; with endless=False it has one"
            )
        steps = self._steps(0)
        full, rest = divmod(steps.end, steps.size)
        return full * self.batch_size + len(
            rank_share(range(rest), self.rank, self.world_size)
        )

    def __bool__(self) -> bool:
        return True  # an endless one has no length

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch in which iterating begins."""
        self.scans.set_epoch(epoch)

    def __iter__(self) -> Iterator[Any]:
        self._check()
        self._begun = None
        epoch, position, given = self._progress()
        if given and (self._resume | self._place()) != self._resume:
            raise ConfigError(
                f"the state of one process, {self._resume}, in another, {self._place()}",
                "the same ranks, workers and batch size",
                "state_dict(done=...) makes a state that fits any number of ranks and workers.",
            )
        persistent = self._process == os.getpid() and get_worker_info() is not None
        self._begun = (epoch, position)
        self._yielded = given
        self._resume = {}
        self._process = os.getpid()
        self.scans.current.note_pass(epoch)
        return self._samples(epoch, position, persistent and not self.endless)

    def _samples(self, begin: int, position: int, guarded: bool) -> Iterator[Any]:
        """The samples of this process.

        Args:
            begin, position: where to begin.
            guarded: whether to refuse a change of the epoch. A later pass of a persistent worker
                may begin only after ``iter(loader)`` returned, and would miss the change.
        """
        place = self._place()
        worker = place["worker"]
        batches = islice(self._batches(position), worker, None, place["workers"])
        epoch = begin
        first = 0  # of the positions that count on, that of the epoch's first sample
        announced = 0
        for number in islice(chain.from_iterable(batches), self._yielded, None):
            if guarded:
                check_pass(begin, self.scans.epoch)
            while number >= (end := first + len(self.scans)):
                epoch += 1
                first = end
                announced = 0
                if worker == 0:
                    self.scans.tell_sources(epoch)
            if worker == 0 and number >= announced:
                done = (number - position) // (self.batch_size * self.world_size)
                ahead = chain.from_iterable(self._batches(position, done))
                self.scans.expect(
                    epoch,
                    (n - first for n in takewhile(end.__gt__, ahead) if n >= number),
                )
                announced = min(end, number + AHEAD * self.world_size // 2)
            self._yielded += 1
            yield self.scans.sample(epoch, number - first)

    def state_dict(self, done: int | None = None) -> dict[str, Any]:
        """The progress of training, from which it can be resumed.

        Args:
            done: number of batches that this rank has trained on since it began to iterate; the
                state then fits any number of ranks and workers. The default, the progress of this
                process, is correct without workers and in a ``StatefulDataLoader``.

        Raises:
            ConfigError: on more batches than the epoch has.
        """
        epoch, position, given = self._progress()
        if done is not None:
            return make_state(self.scans.mixture, *self._after(epoch, position, done))
        done, part = divmod(given, self.batch_size)
        batch = next(self._batches(position, done), ())
        if get_worker_info() is not None or part not in (0, len(batch)):
            return (
                make_state(self.scans.mixture, epoch, position)
                | self._place()
                | {"given": given}
            )
        after = self._after(epoch, position, done + (part > 0))
        if not self.endless and after[0] > epoch:
            # Not the next epoch yet: a trainer that resumes here still has to see the end of this
            # one.
            after = epoch, len(self.scans)
        return make_state(self.scans.mixture, *after)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state.

        Raises:
            ConfigError: on an invalid state, or one of another mixture.
        """
        epoch, position = check_state(state, self.scans.mixture)
        self._begun = None
        self._resume = {k: v for k, v in state.items() if k not in ("plan", "mixture")}
        self._loaded_by = os.getpid()
        self.scans.current.forget_pass()
        if get_worker_info() is None:
            # A worker does not write to shared memory, which the main process may have changed
            # since.
            self._start[0] = epoch
            self._start[1] = position
            resume_epoch(self.scans, epoch, position)

    def _progress(self) -> tuple[int, int, int]:
        """Epoch and position where iteration began, or would begin, and the number of samples
        yielded since."""
        in_worker = get_worker_info() is not None
        if self._begun is not None and (
            in_worker or self._begun[0] == self.scans.epoch
        ):
            return *self._begun, self._yielded
        if in_worker and self._resume and self._loaded_by == os.getpid():
            return (
                self._resume["epoch"],
                self._resume["position"],
                self._resume.get("given", 0),
            )
        # A worker that has just started begins in the epoch that the main process had at
        # iter(loader).
        started = in_worker and self._process != os.getpid()
        epoch = self.scans.current.at_start if started else self.scans.epoch
        position = int(self._start[1]) if int(self._start[0]) == epoch else 0
        return (
            epoch,
            position,
            self._resume.get("given", 0) if self._resume.get("epoch") == epoch else 0,
        )

    def _place(self) -> dict[str, int]:
        """Rank, worker and batch size of this process."""
        worker = get_worker_info()
        return {
            "rank": self.rank,
            "ranks": self.world_size,
            "worker": worker.id if worker else 0,
            "workers": worker.num_workers if worker else 1,
            "batch": self.batch_size,
        }

    def _batches(self, position: int, since: int = 0) -> Iterator[range]:
        """This rank's batches for all workers, as ranges of positions, from ``position`` on without
        the first ``since`` steps."""
        steps = self._steps(position)
        return (
            rank_share(steps[i], self.rank, self.world_size)
            for i in range(since, len(steps))
        )

    def __getstate__(self) -> dict[str, Any]:
        self._check()  # here, because spawned workers do not see the Accelerator
        return self.__dict__

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= state
        share(self._start)

    def _steps(self, start: int) -> CutSteps:
        """The steps from a position on, which count on over the epochs of an endless stream."""
        end = sys.maxsize if self.endless else len(self.scans)
        # The loader's batches have a fixed size, so the remainder cannot be added to the last
        # batch.
        return cut_steps(
            start, end, self.batch_size, self.world_size, self.drop_last, join=False
        )

    def _after(self, epoch: int, position: int, done: int) -> tuple[int, int]:
        """The epoch and position after a number of batches."""
        steps = self._steps(position)
        if not self.endless:
            return after_batches(self.scans.mixture, epoch, steps, done)
        epochs, position = divmod(position + done * steps.size, len(self.scans))
        return epoch + epochs, position
