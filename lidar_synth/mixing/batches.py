"""Who takes which positions: an epoch cut into steps, a step into one batch for each rank.

Steps follow one another along the plan, so that what is left after any of them is the rest of the plan, whatever the
number of ranks and workers that go on with it.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Protocol, overload

from torch.utils.data import Sampler

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.epochs import REPEATED, SHARED_TWICE, Position
from lidar_synth.mixing.quotas import Mixture
from lidar_synth.mixing.state import after_epoch, check_unshared, checked_state, make_state, place

AHEAD = 1 << 20
"""How many positions a source that works ahead is told at a time."""


class Epochs(Protocol):
    """What a batch sampler needs to know of a dataset."""

    @property
    def mixture(self) -> Mixture: ...

    @property
    def epoch(self) -> int: ...

    @property
    def fetched(self) -> int: ...

    def set_epoch(self, epoch: int) -> None: ...

    def expect(self, epoch: int, positions: Iterable[int]) -> None: ...

    def length(self, epoch: int) -> int: ...


@dataclass(frozen=True)
class CutSteps(Sequence[range]):
    """The positions of steps one after another, each computed when it is asked for; see ``cut_steps``.

    Args:
        start, end: of the positions.
        size: positions of a step.
        total: how many steps.
    """

    start: int
    end: int
    size: int
    total: int

    def __len__(self) -> int:
        return self.total

    @overload
    def __getitem__(self, number: int) -> range: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[range]: ...

    def __getitem__(self, number: int | slice) -> range | Sequence[range]:
        """The positions of a step; the last one takes what is left, also more than its size."""
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(self.total))]
        if not -self.total <= number < self.total:
            raise IndexError(f"step {number} of {self.total}")
        number %= self.total
        start = self.start + number * self.size
        return range(start, self.end if number == self.total - 1 else start + self.size)


def cut_steps(
    start: int, end: int, batch_size: int, world_size: int = 1, drop_last: bool = False, join: bool = True
) -> CutSteps:
    """The positions start .. end - 1 in steps of all ranks together.

    Each step holds ``batch_size`` samples for each rank; what is left at the end makes a smaller step, or, where that
    would leave ranks without a sample, joins the last one: so all ranks take the same number of steps, and none of
    them waits for ever for another. With ``drop_last`` what is left is left out; without ``join`` it joins nothing.
    """
    size = batch_size * world_size
    whole, rest = divmod(max(end - start, 0), size)
    if drop_last:
        return CutSteps(start, start + whole * size, size, whole)
    joins = join and whole > 0 and rest < world_size
    return CutSteps(start, end, size, whole + (rest > 0 and not joins))


def rank_share(step: range, rank: int, world_size: int) -> range:
    """A rank's positions of a step: one piece, so that a balanced plan is balanced for each rank; sizes differ by one
    at most."""
    size, larger = divmod(len(step), world_size)
    start = step.start + rank * size + min(rank, larger)
    return range(start, start + size + (rank < larger))


def go_to(dataset: Epochs, epoch: int, position: int) -> None:
    """Set the epoch of a state that was loaded.

    A ``StatefulDataLoader`` loads when it begins to iterate, thus after ``set_epoch``: from the end of one epoch a
    trainer has gone on to the next by then, and stays there.
    """
    if not (dataset.epoch == epoch + 1 and position >= dataset.length(epoch)):
        dataset.set_epoch(epoch)


class MixedBatches(Sampler[list[int]]):
    """A batch sampler along the plan, for one rank or several, that can go on from any step.

    Give it to a ``DataLoader`` as ``batch_sampler``. Over all ranks every position is given once. Its positions carry
    the epoch in which iterating began, so that ``set_epoch`` may come at any time: it counts from the next pass on.
    Where a library divides batch samplers among ranks itself (Accelerate's ``prepare``), use ``rank=0, world_size=1``.

    Args:
        dataset: a ``MixedScans``.
        batch_size: samples of a batch, on each rank.
        rank, world_size: see ``place``.
        drop_last: leave out what does not fill a batch on every rank.

    Raises:
        ConfigError: on a batch size below 1 or a rank out of range; on iterating with ranks by default where an
            ``Accelerator`` is set up for several processes.
    """

    def __init__(
        self,
        dataset: Epochs,
        batch_size: int,
        *,
        rank: int | None = None,
        world_size: int | None = None,
        drop_last: bool = False,
    ) -> None:
        if batch_size < 1:
            raise ConfigError(f"batch_size={batch_size}", "at least 1")
        self.dataset, self.batch_size, self.drop_last = dataset, batch_size, drop_last
        self.rank, self.world_size = place(rank, world_size)
        self._by_default = rank is None
        self._start = (0, 0)  # epoch and position where a state said to go on
        self._drawn = (0, 0)  # epoch, and batches taken of it
        self._passed: tuple[int, int] | None = None  # epoch and position where the latest whole pass began
        self._warned = False
        self._fetched = (0, 0)  # by the dataset before the latest whole pass, and samples of that pass

    def __len__(self) -> int:
        """Batches that iterating gives."""
        self._check()
        return len(self._steps())

    def __iter__(self) -> Iterator[list[int]]:
        self._check()
        steps, epoch = self._steps(), self.dataset.epoch
        if steps and len(steps[-1]) < self.world_size:
            warnings.warn(f"{len(steps[-1])} samples left for {self.world_size} ranks: some get none", stacklevel=2)
        if self._passed == (epoch, steps.start) and not self._warned:
            self._warned = True
            warnings.warn(REPEATED.format(epoch), stacklevel=2)
        before, given = self._fetched
        fetched = self.dataset.fetched - before
        if self.world_size > 1 and 0 < fetched < given * 2 / 3:
            warnings.warn(SHARED_TWICE.format(given, self.rank, self.world_size, fetched), stacklevel=2)
        self._fetched = (0, 0)
        return self._batches(epoch, steps)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, before iterating; see ``MixedScans.set_epoch``."""
        self.dataset.set_epoch(epoch)

    def state_dict(self, done: int | None = None) -> dict[str, Any]:
        """Where to go on, whatever the number of ranks and workers then; see ``lidar_synth.mixing.state``.

        Args:
            done: batches that this rank has trained on since it began to iterate. By default those that were taken
                from this sampler: right without workers and in torchdata's ``StatefulDataLoader``; in a
                ``DataLoader`` with workers it runs ahead by what is prefetched.

        Raises:
            ConfigError: on more batches than there are.
        """
        steps, epoch = self._steps(), self.dataset.epoch
        drawn = self._drawn[1] if self._drawn[0] == epoch else 0
        if not 0 <= (number := drawn if done is None else done) <= len(steps):
            raise ConfigError(f"{number} batches done of {len(steps)}", "a number of batches of this epoch")
        if number < len(steps):
            position = steps[number].start
        elif done is None:
            # Not the next epoch yet: whoever resumes here still has to see this one end.
            position = self.dataset.length(epoch)
        else:
            epoch, position = after_epoch(self.dataset.mixture, epoch)
        return make_state(self.dataset.mixture, epoch, position)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where a state says; the dataset's epoch is set too. Another epoch begins at its beginning.

        Raises:
            ConfigError: on a state that is none, or of another mixture.
        """
        self._start = checked_state(state, self.dataset.mixture)
        self._drawn, self._passed = (0, 0), None
        go_to(self.dataset, *self._start)

    def _batches(self, epoch: int, steps: CutSteps) -> Iterator[list[int]]:
        told, number, given, before = 0, 0, 0, self.dataset.fetched
        for done, step in enumerate(steps):
            if done * steps.size >= told:
                rest = (rank_share(steps[i], self.rank, self.world_size) for i in range(done, len(steps)))
                self.dataset.expect(epoch, chain.from_iterable(rest))
                told = done * steps.size + AHEAD * self.world_size // 2
            if share := rank_share(step, self.rank, self.world_size):
                number, given = number + 1, given + len(share)
                self._drawn = (epoch, number)
                yield [Position(position, epoch) for position in share]
        self._passed, self._fetched = (epoch, steps.start), (before, given)

    def _check(self) -> None:
        if self._by_default:
            check_unshared("train.batches(...)", self.rank, self.world_size)

    def _steps(self) -> CutSteps:
        epoch = self.dataset.epoch
        start = self._start[1] if self._start[0] == epoch else 0
        return cut_steps(start, self.dataset.length(epoch), self.batch_size, self.world_size, self.drop_last)
