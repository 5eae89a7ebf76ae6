"""How far a run has come, and where a process stands among others.

A state is ``{"version", "seed", "epoch", "position", "plan", "mixture"}``: the hash of the epoch's plan, and all that
the plan follows from in readable form, so that a refusal can name the difference.
"""

import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.plan import MixingPlan
from lidar_synth.mixing.quotas import Mixture

VERSION = 2
"""Of a state. The first one had seed, epoch and position only."""


def place(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """This process's rank and the number of ranks.

    Args:
        rank, world_size: given ones count. By default those of ``torch.distributed``, before it is set up those that
            torchrun tells (``RANK``, ``WORLD_SIZE``), else 0 of 1.

    Raises:
        ConfigError: on one without the other, or a rank out of range.
    """
    if rank is None and world_size is None:
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            return torch.distributed.get_rank(), torch.distributed.get_world_size()
        launched = "RANK" in os.environ and "WORLD_SIZE" in os.environ
        return (int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])) if launched else (0, 1)
    if rank is None or world_size is None or not 0 <= rank < world_size:
        raise ConfigError(f"rank {rank} of {world_size}", "both, 0 <= rank < world_size")
    return rank, world_size


def check_unshared(what: str, rank: int, world_size: int) -> None:
    """Refuse ranks by default where an ``Accelerator`` may share the batches among the same processes once more.

    Raises:
        ConfigError: there.
    """
    accelerate = sys.modules.get("accelerate.state")
    if world_size > 1 and accelerate and accelerate.PartialState._shared_state.get("num_processes", 1) > 1:
        raise ConfigError(
            f"{what} for rank {rank} of {world_size} by default, and an Accelerator, which shares what it prepares "
            "among the same processes: most samples would never be seen",
            "one of the two to share",
            f"For a loader that accelerator.prepare gets, give {what} rank=0, world_size=1; for any other one "
            "rank=accelerator.process_index, world_size=accelerator.num_processes.",
        )


def make_state(mixture: Mixture, epoch: int, position: int) -> dict[str, Any]:
    """The state of a run that goes on at a position of an epoch."""
    made = MixingPlan(mixture, epoch)
    return {
        "version": VERSION,
        "seed": mixture.seed,
        "epoch": epoch,
        "position": position,
        "plan": made.hash,
        "mixture": made.facts,
    }


def after_epoch(mixture: Mixture, epoch: int) -> tuple[int, int]:
    """Epoch and position where an epoch is over: the next one's beginning, or its own end where the schedule ends."""
    try:
        MixingPlan(mixture, epoch + 1)
    except ConfigError:
        return epoch, len(MixingPlan(mixture, epoch))
    return epoch + 1, 0


def checked_state(state: Mapping[str, Any], mixture: Mixture) -> tuple[int, int]:
    """Epoch and position of a state.

    Raises:
        ConfigError: on missing or impossible values, or the state of another mixture.
    """
    values = [state.get(key) for key in ("seed", "epoch", "position")]
    if not all(isinstance(value, int) and value >= 0 for value in values):
        raise ConfigError(f"state {dict(state)}", "seed, epoch and position, integers of 0 or more")
    seed, epoch, position = (int(value or 0) for value in values)
    if seed != mixture.seed:
        raise ConfigError(f"the state of seed {seed} for a mixture of seed {mixture.seed}", "the seed of the state")
    here = MixingPlan(mixture, epoch)
    if "plan" not in state:
        _check_old(state, position)
    elif state["plan"] != here.hash:
        differences = list(_differences(state.get("mixture"), here.facts, ""))
        raise ConfigError(
            f"a state of another mixture: {'; '.join(differences[:4]) or 'its plan has another hash'}",
            "the mixture that it was taken from",
            f"To begin epoch {epoch} of this mixture anew, call set_epoch({epoch}) and load no state.",
        )
    if position > len(here):
        raise ConfigError(f"position {position} of an epoch of {len(here)} samples", "a state of this mixture")
    return epoch, position


def _check_old(state: Mapping[str, Any], position: int) -> None:
    """A state of the first version: it cannot tell its mixture, and its order is no longer made."""
    if position:
        raise ConfigError(
            f"a state without its plan, {dict(state)}, in the middle of an epoch; this version makes another order",
            "a state that this version gave",
            "To begin that epoch anew, set its position to 0; to leave the rest of it out, add 1 to its epoch too.",
        )
    warnings.warn("a state without its plan: whether it belongs to this mixture cannot be told", stacklevel=4)


def _differences(then: Any, now: Any, name: str) -> Iterator[str]:
    """What differs, by its name, leaf by leaf."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        for key in now:
            yield from _differences(then.get(key), now[key], f"{name} {key}".strip())
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for number, (one, other) in enumerate(zip(then, now, strict=True)):
            yield from _differences(one, other, f"{name}[{number}]")
    elif then != now:
        yield f"{name} {then}, here {now}"
