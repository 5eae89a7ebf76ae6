"""``MixedBatches``: an epoch divided into steps, and each step into one batch for each rank.

Steps follow one another along the plan. After any step, the remaining samples are the rest of the
plan, so that training can resume there with another number of ranks and workers.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from torch.utils.data import Sampler

from lidar_synth.errors import ConfigError, check_count
from lidar_synth.mixing.epochs import REPEATED, SHARED_TWICE, Position
from lidar_synth.mixing.state import (
    Divided,
    after_batches,
    check_state,
    make_state,
)

AHEAD = 1 << 20
"""Number of positions that are announced at a time to a source that works ahead."""

DIVIDED = (
    "With Lightning or Fabric, set use_distributed_sampler=False: a mixture divides its batches "
    "among the ranks itself."
)


@dataclass(frozen=True)
class CutSteps(Sequence[range]):
    """The positions of consecutive steps, computed on access; see ``cut_steps``.

    Args:
        start, end: first position, and the one after the last.
        size: number of positions in a step.
        total: number of steps.
    """

    start: int
    end: int
    size: int
    total: int

    def __len__(self) -> int:
        return self.total

    def __getitem__(self, number: int) -> range:  # type: ignore[override]  # no slices
        """The positions of a step; the last step takes all remaining positions, even if they exceed
        its size."""
        number = range(self.total)[number]
        start = self.start + number * self.size
        return range(start, self.end if number == self.total - 1 else start + self.size)


def cut_steps(
    start: int,
    end: int,
    batch_size: int,
    world_size: int = 1,
    drop_last: bool = False,
    join: bool = True,
) -> CutSteps:
    """Divide the positions start .. end - 1 into steps of all ranks together.

    Each step holds ``batch_size`` samples for each rank. The remainder becomes a smaller step, or
    is added to the last step if it has fewer samples than there are ranks. All ranks thus take the
    same number of steps, and none waits forever for another. ``drop_last`` drops the remainder;
    ``join=False`` never adds it to the last step.
    """
    size = batch_size * world_size
    full, rest = divmod(max(end - start, 0), size)
    if drop_last:
        return CutSteps(start, start + full * size, size, full)
    joins = join and full > 0 and rest < world_size
    return CutSteps(start, end, size, full + (rest > 0 and not joins))


def rank_share(step: range, rank: int, world_size: int) -> range:
    """The positions of one rank in a step.

    They are consecutive, so that a balanced plan is balanced for each rank; sizes differ by one at
    most.
    """
    size, larger = divmod(len(step), world_size)
    start = step.start + rank * size + min(rank, larger)
    return range(start, start + size + (rank < larger))


def resume_epoch(dataset: Any, epoch: int, position: int) -> None:
    """Set the dataset to the epoch of a loaded state.

    If the state marks the end of an epoch and the trainer has already set the next one, that one
    is kept: a ``StatefulDataLoader`` loads its state only when it begins to iterate, after
    ``set_epoch``.
    """
    if not (dataset.epoch == epoch + 1 and position >= len(dataset)):
        dataset.set_epoch(epoch)


def check_mixture(dataset: Any, hint: str = "mix(real, synthetic) makes one.") -> None:
    """Check that a dataset is a mixture.

    Raises:
        ConfigError: on any other, with the hint.
    """
    if not hasattr(dataset, "mixture"):
        raise ConfigError(
            f"batches of a {type(dataset).__name__}", "a MixedScans", hint
        )


class MixedBatches(Divided, Sampler[list[int]]):
    """A batch sampler in the order of the plan, for one rank or several, that can resume from any
    step.

    Pass it to a ``DataLoader`` as ``batch_sampler``. Over all ranks every position is yielded once.
    Each position carries the epoch in which iteration began, so that ``set_epoch`` may be called at
    any time: it takes effect with the next pass. If a library divides batch samplers among ranks
    itself, use ``rank=0, world_size=1``; Accelerate's ``prepare`` does so too, and repeats samples:
    use ``lidar_synth.integrations.accelerate.prepare``.

    Args:
        dataset: a ``MixedScans``.
        batch_size: number of samples in a batch, on each rank.
        rank, world_size: rank of this process and number of ranks; see ``place`` for the defaults.
        drop_last: whether to drop the samples that do not fill a batch on every rank.

    Raises:
        ConfigError: on a batch size below 1, another dataset or a rank out of range; on iterating
            with default ranks where an ``Accelerator`` is set up for several processes.
    """

    call = "train.batches(...)"

    def __init__(
        self,
        dataset: Any,  # a MixedScans, whose module imports this one
        batch_size: int,
        *,
        rank: int | None = None,
        world_size: int | None = None,
        drop_last: bool = False,
    ) -> None:
        check_count("batch_size", batch_size, 1)
        check_mixture(dataset, DIVIDED)
        self.dataset = dataset
        self.batch_size = batch_size
        self.drop_last = drop_last
        self.divide(rank, world_size)
        self._start = (0, 0)  # epoch and position of the loaded state
        self._taken = (0, 0)  # epoch, and number of its batches taken so far
        # Samples that the dataset fetched before the latest complete pass, and in that pass.
        self._fetched = (0, 0)

    def __len__(self) -> int:
        """Number of batches in a pass."""
        self._check()
        return len(self._steps())

    def __iter__(self) -> Iterator[list[int]]:
        self._check()
        if not self.steps_from(0):
            raise ConfigError(
                f"{len(self.dataset)} samples of an epoch with drop_last=True",
                f"{self.batch_size * self.world_size} or more: a batch on every rank",
            )
        epoch = self.dataset.epoch
        if epoch != self._start[0]:  # the epoch that was resumed is over
            self._start = self._taken = (0, 0)
        steps = self._steps()
        if steps and len(steps[-1]) < self.world_size:
            warnings.warn(
                f"{len(steps[-1])} samples left for {self.world_size} ranks: some get none",
                stacklevel=2,
            )
        if self.dataset.current.passed.get(self.rank) == (epoch, steps.start):
            self.dataset.current.warn(REPEATED.format(epoch))
        before, yielded = self._fetched
        fetched = self.dataset.current.fetched - before
        if self.world_size > 1 and 0 < fetched < yielded * 2 / 3:
            warnings.warn(
                SHARED_TWICE.format(yielded, self.rank, self.world_size, fetched),
                stacklevel=2,
            )
        self._fetched = (0, 0)
        return self._batches(epoch, steps)

    def steps_from(self, start: int) -> CutSteps:
        """The steps of a pass that begins at a position."""
        return cut_steps(
            start, len(self.dataset), self.batch_size, self.world_size, self.drop_last
        )

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, before iterating; see ``MixedScans.set_epoch``."""
        self.dataset.set_epoch(epoch)

    def state_dict(self, done: int | None = None) -> dict[str, Any]:
        """The progress of training, from which any number of ranks and workers can resume.

        The keys are described in ``lidar_synth.mixing.state``.

        Args:
            done: number of batches that this rank has trained on since it began to iterate. The
                default, the batches taken from this sampler, is correct without workers and in
                torchdata's ``StatefulDataLoader``. In a ``DataLoader`` with workers it would
                include the prefetched batches.

        Raises:
            ConfigError: on more batches than the epoch has.
        """
        steps = self._steps()
        epoch = self.dataset.epoch
        mixture = self.dataset.mixture
        if done is None:
            done = self._taken[1] if self._taken[0] == epoch else 0
            if done >= len(steps):
                # Not the next epoch yet: a trainer that resumes here still has to see the end of
                # this one.
                return make_state(mixture, epoch, len(self.dataset))
        return make_state(mixture, *after_batches(mixture, epoch, steps, done))

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state, and set the dataset to its epoch. Later epochs start at position 0.

        Raises:
            ConfigError: on an invalid state, or one of another mixture.
        """
        self._start = check_state(state, self.dataset.mixture)
        self._taken = (0, 0)
        self.dataset.current.forget_pass()
        resume_epoch(self.dataset, *self._start)

    def _batches(self, epoch: int, steps: CutSteps) -> Iterator[list[int]]:
        announced = number = yielded = 0
        before = self.dataset.current.fetched
        for done, step in enumerate(steps):
            if done * steps.size >= announced:
                rest = (
                    rank_share(steps[i], self.rank, self.world_size)
                    for i in range(done, len(steps))
                )
                self.dataset.expect(epoch, chain.from_iterable(rest))
                announced = done * steps.size + AHEAD * self.world_size // 2
            if share := rank_share(step, self.rank, self.world_size):
                number += 1
                yielded += len(share)
                self._taken = (epoch, number)
                yield [Position(position, epoch) for position in share]
        self.dataset.current.passed[self.rank] = (epoch, steps.start)
        self._fetched = (before, yielded)

    def _steps(self) -> CutSteps:
        epoch, start = self._start
        return self.steps_from(start if epoch == self.dataset.epoch else 0)
