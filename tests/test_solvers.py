"""Solvers on flows with known solutions."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Golden
from flows import gaussian_flow, gaussian_velocity
from safetensors.torch import load_file
from torch import Tensor

from lidar_synth.errors import ConfigError
from lidar_synth.generate.flow.path import per_sample
from lidar_synth.generate.flow.solvers import (
    SOLVERS,
    mean_velocity,
    solve,
    trajectory,
    uniform_grid,
)
from lidar_synth.noise import gaussian

NOISE = gaussian(0, range(4), (2, 5), dtype=torch.float64)
DATA = gaussian_flow(NOISE, torch.ones(4), torch.zeros(4))


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_converge_at_their_order(name: str, uneven: bool) -> None:
    steps = np.array([64, 128, 256, 512])
    errors = []
    for count in steps:
        grid = torch.tensor(uniform_grid(int(count)), dtype=torch.float64)
        grid = grid.square() if uneven else grid
        errors.append(
            (solve(gaussian_velocity, NOISE, grid, name) - DATA).norm().item()
        )
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(SOLVERS[name].order, abs=0.15)


@pytest.mark.parametrize("name", SOLVERS)
def test_one_step_solves_a_straight_flow(name: str) -> None:
    direction = gaussian(1, range(4), (2, 5), dtype=torch.float64)
    straight = solve(lambda y, t, c: direction, NOISE, (1.0, 0.0), name)
    assert torch.allclose(straight, NOISE - direction)


def test_a_network_is_told_where_its_step_ends() -> None:
    class Exact:
        """The mean velocity of the Gaussian flow, with which one step is exact."""

        ends = True

        def __call__(self, y: Tensor, t: Tensor, cond: Any, end: Tensor) -> Tensor:
            return (gaussian_flow(y, t, end) - y) / per_sample(end - t, y)

    for grid in ((1.0, 0.0), (1.0, 0.7, 0.0), (1.0, 0.86, 0.58, 0.22, 0.0)):
        assert torch.allclose(solve(mean_velocity(Exact(), grid), NOISE, grid), DATA)
    assert mean_velocity(gaussian_velocity, (1.0, 0.0)) is gaussian_velocity
    with pytest.raises(ConfigError, match="time grid"):
        mean_velocity(Exact(), (0.0, 1.0))


@pytest.mark.parametrize("name", SOLVERS)
def test_the_number_and_arguments_of_evaluations_per_step(name: str) -> None:
    seen: list[tuple[Tensor, Any]] = []

    def velocity(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        seen.append((t, cond))
        return -y

    grid = (0.9, 0.5, 0.45, 0.2)
    solve(velocity, NOISE.float(), grid, name, cond="street")
    assert len(seen) == 3 * SOLVERS[name].evaluations
    for t, cond in seen:
        assert t.shape == (4,) and t.dtype == torch.float32 and cond == "street"
        assert min(abs(t[0].item() - g) for g in grid) < 1e-7


@pytest.mark.parametrize("name", SOLVERS)
def test_trajectory_streams_states_and_the_velocities_between_them(name: str) -> None:
    grid = (1.0, 0.7, 0.6, 0.0)
    states = list(trajectory(gaussian_velocity, NOISE, grid, name))
    assert [s.t[0].item() for s in states] == pytest.approx(grid)
    assert torch.equal(states[0].y, NOISE)
    assert states[-1].velocity is None
    for here, there in pairwise(states):
        assert torch.allclose(
            there.y, here.y + (there.t - here.t)[:, None, None] * here.velocity
        )
    assert torch.equal(states[-1].y, solve(gaussian_velocity, NOISE, grid, name))
    lazy = trajectory(
        lambda y, t, c: pytest.fail("evaluated before it was asked for"),
        NOISE,
        grid,
        name,
    )
    assert iter(lazy) is lazy


@pytest.mark.parametrize("name", SOLVERS)
def test_each_sample_can_have_its_own_time_grid(name: str) -> None:
    grids = torch.tensor(
        [
            [1.0, 0.8, 0.6, 0.5],
            [0.9, 0.5, 0.2, 0.0],
            [0.4, 0.3, 0.2, 0.1],
            [1.0, 0.9, 0.1, 0.0],
        ]
    ).double()
    together = solve(gaussian_velocity, NOISE, grids.T, name)
    for i, grid in enumerate(grids):
        assert torch.allclose(
            together[i : i + 1], solve(gaussian_velocity, NOISE[i : i + 1], grid, name)
        )


def test_the_state_keeps_its_dtype() -> None:
    for dtype in (torch.float64, torch.float32):
        low = solve(lambda y, t, c: -y.bfloat16(), NOISE.to(dtype), uniform_grid(2))
        assert low.dtype == dtype


@pytest.mark.parametrize(
    "model", ["r2flow_hdit_tiny_learnable", "r2flow_hdit_tiny_fourier"]
)
def test_euler_on_uneven_grids_equals_that_of_r2flow(
    golden: Golden, model: str
) -> None:
    """R2Flow's states follow from its velocities in our convention of time and sign; no network is
    involved."""
    vectors = {
        k.removeprefix(f"{model}/"): v
        for k, v in load_file(golden / "r2flow_sampling.safetensors").items()
    }
    answers = iter(vectors["velocities"])
    times = []

    def velocity(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        times.append(1 - t[0].item())
        return -next(answers)

    states = torch.stack(
        [
            s.y
            for s in trajectory(
                velocity, vectors["input.x0"], 1 - vectors["input.grid"]
            )
        ]
    )
    assert times == pytest.approx(vectors["input.grid"][:-1].tolist(), abs=1e-7)
    assert (states - vectors["states"]).norm() / vectors["states"].norm() < 1e-6
    assert (states[-1] - vectors["output"]).norm() / vectors["output"].norm() < 1e-6


@pytest.mark.parametrize(
    "grid",
    [
        (1.0,),
        (0.0, 1.0),
        (1.0, 0.5, 0.5, 0.0),
        (1.1, 0.0),
        (1.0, -0.1),
        (1.0, float("nan"), 0.0),
    ],
)
def test_grids_that_do_not_descend_within_0_and_1_are_refused(
    grid: tuple[float, ...],
) -> None:
    with pytest.raises(
        ConfigError, match=r"time grid .*; expected at least two descending times"
    ):
        solve(gaussian_velocity, NOISE, grid)


def test_uniform_grids_are_evenly_spaced() -> None:
    assert uniform_grid(4) == (1.0, 0.75, 0.5, 0.25, 0.0)
    # The nearest float, which headers and configurations display as 0.3.
    assert uniform_grid(100)[70] == 0.3
    assert uniform_grid(2, 0.58, 0.22) == pytest.approx((0.58, 0.4, 0.22))


def test_an_unknown_solver_and_zero_steps_are_refused() -> None:
    with pytest.raises(
        ConfigError, match="solver 'rk4'; expected one of 'euler', 'heun'"
    ):
        solve(gaussian_velocity, NOISE, (1.0, 0.0), "rk4")
    with pytest.raises(
        ConfigError, match="steps 0; expected a whole number, 1 or more"
    ):
        uniform_grid(0)
