"""Flows whose solution is known."""

from typing import Any

from torch import Tensor

from lidar_synth.generate.flow.path import per_sample
from lidar_synth.generate.flow.timesteps import Selection, sum_costs

MEAN = 0.5
STD = 0.1
"""Of the data of the Gaussian flow."""


def _moments(t: Tensor, y: Tensor, spread: float = STD) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of y_t = (1 - t) y0 + t y1."""
    t = per_sample(t, y)
    return (1 - t) * MEAN, ((1 - t) ** 2 * spread**2 + t**2).sqrt()


def gaussian_velocity(
    y: Tensor, t: Tensor, cond: Any = None, spread: float = STD
) -> Tensor:
    """E[y1 - y0 | y_t = y] for data N(MEAN, spread^2), element by element."""
    mean, std = _moments(t, y, spread)
    t = per_sample(t, y)
    return -MEAN + (t - (1 - t) * spread**2) / std**2 * (y - mean)


def gaussian_flow(y: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Where the flow carries y from time ``start`` to ``end``: quantiles are kept."""
    mean, std = _moments(start, y)
    mean_end, std_end = _moments(end, y)
    return mean_end + std_end / std * (y - mean)


def select_timesteps(*args: Any, **options: Any) -> Selection:
    """The selection of ``sum_costs`` on all of its trajectories."""
    *_, costs = sum_costs(*args, progress=False, **options)
    return costs.selection
