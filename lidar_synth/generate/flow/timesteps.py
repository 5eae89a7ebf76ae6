"""Adaptive timestep selection: the best division of a teacher's trajectories into N straight pieces
(Eq. 5).

The teacher is solved by Euler's method in M uniform steps, t_0 = 1 > ... > t_M = 0. The cost of one
straight step from t_i to t_j with the velocity at t_i is ::

    C[i, j] = E_trajectories m(y_i + (t_j - t_i) v_i, y_j),        i < j

and the timesteps of an N-step student are the path of exactly N intervals from 0 to M with the
least total cost, shared by all trajectories: C is averaged first, then dynamic programming in O(N
M^2) finds the path. Trajectories are streamed, so that only C is kept in memory.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.flow.path import METRICS, Metric, Velocity
from lidar_synth.generate.flow.solvers import trajectory, uniform_grid
from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.noise import gaussian

Costs = NDArray[np.float64]
"""(..., M + 1, M + 1) cost of one straight step from candidate i to candidate j > i; inf where j <=
i."""

_CHUNK = {"cpu": 2**18, "cuda": 2**25}
"""Elements that the cost matrix compares at a time: few enough for a CPU's cache (five times
faster), enough to fill a GPU."""


@dataclass(frozen=True)
class Selection:
    """Result of the timestep selection.

    Args:
        grid: N + 1 descending times from 1 to 0, the student's time grid.
        cost: total cost of ``grid``, in the units of the metric.
        uniform_cost: total cost of N uniform intervals.
        candidates: M + 1 descending times.
        costs: (M + 1, M + 1) mean cost matrix.
        per_trajectory: (trajectories, N - 1) inner times that are best for each trajectory alone
            (the paper's Figure 3).
    """

    grid: tuple[float, ...]
    cost: float
    uniform_cost: float
    candidates: tuple[float, ...] = field(repr=False)
    costs: Costs = field(repr=False)
    per_trajectory: NDArray[np.float64] = field(repr=False)

    def grid_of(self, intervals: int) -> tuple[float, ...]:
        """The best time grid of another number of intervals on the same trajectories."""
        return tuple(self.candidates[i] for i in best_path(self.costs, intervals))


@dataclass(frozen=True)
class TrajectoryCosts:
    """The costs of the first trajectories of a selection, and their own best paths.

    Args:
        total: (M + 1, M + 1) sum of the cost matrices.
        optima: (trajectories, N + 1) candidate indices.
    """

    total: Costs
    optima: Int64Array

    @property
    def selection(self) -> Selection:
        """The selection on these trajectories."""
        intervals = self.optima.shape[1] - 1
        candidates = len(self.total) - 1
        costs = self.total / len(self.optima)
        times = uniform_grid(candidates)
        path = best_path(costs, intervals)
        uniform = np.round(np.linspace(0, candidates, intervals + 1)).astype(np.int64)
        return Selection(
            grid=tuple(times[i] for i in path),
            cost=path_cost(costs, path),
            uniform_cost=path_cost(costs, uniform),
            candidates=times,
            costs=costs,
            per_trajectory=np.asarray(times)[self.optima[:, 1:-1]],
        )


def sum_costs(
    velocity: Velocity,
    shape: tuple[int, ...],
    intervals: int = 4,
    candidates: int = 100,
    trajectories: int = 256,
    metric: str | Metric = "pseudo_huber",
    seed: int = 0,
    batch: int = 1,
    device: torch.device | str = "cpu",
    condition: Callable[[range], Any] | None = None,
    progress: bool = True,
    done: TrajectoryCosts | None = None,
    each: Callable[..., Iterator[tuple[Costs, Int64Array]]] = map,
) -> Iterator[TrajectoryCosts]:
    """The costs of a selection, batch by batch: the last ones give the time grid of N steps on
    which a teacher's trajectories are straightest.

    Peak memory is that of ``batch`` trajectories (states and velocities: 105 MB each for 2x64x1024
    and M = 100), independent of the number of trajectories.

    Args:
        velocity: the teacher.
        shape: (C, H, W), shape of one state.
        intervals: N.
        candidates: M, uniform steps of the teacher.
        trajectories: number of trajectories to average over; trajectory k starts from the noise of
            (``seed``, k).
        metric: m, a key of ``METRICS`` or a callable; the metric of the student's training.
        seed: seed of the noise.
        batch: number of trajectories computed at once.
        device: device of the teacher.
        condition: gives the conditions of a range of trajectories; None = unconditional.
        progress: whether to show a progress bar.
        done: the last costs of an earlier call, which this one continues.
        each: a ``map`` that may compute the batches in other processes, in order, as the order
            affects rounding.

    Yields:
        The costs of all trajectories up to now, after each batch.

    Raises:
        ConfigError: on an unknown metric or impossible numbers.
        DataError: if the teacher returns NaN or infinity.
    """
    if not 1 <= intervals <= candidates or trajectories < 1 or batch < 1:
        raise ConfigError(
            f"{intervals} intervals of {candidates} candidates on {trajectories} trajectories, "
            f"{batch} at a time",
            "1 <= intervals <= candidates, at least one trajectory, at least one at a time",
        )
    if isinstance(metric, str) and metric not in METRICS:
        raise ConfigError(f"metric {metric!r}", f"one of {', '.join(METRICS)}")
    m = METRICS[metric] if isinstance(metric, str) else metric
    times = uniform_grid(candidates)
    if done is None:
        size = candidates + 1
        nothing = np.zeros((0, intervals + 1), np.int64)
        done = TrajectoryCosts(np.zeros((size, size)), nothing)
    count = len(done.optima)
    bar = tqdm(
        total=trajectories, initial=count, desc="trajectories", disable=not progress
    )

    def compute(first: int) -> tuple[Costs, Int64Array]:
        part = range(first, min(first + batch, trajectories))
        cond = condition(part) if condition else None
        with torch.inference_mode():
            start = gaussian(seed, part, shape, device)
            costs = cost_matrix(velocity, start, times, m, cond)
        return costs.sum(0), best_path(costs, intervals)

    with bar:
        for total, optima in each(compute, range(count, trajectories, batch)):
            joined = np.concatenate((done.optima, optima))
            done = TrajectoryCosts(done.total + total, joined)
            bar.update(len(optima))
            yield done


def cost_matrix(
    velocity: Velocity,
    start: Tensor,
    times: tuple[float, ...],
    metric: Metric,
    cond: Any = None,
) -> Costs:
    """The cost matrices of a batch of trajectories, solved by Euler's method.

    Args:
        velocity: the teacher.
        start: (B, ...) noise.
        times: M + 1 descending times.
        metric: m.
        cond: the teacher's condition.

    Returns:
        (B, M + 1, M + 1) float64.

    Raises:
        DataError: on a cost that is not finite.
    """
    count = len(times)
    y = start.new_empty(len(start), count, *start.shape[1:])
    v = torch.empty_like(y[:, 1:])
    for i, state in enumerate(trajectory(velocity, start, times, "euler", cond)):
        y[:, i] = state.y
        if state.velocity is not None:
            v[:, i] = state.velocity
    costs = y.new_full((len(start), count, count), torch.inf)
    ahead = y.new_tensor(times).reshape(-1, *[1] * (start.ndim - 1))
    rows = max(1, _CHUNK.get(y.device.type, 2**18) // start[0].numel())
    for b in range(len(start)):
        for i in range(count - 1):
            for first in range(i + 1, count, rows):
                part = slice(first, first + rows)
                straight = torch.addcmul(y[b, i], ahead[part] - ahead[i], v[b, i])
                costs[b, i, part] = metric(straight, y[b, part])
    if not costs.triu(1).isfinite().all():
        raise DataError(
            "the teacher's trajectory is not finite",
            "finite velocities",
            "Check the checkpoint.",
        )
    return costs.double().cpu().numpy()


def best_path(costs: Costs, intervals: int) -> Int64Array:
    """The cheapest path of exactly N intervals through the candidates, by dynamic programming.

    Args:
        costs: (..., M + 1, M + 1) cost matrices.
        intervals: N, 1 <= N <= M.

    Returns:
        (..., N + 1) ascending candidate indices from 0 to M.
    """
    best = costs[..., 0, :]  # best[j]: cheapest path of n intervals from 0 to j, n = 1
    choices = []
    for _ in range(intervals - 1):
        longer = best[..., :, None] + costs
        choices.append(longer.argmin(-2))
        best = longer.min(-2)
    path = [np.full(costs.shape[:-2], costs.shape[-1] - 1)]
    for choice in reversed(choices):
        path.append(np.take_along_axis(choice, path[-1][..., None], -1)[..., 0])
    return np.stack([np.zeros_like(path[0]), *reversed(path)], -1)


def path_cost(costs: Costs, path: Int64Array) -> float:
    """Total cost of a path (N + 1,) through one cost matrix."""
    return float(sum(costs[i, j] for i, j in pairwise(path)))
