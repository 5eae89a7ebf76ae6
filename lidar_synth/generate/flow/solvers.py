"""Solvers of dy/dt = v(y, t, c) downwards from noise at t = 1 to data at t = 0 (Eq. 4).

The time grid is any descending sequence of times, evenly spaced or not; a distilled student has its
own.

To add a solver: write its step and enter it in ``SOLVERS`` with its order; the tests measure the
order.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lidar_synth.errors import ConfigError, check_count, choose
from lidar_synth.generate.flow.path import Velocity, per_sample

Grid = Sequence[float] | Tensor
"""S + 1 descending times for S steps, shared by all samples, or a tensor (S + 1, B) with one grid
per sample."""


class State(NamedTuple):
    """A point of a trajectory.

    Args:
        t: (B,) time, in the dtype of the state or float32, whichever is more precise.
        y: (B, ...) state.
        velocity: (B, ...) mean velocity of the next step, (y_next - y) / (t_next - t); None at the
            end.
    """

    t: Tensor
    y: Tensor
    velocity: Tensor | None


def euler(
    velocity: Velocity, y: Tensor, t: Tensor, t_next: Tensor, cond: Any
) -> Tensor:
    """v(y, t): one evaluation, first order."""
    return velocity(y, t, cond).to(y.dtype)


def heun(velocity: Velocity, y: Tensor, t: Tensor, t_next: Tensor, cond: Any) -> Tensor:
    """The mean of v at both ends of Euler's step: two evaluations, second order."""
    start = velocity(y, t, cond).to(y.dtype)
    end = velocity(y + per_sample(t_next - t, y) * start, t_next, cond).to(y.dtype)
    return (start + end) / 2


class Solver(NamedTuple):
    """One solver.

    Args:
        slope: ``slope(velocity, y, t, t_next, cond)``, the mean velocity over a step.
        order: order of the global error.
        evaluations: evaluations of the network per step.
    """

    slope: Callable[[Velocity, Tensor, Tensor, Tensor, Any], Tensor]
    order: int
    evaluations: int


SOLVERS = {"euler": Solver(euler, 1, 1), "heun": Solver(heun, 2, 2)}
"""Solvers by name."""


def uniform_grid(steps: int, start: float = 1.0, end: float = 0.0) -> tuple[float, ...]:
    """``steps`` + 1 evenly spaced times from ``start`` down to ``end``.

    Raises:
        ConfigError: on fewer than one step, or a part of one.
    """
    check_count("steps", steps, 1)
    return tuple((start * (steps - i) + end * i) / steps for i in range(steps + 1))


def read_grid(times: Sequence[float | str]) -> tuple[float, ...]:
    """A time grid that a user gives, as numbers or text.

    Raises:
        ConfigError: if they are no numbers that descend from 1 to 0.
    """
    try:
        grid = tuple(map(float, times))
    except ValueError:
        grid = ()
    falls = all(a > b for a, b in pairwise(grid))
    if not falls or grid[:1] + grid[-1:] != (1, 0):
        raise ConfigError(
            f"a time grid of {', '.join(map(str, times))}",
            "descending times from 1 to 0, such as 1, 0.86, 0.58, 0.22, 0",
        )
    return grid


def trajectory(
    velocity: Velocity, y: Tensor, grid: Grid, solver: str = "euler", cond: Any = None
) -> Iterator[State]:
    """Solve dy/dt = v(y, t, cond) along the grid, and yield the states one at a time.

    Only the current state is in memory. It keeps its dtype (float32 is recommended), independent of
    the network's dtype.

    Args:
        velocity: the velocity of the flow.
        y: (B, ...) state at the first time of the grid.
        grid: descending times within [0, 1].
        solver: a key of ``SOLVERS``.
        cond: the condition, passed to ``velocity`` at each step.

    Yields:
        S + 1 states.

    Raises:
        ConfigError: on an unknown solver or a grid that does not descend within [0, 1].
    """
    choose("solver", solver, SOLVERS)
    times = _times(grid, y)
    for t, t_next in pairwise(times):
        slope = SOLVERS[solver].slope(velocity, y, t, t_next, cond)
        yield State(t, y, slope)
        y = y + per_sample(t_next - t, y) * slope
    yield State(times[-1], y, None)


def solve(
    velocity: Velocity, y: Tensor, grid: Grid, solver: str = "euler", cond: Any = None
) -> Tensor:
    """Solve dy/dt = v(y, t, cond) along the grid, and return the state (B, ...) at its last time.

    Arguments and errors are those of ``trajectory``.

    Example:
        >>> import torch
        >>> from lidar_synth.generate.flow.solvers import solve, uniform_grid
        >>> def velocity(y, t, cond):  # dy/dt = y: from t = 1 to t = 0 the state shrinks to 1/e
        ...     return y
        >>> solve(velocity, torch.ones(1), uniform_grid(100), solver="heun")
        tensor([0.3679])
    """
    for state in trajectory(velocity, y, grid, solver, cond):
        y = state.y
    return y


def mean_velocity(velocity: Velocity, grid: Sequence[float]) -> Velocity:
    """A network with ``ends`` as a v(y, t, cond) for the steps of a grid: its mean velocity until
    the next time. Other velocities are returned as they are.

    Raises:
        ConfigError: on a grid that does not descend within [0, 1].
    """
    if not getattr(velocity, "ends", False):
        return velocity
    ascending = check_grid(grid).flip(0)

    def mean_velocity(y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
        times = ascending.to(t.device, t.dtype)
        following = (torch.searchsorted(times, t.contiguous()) - 1).clamp_min(0)
        return velocity(y, t, cond, times[following])  # type: ignore[call-arg]

    return mean_velocity


def check_grid(grid: Sequence[float] | Tensor) -> Tensor:
    """(S + 1,) float64 times on the CPU.

    Raises:
        ConfigError: on a grid that does not descend within [0, 1].
    """
    times = torch.as_tensor(grid, dtype=torch.float64, device="cpu")
    inside = times.ndim == 1 and len(times) >= 2 and times[0] <= 1 and times[-1] >= 0
    if not inside or not (times.diff() < 0).all():
        raise ConfigError(
            f"time grid {times.tolist()}",
            "at least two descending times within [0, 1], noise first",
        )
    return times


def _times(grid: Grid, y: Tensor) -> Tensor:
    """(S + 1, B) times on the device of y."""
    # from distillation, already on the device; a check would synchronise
    if isinstance(grid, Tensor) and grid.ndim == 2:
        return grid
    dtype = torch.promote_types(y.dtype, torch.float32)
    times = check_grid(grid).to(y.device, dtype, non_blocking=True)
    return times[:, None].expand(-1, len(y))
