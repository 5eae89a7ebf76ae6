"""The state of a training run, for resumption, and the rank of a process.

A state is ``{"version", "seed", "epoch", "position", "mixture", "plan"}``. ``plan`` is the hash of
the epoch's plan, ``mixture`` everything that determines the plan in readable form, so that an error
can name what differs.
"""

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.plan import MixingPlan
from lidar_synth.mixing.quotas import Mixture

VERSION = 2
"""The version of a state."""


def place(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """This process's rank and the number of ranks.

    Args:
        rank, world_size: returned if given. The default is that of ``torch.distributed`` if it is
            initialised, else that of torchrun's environment variables (``RANK``, ``WORLD_SIZE``),
            else 0 of 1.

    Raises:
        ConfigError: on one without the other, or a rank out of range.
    """
    if rank is None and world_size is None:
        if _is_grouped():
            return torch.distributed.get_rank(), torch.distributed.get_world_size()
        if {"RANK", "WORLD_SIZE"} <= os.environ.keys():
            return int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        return 0, 1
    if rank is None or world_size is None or not 0 <= rank < world_size:
        raise ConfigError(
            f"rank {rank} of {world_size}", "both, 0 <= rank < world_size"
        )
    return rank, world_size


def _is_grouped() -> bool:
    """Whether this process is in a process group of ``torch.distributed``."""
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def count_accelerated() -> int:
    """Number of processes of an ``Accelerator`` that is set up, 0 without one."""
    state = sys.modules.get("accelerate.state")
    if state and state.is_initialized():
        return int(state.PartialState().num_processes)
    return 0


class Divided:
    """Base class of batches and streams that are divided among ranks.

    Default ranks follow a process group that is made later. They are refused where an
    ``Accelerator`` may divide the batches among the same processes a second time."""

    call: str
    """The call that makes the object, for error messages."""
    _divided: tuple[int, int]
    _default_rank: bool

    def divide(self, rank: int | None, world_size: int | None) -> None:
        """Change the rank of this process and the number of ranks, before iterating; arguments as
        of ``place``."""
        self._divided = place(rank, world_size)
        self._default_rank = rank is None

    @property
    def rank(self) -> int:
        """The rank of this process."""
        return self._current_place()[0]

    @property
    def world_size(self) -> int:
        """The number of ranks."""
        return self._current_place()[1]

    def _current_place(self) -> tuple[int, int]:
        # Spawned workers have no process group: they keep what the main process had.
        if self._default_rank and _is_grouped():
            self._divided = place(None, None)
        return self._divided

    def _check(self) -> None:
        """Refuse default ranks.

        Raises:
            ConfigError: if an ``Accelerator`` is set up for several processes.
        """
        if self._default_rank and self.world_size > 1 and count_accelerated() > 1:
            raise ConfigError(
                f"{self.call} with the default rank {self.rank} of {self.world_size} and an "
                "Accelerator, which divides prepared loaders among the same processes again: most "
                "samples would never be seen",
                "only one of the two to divide the samples",
                "from lidar_synth.integrations.accelerate import prepare; loader = "
                f"prepare(accelerator, loader). If it is not prepared, call {self.call} with "
                "rank=accelerator.process_index, world_size=accelerator.num_processes.",
            )


def make_state(mixture: Mixture, epoch: int, position: int) -> dict[str, Any]:
    """The state of a run that resumes at a position of an epoch."""
    plan = MixingPlan(mixture, epoch)
    return {
        "version": VERSION,
        "seed": mixture.seed,
        "epoch": epoch,
        "position": position,
        "mixture": plan.facts,
        "plan": plan.hash,
    }


def after_epoch(mixture: Mixture, epoch: int) -> tuple[int, int]:
    """Epoch and position after an epoch: the beginning of the next, or the same epoch's end if it
    was the last."""
    try:
        MixingPlan(mixture, epoch + 1)
    except ConfigError:
        return epoch, mixture.length
    return epoch + 1, 0


def after_batches(
    mixture: Mixture, epoch: int, steps: Sequence[range], done: int
) -> tuple[int, int]:
    """Epoch and position after a number of steps of an epoch.

    Raises:
        ConfigError: on more than it has.
    """
    if not 0 <= done <= len(steps):
        raise ConfigError(
            f"{done} batches done of {len(steps)}", "a number of batches of this epoch"
        )
    if done < len(steps):
        return epoch, steps[done].start
    return after_epoch(mixture, epoch)


def check_state(state: Mapping[str, Any], mixture: Mixture) -> tuple[int, int]:
    """The epoch and position of a state, after checking that it fits the mixture.

    Raises:
        ConfigError: on missing or impossible values, or the state of another mixture.
    """
    values: list[Any] = [state.get(key) for key in ("epoch", "position")]
    if (
        not all(isinstance(value, int) and value >= 0 for value in values)
        or "plan" not in state
    ):
        raise ConfigError(
            f"state {dict(state)}",
            "epoch and position, integers of 0 or more, and the hash of the plan",
        )
    epoch, position = values
    here = make_state(mixture, epoch, position)
    if differences := list(_differences({**here, **state}, here, "")):
        raise ConfigError(
            f"a state of another mixture: {'; '.join(differences[:4])}",
            "the mixture with which the state was saved",
            f"To start epoch {epoch} of this mixture from the beginning, call set_epoch({epoch}) "
            "and load no state.",
        )
    if position > mixture.length:
        raise ConfigError(
            f"position {position} of an epoch of {mixture.length} samples",
            "a state of this mixture",
        )
    return epoch, position


def _differences(then: Any, now: Any, name: str) -> Iterator[str]:
    """Describe each value that differs, with its name."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        for key in now:
            yield from _differences(then.get(key), now[key], f"{name} {key}".strip())
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for number, (one, other) in enumerate(zip(then, now, strict=True)):
            yield from _differences(one, other, f"{name}[{number}]")
    elif then != now:
        yield f"{name} {then}, here {now}"
