"""Random weights and points for detectors, the same on every machine."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def random_state(like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Random weights with the names and shapes of a network, by name in alphabetical order."""
    rng = np.random.RandomState(7)
    state = {}
    for name in sorted(like):
        shape = tuple(like[name].shape)
        if name.endswith(("num_batches_tracked", "global_step")):
            state[name] = torch.zeros(shape, dtype=torch.int64)
            continue
        value = rng.standard_normal(shape)
        if name.endswith("running_var") or (len(shape) == 1 and "weight" in name):
            value = 1 + 0.3 * np.abs(value)
        elif len(shape) == 1:
            value = 0.1 * value
        elif "dense_head" in name:
            value = 0.01 * value
        else:
            value = value * np.sqrt(2 / (value.size / shape[0]))
        state[name] = torch.from_numpy(np.asarray(value, np.float32))
    return state


def random_points() -> NDArray[np.float32]:
    """(6000, 4) points, some in crowded pillars and some outside the limits."""
    rng = np.random.RandomState(8)
    spread = rng.uniform((-5, -45, -3.5), (75, 45, 1.5), (4000, 3))
    crowd = (12, 3, -1) + rng.standard_normal((2000, 3)) * 0.3
    points = np.concatenate([spread, crowd])
    return np.column_stack([points, rng.uniform(size=6000)]).astype(np.float32)
