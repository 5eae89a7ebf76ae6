"""Adaptive timestep selection against brute force and on flows whose best grid is known."""

import gc
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest
import torch
from flows import gaussian_velocity, select_timesteps
from hypothesis import given, strategies as st
from torch import Tensor

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.flow.path import METRICS, per_sample
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.flow.timesteps import (
    best_path,
    cost_matrix,
    path_cost,
)
from lidar_synth.noise import gaussian

SHAPE = (2, 3, 8)


def random_costs(candidates: int, seed: int, batch: tuple[int, ...] = ()) -> np.ndarray:
    costs = np.random.default_rng(seed).random((*batch, candidates + 1, candidates + 1))
    return np.where(np.triu(np.ones_like(costs), 1) > 0, costs, np.inf)


def by_brute_force(costs: np.ndarray, intervals: int) -> tuple[int, ...]:
    last = len(costs) - 1
    paths = [(0, *inner, last) for inner in combinations(range(1, last), intervals - 1)]
    return min(paths, key=lambda path: sum(costs[i, j] for i, j in pairwise(path)))


@given(data=st.data(), candidates=st.integers(1, 9), seed=st.integers(0, 2**32))
def test_dynamic_programming_equals_brute_force(
    data: st.DataObject, candidates: int, seed: int
) -> None:
    intervals = data.draw(st.integers(1, candidates))
    costs = random_costs(candidates, seed, (2, 3))
    paths = best_path(costs, intervals)
    assert paths.shape == (2, 3, intervals + 1)
    for index in np.ndindex(2, 3):
        assert tuple(paths[index]) == by_brute_force(costs[index], intervals)


@pytest.mark.slow
@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize(
    "knots",
    [(1.0, 0.86, 0.58, 0.22, 0.0), (1.0, 0.42, 0.2, 0.08, 0.0), (1.0, 0.5, 0.0)],
)
def test_the_knots_of_a_piecewise_linear_flow_are_found(
    metric: str, knots: tuple[float, ...]
) -> None:
    velocities = gaussian(1, range(len(knots) - 1), SHAPE)

    def velocity(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        piece = (t[:, None] <= torch.tensor(knots[1:]) + 1e-6).sum(1)
        return velocities[piece]

    found = select_timesteps(velocity, SHAPE, len(knots) - 1, 50, 3, metric)
    assert found.grid == pytest.approx(knots)
    assert found.cost < 1e-6 < found.uniform_cost or knots == (1.0, 0.5, 0.0)
    assert np.allclose(found.per_trajectory, knots[1:-1])


def test_costs_equal_their_definition() -> None:
    times = uniform_grid(12)
    start = gaussian(0, range(3), SHAPE, dtype=torch.float64)
    costs = cost_matrix(gaussian_velocity, start, times, METRICS["pseudo_huber"])
    y = start
    states = [start]
    velocities = []
    for t, t_next in pairwise(times):
        velocities.append(
            gaussian_velocity(y, torch.full((3,), t, dtype=torch.float64))
        )
        y = y + (t_next - t) * velocities[-1]
        states.append(y)
    for i in range(13):
        for j in range(13):
            if j <= i:
                assert np.isinf(costs[:, i, j]).all()
                continue
            straight = states[i] + (times[j] - times[i]) * velocities[i]
            expected = METRICS["pseudo_huber"](straight, states[j])
            assert costs[:, i, j] == pytest.approx(expected.numpy(), rel=1e-9)


def test_the_selection_minimises_the_mean_cost_of_a_curved_flow() -> None:
    """The selection minimises the mean cost; each trajectory's own optimum costs at most as
    much."""
    found = select_timesteps(
        gaussian_velocity,
        SHAPE,
        4,
        40,
        7,
        "squared_l2",
        seed=3,
        batch=3,
    )
    noise = gaussian(3, range(7), SHAPE)
    costs = cost_matrix(
        gaussian_velocity, noise, uniform_grid(40), METRICS["squared_l2"]
    )
    path = [round((1 - t) * 40) for t in found.grid]
    assert found.costs[np.triu_indices(41, 1)] == pytest.approx(
        costs.mean(0)[np.triu_indices(41, 1)]
    )
    assert tuple(path) == by_brute_force(costs.mean(0), 4)
    assert found.cost == pytest.approx(path_cost(costs.mean(0), np.array(path)))
    assert found.uniform_cost == pytest.approx(
        path_cost(costs.mean(0), np.array([0, 10, 20, 30, 40]))
    )
    assert found.cost < found.uniform_cost
    assert found.per_trajectory.shape == (7, 3)
    for one, times in zip(costs, found.per_trajectory, strict=True):
        own = [0, *np.round((1 - times) * 40).astype(int), 40]
        assert path_cost(one, np.array(own)) <= path_cost(one, np.array(path)) + 1e-12
    assert (
        found.candidates == uniform_grid(40)
        and found.grid[0] == 1
        and found.grid[-1] == 0
    )


@pytest.mark.slow
def test_the_batch_size_changes_only_rounding() -> None:
    one, three = (
        select_timesteps(gaussian_velocity, SHAPE, 3, 20, 8, batch=b) for b in (1, 3)
    )
    assert one.grid == three.grid
    assert np.allclose(
        np.triu(one.costs, 1), np.triu(three.costs, 1), rtol=1e-5, atol=1e-9
    )
    assert np.array_equal(one.per_trajectory, three.per_trajectory)


def test_a_custom_metric_and_one_condition_per_trajectory() -> None:
    requested = []

    def condition(trajectories: range) -> Tensor:
        requested.append(trajectories)
        return torch.tensor([10.0 * k for k in trajectories])

    def velocity(y: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        return per_sample(cond + 1, y) * per_sample(t, y).expand_as(y)

    found = select_timesteps(
        velocity,
        SHAPE,
        2,
        4,
        3,
        lambda a, b: (a - b).abs().amax((1, 2, 3)),
        batch=2,
        condition=condition,
    )
    assert requested == [range(2), range(2, 3)]
    # v = c t on a grid of quarters, c = 1, 11, 21: a straight step from t = 1 to 1/2 has an error
    # of c/16.
    assert found.costs[0, 2] == pytest.approx(11 / 16, rel=1e-5)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_trajectories() -> None:
    def live() -> int:
        return sum(
            x.numel()
            for x in gc.get_objects()
            if type(x) is Tensor and x.shape[-3:] == SHAPE
        )

    def peaks(trajectories: int) -> int:
        seen = []

        def velocity(y: Tensor, t: Tensor, cond: Any) -> Tensor:
            seen.append(live())
            return -y

        select_timesteps(velocity, SHAPE, 2, 5, trajectories)
        return max(seen[-5:])

    assert peaks(2) == peaks(9)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_teacher_with_nan_or_infinity_is_refused(bad: float) -> None:
    with pytest.raises(DataError, match="the teacher's trajectory is not finite"):
        select_timesteps(lambda y, t, c: torch.full_like(y, bad), SHAPE, 2, 5, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"metric": "l3"}, "metric 'l3'; expected one of squared_l2, pseudo_huber, l1"),
        ({"intervals": 0}, "0 intervals of 5 candidates"),
        ({"intervals": 6}, "6 intervals of 5 candidates on 2 trajectories"),
        ({"trajectories": 0}, "on 0 trajectories"),
        ({"batch": 0}, "0 at a time"),
    ],
)
def test_invalid_numbers_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        select_timesteps(
            gaussian_velocity,
            SHAPE,
            **{"candidates": 5, "trajectories": 2} | options,
        )
