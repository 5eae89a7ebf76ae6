"""How far a run has come, as a few integers, and where a process stands among others."""

import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import ConfigError


def shared_integers(*values: int) -> Tensor:
    """(n,) int64 that DataLoader workers see change, forked, spawned and persistent ones alike.

    A plain attribute would not do: persistent workers keep their copy of the dataset from when they started.
    """
    tensor = torch.tensor(values, dtype=torch.int64)
    tensor.share_memory_()  # type: ignore[no-untyped-call]
    return tensor


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


def checked_state(state: Mapping[str, Any], seed: int) -> tuple[int, int]:
    """Epoch and position of a state {seed, epoch, position}.

    Raises:
        ConfigError: on missing or impossible values, or the state of another seed.
    """
    values = [state.get(key) for key in ("seed", "epoch", "position")]
    if not all(isinstance(value, int) and value >= 0 for value in values):
        raise ConfigError(f"state {dict(state)}", "seed, epoch and position, integers of 0 or more")
    if values[0] != seed:
        raise ConfigError(f"the state of seed {values[0]} for a mixture of seed {seed}", "the seed of the state")
    return values[1], values[2]  # type: ignore[return-value]  # integers, see above
