"""Distillation of a few-step student from a rectified-flow teacher.

Every strategy is one function that gives the supervision of a batch: states, times, and the
velocities that the student is trained to predict there. The strategies differ in the times of
training and in the part of the teacher's trajectory that the student approximates by a straight
line::

    strategy               time of training                 straightened part        source
    adaptive_piecewise     starts of selected intervals     interval's start -> end  Algorithm 1
    uniform_piecewise      starts of equal intervals        interval's start -> end  its ablation
    piecewise_reflow       anywhere in an interval          interval's start -> end  PeRFlow
    reflow                 anywhere in [0, 1]               noise -> data            2-RF
    timestep_distillation  starts of equal intervals        noise -> data            k-TD of R2Flow

Euler steps of the teacher give the end of each part; the example counts the evaluations. Sources:
LiDAR-Flow (the paper, Eq. 6); Yan et al., "PeRFlow", NeurIPS 2024; Liu et al., "Flow Straight and
Fast", ICLR 2023 (reflow and k-step distillation); Nakashima et al., "Fast LiDAR Data Generation
with Rectified Flows", ICRA 2025. R2Flow generates its pairs of noise and data once, before
training, and distils the timesteps of its 2-RF model. Here the pairs are generated during training,
from any teacher.

To add a strategy: write its function and enter it in ``STRATEGIES``; the tests run over the
dictionary. One student for several numbers of steps is trained by ``every_piece``.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import ConfigError, check_count
from lidar_synth.generate.flow.path import Example, Velocity, interpolate, per_sample
from lidar_synth.generate.flow.solvers import check_grid, solve, uniform_grid

Strategy = Callable[
    [Velocity, Tensor, Tensor, Tensor, Sequence[float], int, Any], Example
]
"""``strategy(teacher, y0, y1, u, grid, steps, cond)``. All strategies have the same arguments and
raise a ``ConfigError`` on a grid or a number of steps that they do not support:

