"""``MixedStream``: the same plan as an ``IterableDataset``, epoch by epoch or endlessly."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, count, islice, takewhile
from typing import Any

from torch.utils.data import IterableDataset, get_worker_info

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.batches import cut_steps, go_to, rank_share
from lidar_synth.mixing.scans import MixedScans
from lidar_synth.mixing.state import checked_state, place, shared_integers


class MixedStream(IterableDataset[Any]):
    """The samples of a ``MixedScans`` as an iterable dataset, in the order of its plan.

    Worker w of W yields every W-th batch, so that ``DataLoader(stream, batch_size=B, num_workers=W)`` with the same B
    yields the same batches in the same order for every W. Over all ranks and workers every sample is yielded once.

    The state is {seed, epoch, position} where the batches given so far end. A worker's own state, which torchdata's
    ``StatefulDataLoader`` asks for, adds how many samples it has given since, and fits the same ranks and workers only.

    Args:
        scans: the mixed dataset; also one that ``MixedScans.wrap`` made.
        batch_size: that of the ``DataLoader``, on each rank.
        endless: whether the next epoch follows without a pause; otherwise iterating ends with the epoch, and
            ``set_epoch`` chooses the next one.
        drop_last: without ``endless``, whether to drop the samples that do not fill a batch on every rank. If they are
            kept, the last batches of the ranks differ in size and some ranks may have none, so that trainers whose
            ranks wait for one another hang.
        rank, world_size: see ``place``; they have to be known before workers start.

    Raises:
        ConfigError: on a batch size below 1 or a rank out of range.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> from lidar_synth import Bank, MixedScans, MixedStream, open_scans
        >>> train = MixedScans(open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.5, balanced=True)
        >>> stream = MixedStream(train, batch_size=2, endless=False)
        >>> loader = DataLoader(stream, batch_size=2, collate_fn=stream.collate)
        >>> [sorted(batch["domain"].tolist()) for batch in loader]
        [[0, 1], [0, 1], [0, 1]]
    """

    def __init__(
        self,
        scans: MixedScans,
        *,
        batch_size: int = 1,
        endless: bool = True,
        drop_last: bool = False,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        if batch_size < 1:
            raise ConfigError(f"batch_size={batch_size}", "at least 1")
        self.scans, self.batch_size, self.endless = scans, batch_size, endless
        self.drop_last, self.collate = drop_last, scans.collate
        self.rank, self.world_size = place(rank, world_size)
        self._start = shared_integers(0, 0)  # epoch and position where a state said to go on
        self._given = 0  # samples that this process has given since it began to iterate
        self._begun: tuple[int, int] | None = None  # epoch and position where it began
        self._resume: dict[str, int] = {}  # a state that this process has to go on from

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch in which iterating begins."""
        self.scans.set_epoch(epoch)

    def __iter__(self) -> Iterator[Any]:
        self._begun = None
        epoch, position, given = self._progress()
        if given and (self._resume | self._place()) != self._resume:
            raise ConfigError(
                f"the state of one process, {self._resume}, in another, {self._place()}",
                "the same ranks, workers and batch size",
                "state_dict(done=...) gives a state that fits any.",
            )
        self._begun, self._given, self._resume = (epoch, position), given, {}
        return self._samples(epoch, position)

    def _samples(self, begin: int, position: int) -> Iterator[Any]:
        worker, workers = self._place()["worker"], self._place()["workers"]
        batches = islice(self._batches(begin, position), worker, None, workers)
        epoch, first, told = begin, -position, None  # number of the epoch's first sample
        for number in islice(chain.from_iterable(batches), self._given, None):
            while number >= first + len(self.scans.plan(epoch)):
                epoch, first = epoch + 1, first + len(self.scans.plan(epoch))
            if worker == 0 and told != epoch:
                ahead = chain.from_iterable(self._batches(begin, position, number))
                end, told = first + len(self.scans.plan(epoch)), epoch
                self.scans.expect(epoch, (n - first for n in takewhile(end.__gt__, ahead) if n >= number))
            self._given += 1
            yield self.scans.sample(epoch, number - first)

    def state_dict(self, done: int | None = None) -> dict[str, int]:
        """Where to go on.

        Args:
            done: batches that this rank has trained on since it began to iterate; the state then fits any number of
                ranks and workers. By default the state of this process, which is enough without workers and in a
                ``StatefulDataLoader``.

        Raises:
            ConfigError: on more batches than there are.
        """
        epoch, position, given = self._progress()
        state = {"seed": self.scans.seed, "epoch": epoch, "position": position}
        if done is not None:
            return state | self._after(epoch, position, done)
        done, part = divmod(given, self.batch_size)
        batch = next(self._batches(epoch, position, done * self.batch_size * self.world_size), ())
        if get_worker_info() is not None or part not in (0, len(batch)):
            return state | self._place() | {"given": given}
        state |= self._after(epoch, position, done + (part > 0))
        if not self.endless and state["epoch"] > epoch:
            # Not the next epoch yet: whoever resumes here still has to see this one end.
            state |= {"epoch": epoch, "position": self.scans.length(epoch)}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where a state says.

        Raises:
            ConfigError: on a state that is none, or another seed's.
        """
        epoch, position = checked_state(state, self.scans.seed)
        self._begun, self._resume = None, dict(state)
        if get_worker_info() is None:
            # A worker keeps its state to itself: what is shared, the main process may have changed since.
            self._start[0], self._start[1] = epoch, position
            go_to(self.scans, epoch, position)

    def _progress(self) -> tuple[int, int, int]:
        """Epoch and position where iterating began, or would begin, and the samples given since."""
        in_worker = get_worker_info() is not None
        if self._begun is not None and (in_worker or self._begun[0] == self.scans.epoch):
            return *self._begun, self._given
        if in_worker and self._resume:
            return self._resume["epoch"], self._resume["position"], self._resume.get("given", 0)
        epoch = self.scans.epoch
        position = int(self._start[1]) if int(self._start[0]) == epoch else 0
        return epoch, position, self._resume.get("given", 0) if self._resume.get("epoch") == epoch else 0

    def _place(self) -> dict[str, int]:
        """Which process this is of how many."""
        worker = get_worker_info()
        return {
            "rank": self.rank,
            "ranks": self.world_size,
            "worker": worker.id if worker else 0,
            "workers": worker.num_workers if worker else 1,
            "batch": self.batch_size,
        }

    def _batches(self, epoch: int, position: int, since: int = 0) -> Iterator[range]:
        """This rank's batches for all workers, from that with number ``since`` on; numbers count from the beginning."""
        size = self.batch_size * self.world_size
        steps: Iterable[range] = (range(i * size, (i + 1) * size) for i in count(since // size))
        if not self.endless:
            steps = self._steps(0, self.scans.length(epoch) - position)[since // size :]
        return (rank_share(step, self.rank, self.world_size) for step in steps)

    def _steps(self, start: int, end: int) -> list[range]:
        # A loader cuts batches of its own size, so what is left has to stay a batch of its own.
        return cut_steps(start, end, self.batch_size, self.world_size, self.drop_last, join=False)

    def _after(self, epoch: int, position: int, done: int) -> dict[str, int]:
        """The epoch and position after a number of batches."""
        if not self.endless:
            steps = self._steps(position, self.scans.length(epoch))
            if not 0 <= done <= len(steps):
                raise ConfigError(f"{done} batches done of {len(steps)}", "a number of batches of this epoch")
            last = done == len(steps)
            return {"epoch": epoch + last, "position": 0 if last else steps[done].start}
        position += done * self.batch_size * self.world_size
        while position >= (length := self.scans.length(epoch)):
            epoch, position = epoch + 1, position - length
        return {"epoch": epoch, "position": position}
