"""Distillation: states, times, targets and teacher evaluations of each strategy."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Golden
from flows import MEAN, STD, gaussian_flow, gaussian_velocity
from safetensors.torch import load_file
from torch import Tensor

from lidar_synth.errors import ConfigError
from lidar_synth.generate.flow.distill import (
    STRATEGIES,
    adaptive_piecewise,
    every_piece,
    interval_of,
)
from lidar_synth.generate.flow.path import interpolate, per_sample
from lidar_synth.generate.flow.solvers import solve, uniform_grid
from lidar_synth.generate.models import build_network
from lidar_synth.lab.train.precision import convert_products
from lidar_synth.noise import gaussian, uniform

NETWORKS: dict[str, dict[str, Any]] = {
    "hdit": {
        "resolution": (8, 64),
        "width": 16,
        "depths": [1, 1],
        "heads": [2, 2],
        "angles": torch.linspace(-1, 1, 1024).view(2, 8, 64),
    },
    "unet": {"resolution": (8, 64), "width": 32, "multipliers": [1, 2]},
    "diffusion_unet": {"resolution": (8, 64), "width": 32, "multipliers": [1, 2]},
    "efficient_unet": {
        "resolution": (8, 64),
        "width": 16,
        "multipliers": [1, 2],
        "blocks": [1, 1],
        "angles": torch.linspace(-1, 1, 1024).view(2, 8, 64),
    },
}
"""Small networks by architecture."""

COUNT = 64
DATA = MEAN + STD * gaussian(0, range(COUNT), (2, 3), dtype=torch.float64)
NOISE = gaussian(1, range(COUNT), (2, 3), dtype=torch.float64)
U = uniform(2, range(COUNT)).double()
ADAPTIVE = (1.0, 0.86, 0.58, 0.22, 0.0)
PIECEWISE = ("adaptive_piecewise", "uniform_piecewise", "piecewise_reflow")
AT_STARTS = ("adaptive_piecewise", "uniform_piecewise", "timestep_distillation")


def grid_of(name: str) -> tuple[float, ...]:
    return (
        uniform_grid(4)
        if name in ("uniform_piecewise", "timestep_distillation")
        else ADAPTIVE
    )


def bounds(t: Tensor, grid: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Start and end of the interval that contains t, by linear search."""
    which = [
        next(i for i in range(len(grid) - 1) if grid[i + 1] < x <= grid[i] + 1e-12)
        for x in t.tolist()
    ]
    return torch.tensor([grid[i] for i in which]).double(), torch.tensor(
        [grid[i + 1] for i in which]
    ).double()


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_straight_teacher_is_its_own_student(name: str) -> None:
    """The targets of a teacher with straight trajectories are its own velocities."""
    direction = gaussian(3, range(COUNT), (2, 3), dtype=torch.float64)
    example = STRATEGIES[name](
        lambda y, t, c: direction, DATA, NOISE, U, grid_of(name), 3, None
    )
    assert torch.allclose(example.velocity, direction)