- teacher: the velocity to distil; it is evaluated without gradients.
- y0: (B, ...) data; reflow and timestep distillation ignore it and use the teacher's data.
- y1: (B, ...) noise.
- u: (B,) uniform numbers in (0, 1) (``noise.uniform``) that select the time of training of each
  sample. For ``reflow``, u is the time t itself (R2Flow's is ``path.u_shaped``).
- grid: N + 1 descending times from 1 to 0, the student's time grid.
- steps: Euler steps of the teacher in an interval; from noise to data, it takes N times as many.
- cond: the condition, passed to the teacher.
"""


def adaptive_piecewise(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    u: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any = None,
) -> Example:
    """Algorithm 1: at the start t_i of a random interval and y = (1 - t_i) y0 + t_i y1, the target
    is the constant velocity to the teacher's state at the end of the interval. ``grid`` comes from
    a ``Selection``."""
    interval = (u * (len(grid) - 1)).long().clamp_(max=len(grid) - 2)
    start, end = _bounds(interval, grid, u)
    y = interpolate(y0, y1, start)
    return Example(
        y, start, _slope(teacher, y, start, end, steps, cond), steps * len(y)
    )


def uniform_piecewise(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    u: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any = None,
) -> Example:
    """Algorithm 1 on a uniform grid, without timestep selection.

    Raises:
        ConfigError: on a grid that is not uniform.
    """
    check_uniform(grid)
    return adaptive_piecewise(teacher, y0, y1, u, grid, steps, cond)


def piecewise_reflow(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    u: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any = None,
) -> Example:
    """PeRFlow: t is uniform in [0, 1]; state and velocity are those of the straight line from the
    start of t's interval to the teacher's state at its end."""
    start, end = _bounds(interval_of(u, grid), grid, u)
    y_start = interpolate(y0, y1, start)
    slope = _slope(teacher, y_start, start, end, steps, cond)
    return Example(
        y_start + per_sample(u - start, y0) * slope, u, slope, steps * len(y0)
    )


def reflow(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    u: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any = None,
) -> Example:
    """Flow matching on pairs of noise and the data that the teacher generates from it, with t
    uniform in [0, 1]."""
    return _straight(teacher, y1, u, grid, steps, cond)


def timestep_distillation(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    u: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any = None,
) -> Example:
    """Reflow with t moved up to the start of its interval, so that only the N times of sampling are
    trained. On a uniform grid, this equals R2Flow's rounding of its time (0 = noise) to floor(N t)
    / N.

    Raises:
        ConfigError: on a grid that is not uniform.
    """
    check_uniform(grid)
    start, _ = _bounds(interval_of(u, grid), grid, u)
    return _straight(teacher, y1, start, grid, steps, cond)


def every_piece(
    teacher: Velocity,
    y0: Tensor,
    y1: Tensor,
    grids: Sequence[Sequence[float]],
    steps: int,
    cond: Any = None,
) -> Example:
    """The supervision of one student for several numbers of steps, which is told where a step ends:
    every interval of all grids.

    Intervals that begin at noise are parts of one trajectory of the teacher. The others begin
    between data and noise, as in Algorithm 1.

    Args:
        teacher: the velocity to distil.
        y0, y1: (B, ...) data and noise.
        grids: the time grids.
        steps: Euler steps of the teacher in an interval of the first grid, in the mean; longer
            intervals have more.
        cond: (B, ...) conditions, passed to the teacher.

    Returns:
        An example of P B samples, P intervals in the order of the grids. Its condition is repeated,
        too.

    Raises:
        ConfigError: on fewer than one step, or a grid that does not descend within [0, 1].
    """
    check_count("steps of the teacher", steps, 1)
    pieces = [(a, b) for grid in grids for a, b in pairwise(check_grid(grid).tolist())]
    evaluations = 0
    total = steps * (len(grids[0]) - 1)

    def follow(y: Tensor, a: float, b: float) -> Tensor:
        nonlocal evaluations
        count = max(1, round(total * (a - b)))
        evaluations += count * len(y)
        return solve(teacher, y, uniform_grid(count, a, b), "euler", cond)

    with torch.no_grad():
        from_noise = {1.0: y1}
        times = sorted({1.0, *(b for a, b in pieces if a == 1)}, reverse=True)
        for a, b in pairwise(times):
            from_noise[b] = follow(from_noise[a], a, b)
        start, end = (
            torch.cat([y1.new_full((len(y1),), t) for t in side])
            for side in zip(*pieces, strict=True)
        )
        states = [y1 if a == 1 else torch.lerp(y0, y1, a) for a, _ in pieces]
        ends = [
            from_noise[b] if a == 1 else follow(y, a, b)
            for y, (a, b) in zip(states, pieces, strict=True)
        ]
    y = torch.cat(states)
    y_end = torch.cat(ends)
    repeated = None if cond is None else torch.cat([cond] * len(pieces))
    return Example(
        y, start, (y_end - y) / per_sample(end - start, y), evaluations, repeated, end
    )


STRATEGIES: dict[str, Strategy] = {
    "adaptive_piecewise": adaptive_piecewise,
    "uniform_piecewise": uniform_piecewise,
    "piecewise_reflow": piecewise_reflow,
    "reflow": reflow,
    "timestep_distillation": timestep_distillation,
}
"""Strategies by name."""


def interval_of(t: Tensor, grid: Sequence[float]) -> Tensor:
    """(B,) index of the interval (t_{i+1}, t_i] of a descending grid that contains t; 0 = the
    noisiest."""
    ascending = _times(grid, t).flip(0)
    above = torch.searchsorted(ascending, t.contiguous()).clamp_(1, len(grid) - 1)
    return len(grid) - 1 - above


def _bounds(
    interval: Tensor, grid: Sequence[float], like: Tensor
) -> tuple[Tensor, Tensor]:
    """(B,) start and end times of the intervals."""
    times = _times(grid, like)
    return times[interval], times[interval + 1]


def _times(grid: Sequence[float], like: Tensor) -> Tensor:
    """(N + 1,) times of the student's grid, with the device and dtype of ``like``."""
    times = check_grid(grid)
    if times[0] != 1 or times[-1] != 0:
        raise ConfigError(f"time grid {times.tolist()}", "one from 1 down to 0")
    # non_blocking: a training does this in every step, and should not wait for the GPU.
    return times.to(like.device, like.dtype, non_blocking=True)


def _slope(
    teacher: Velocity, y: Tensor, start: Tensor, end: Tensor, steps: int, cond: Any
) -> Tensor:
    """(B, ...) constant velocity between y at ``start`` and the state that the teacher reaches at
    ``end``."""
    check_count("steps of the teacher", steps, 1)
    shares = torch.linspace(0, 1, steps + 1, dtype=start.dtype, device=start.device)
    times = torch.lerp(start[None], end[None], shares[:, None])
    with torch.no_grad():
        y_end = solve(teacher, y, times, "euler", cond)
        return (y_end - y) / per_sample(end - start, y)


def _straight(
    teacher: Velocity,
    y1: Tensor,
    t: Tensor,
    grid: Sequence[float],
    steps: int,
    cond: Any,
) -> Example:
    """The example at t on the straight line from noise to the teacher's data."""
    # The piecewise strategies follow the teacher through all intervals as finely.
    steps *= len(grid) - 1
    slope = _slope(teacher, y1, torch.ones_like(t), torch.zeros_like(t), steps, cond)
    return Example(y1 + per_sample(t - 1, y1) * slope, t, slope, steps * len(y1))


def check_uniform(grid: Sequence[float]) -> None:
    """Check a time grid of a strategy that takes a uniform one.

    Raises:
        ConfigError: on a grid that is not uniform.
    """
    uniform = uniform_grid(len(check_grid(grid)) - 1)
    if max(abs(a - b) for a, b in zip(grid, uniform, strict=True)) > 1e-6:
        raise ConfigError(
            f"time grid {tuple(grid)}",
            f"{uniform}, which is uniform",
            "Use adaptive_piecewise, or give no grid (in a recipe grid=null).",
        )