@pytest.mark.parametrize("name", STRATEGIES)
def test_targets_converge_to_those_of_an_exact_gaussian_teacher(name: str) -> None:
    """The targets converge at Euler's first order in the number of steps."""
    grid = grid_of(name)
    errors = []
    for steps in (50, 100, 200):
        example = STRATEGIES[name](gaussian_velocity, DATA, NOISE, U, grid, steps, None)
        start, end = (
            bounds(example.t, grid)
            if name in PIECEWISE
            else (torch.ones(COUNT), torch.zeros(COUNT))
        )
        y = interpolate(DATA, NOISE, start)
        exact = (gaussian_flow(y, start, end) - y) / per_sample(end - start, y)
        errors.append((example.velocity - exact).norm().item() / exact.norm().item())
        assert torch.allclose(
            example.y, y + per_sample(example.t - start, y) * example.velocity
        )
    assert errors[2] < 0.02
    assert [math.log2(a / b) for a, b in pairwise(errors)] == pytest.approx(
        [1, 1], abs=0.1
    )


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_states_and_times_of_training_of_each_strategy(name: str) -> None:
    grid = grid_of(name)
    u = uniform(4, range(8000))
    y = torch.zeros(8000, 1)
    t = STRATEGIES[name](lambda y, t, c: y, y, y, u, grid, 1, None).t
    assert t.shape == (8000,) and t.dtype == torch.float32
    if name in AT_STARTS:
        values, counts = t.unique(return_counts=True)
        assert values.tolist() == pytest.approx(grid[-2::-1])
        assert (counts / 8000 - 1 / 4).abs().max() < 0.03
    else:
        assert torch.equal(t, u)


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_times_and_the_number_of_teacher_evaluations(name: str) -> None:
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    calls: list[Tensor] = []

    def teacher(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        assert cond == "street" and t.shape == (COUNT,)
        calls.append(t)
        return weight * gaussian_velocity(y, t)

    example = STRATEGIES[name](teacher, DATA, NOISE, U, grid_of(name), 5, "street")
    # Whole trajectories are as fine as those of the four intervals.
    evaluations = 5 if name in PIECEWISE else 4 * 5
    assert len(calls) == evaluations
    assert example.teacher_evaluations == evaluations * COUNT
    assert not example.velocity.requires_grad and not example.y.requires_grad
    first = (
        bounds(example.t, grid_of(name))[0]
        if name in PIECEWISE
        else torch.ones(COUNT, dtype=torch.float64)
    )
    assert torch.allclose(calls[0], first)
    assert all((b < a).all() for a, b in pairwise(calls))


def test_four_steps_of_the_student_reach_the_end_of_the_teacher() -> None:
    """A student that has learned its targets exactly retraces the teacher's many steps in four: its
    targets at each start are an affine function of y here, found by least squares from Algorithm
    1's examples."""
    count = 4000
    steps = 25
    data = MEAN + STD * gaussian(5, range(count), (1,), dtype=torch.float64)
    noise = gaussian(6, range(count), (1,), dtype=torch.float64)
    u = uniform(7, range(count)).double()
    example = adaptive_piecewise(gaussian_velocity, data, noise, u, ADAPTIVE, steps)
    student = {}
    for t in ADAPTIVE[:-1]:
        here = example.t == t
        assert here.any()
        a = torch.cat([example.y[here], torch.ones_like(example.y[here])], 1)
        student[t] = torch.linalg.lstsq(a, example.velocity[here]).solution

    def velocity(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        slope, offset = student[t[0].item()]
        return slope * y + offset

    start = gaussian(8, range(500), (1,), dtype=torch.float64)
    fine = np.concatenate(
        [np.linspace(a, b, steps, endpoint=False) for a, b in pairwise(ADAPTIVE)]
    )
    teacher = solve(gaussian_velocity, start, [*fine.tolist(), 0.0])
    exact = gaussian_flow(start, torch.ones(500), torch.zeros(500))
    assert torch.allclose(solve(velocity, start, ADAPTIVE), teacher, atol=1e-9)
    assert (teacher - exact).norm() < 0.2 * (
        solve(gaussian_velocity, start, ADAPTIVE) - exact
    ).norm()


def test_every_piece_of_several_grids_leads_where_the_teacher_does() -> None:
    grids = (ADAPTIVE, (1.0, 0.6, 0.0), (1.0, 0.0))
    calls: list[Tensor] = []

    def teacher(y: Tensor, t: Tensor, cond: Any) -> Tensor:
        assert torch.equal(cond, U)
        calls.append(t)
        return gaussian_velocity(y, t)

    example = every_piece(teacher, DATA, NOISE, grids, 100, U)
    # One trajectory serves the three intervals from noise; 400 steps in [1, 0].
    assert len(calls) == 400 + round(400 * (0.86 - 0.0)) + round(400 * 0.6)
    assert example.teacher_evaluations == len(calls) * COUNT
    pieces = [piece for grid in grids for piece in pairwise(grid)]
    assert example.end is not None and torch.equal(example.cond, U.repeat(7))
    for (a, b), y, t, end, velocity in zip(
        pieces,
        *(
            part.split(COUNT)
            for part in (example.y, example.t, example.end, example.velocity)
        ),
        strict=True,
    ):
        assert (t == a).all() and (end == b).all()
        assert torch.allclose(y, interpolate(DATA, NOISE, t))
        exact = (gaussian_flow(y, t, end) - y) / (b - a)
        assert (velocity - exact).norm() < 0.02 * exact.norm()
    with pytest.raises(ConfigError, match="steps of the teacher 0"):
        every_piece(teacher, DATA, NOISE, grids, 0, U)


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("name", ["uniform", "u_shaped", "logit_normal"])
def test_times_are_rounded_as_in_r2flow(golden: Golden, name: str, k: int) -> None:
    """R2Flow rounds its time (0 = noise) down to floor(t k) / k, where a sampler of k steps
    evaluates."""
    vectors = load_file(golden / "r2flow_losses.safetensors")
    theirs = vectors[f"timesteps/{name}/first_64"]
    grid = uniform_grid(k)
    snapped = 1 - torch.tensor(grid)[interval_of(1 - theirs, grid)]
    assert torch.allclose(snapped, torch.floor(theirs * k) / k, atol=1e-6)
    assert set(snapped.tolist()) <= set(
        vectors[f"timesteps/{name}_k{k}/values"].tolist()
    )


def test_intervals_are_closed_at_their_noisier_end() -> None:
    t = torch.tensor([1.0, 0.87, 0.86, 0.859, 0.58, 0.22, 0.2199, 1e-7, 0.0])
    assert interval_of(t, ADAPTIVE).tolist() == [0, 0, 1, 1, 2, 3, 3, 3, 3]
    assert interval_of(torch.tensor([0.3, 1.0]), (1.0, 0.0)).tolist() == [0, 0]


@pytest.mark.parametrize("name", ["uniform_piecewise", "timestep_distillation"])
def test_a_grid_that_is_not_uniform_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"time grid \(1.0, 0.86.* which is uniform"):
        STRATEGIES[name](gaussian_velocity, DATA, NOISE, U, ADAPTIVE, 2, None)


@pytest.mark.parametrize("name", sorted(set(STRATEGIES) - {"reflow"}))
@pytest.mark.parametrize(
    "grid", [(0.0, 0.5, 1.0), (1.0, 0.5, 0.1), (0.9, 0.45, 0.0), (1.0,)]
)
def test_invalid_student_grids_are_refused(name: str, grid: tuple[float, ...]) -> None:
    expected = "at least two descending times|one from 1 down to 0|which is uniform"
    with pytest.raises(
        ConfigError, match=rf"time grid [\[(].*; expected .*({expected})"
    ):
        STRATEGIES[name](gaussian_velocity, DATA, NOISE, U, grid, 2, None)


@pytest.mark.parametrize("name", STRATEGIES)
def test_zero_teacher_steps_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="steps of the teacher 0; expected a whole"):
        STRATEGIES[name](gaussian_velocity, DATA, NOISE, U, grid_of(name), 0, None)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_teacher_in_bfloat16_is_that_of_autocast_to_the_bit(name: str) -> None:
    torch.manual_seed(0)
    net = build_network(name, NETWORKS[name]).eval().requires_grad_(False)
    for weight in net.parameters():
        if not weight.any():
            torch.nn.init.normal_(weight, std=0.1)
    y = torch.randn(2, net.channels, 8, 64)
    with torch.autocast("cpu", torch.bfloat16):
        before = net(y, torch.tensor([0.3, 0.6]))
        convert_products(net)
        after = net(y, torch.tensor([0.3, 0.6]))
    held = [w.dtype for w in net.parameters() if w.ndim > 1]
    assert held.count(torch.bfloat16) > 0.7 * len(held)
    assert torch.equal(before, after)
