"""The path, the training metrics and the distributions of t."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from conftest import Golden
from flows import MEAN, STD, gaussian_velocity
from safetensors.torch import load_file
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.generate.flow.guidance import autoguide
from lidar_synth.generate.flow.path import (
    METRICS,
    TIMESTEPS,
    flow_matching,
    interpolate,
    logit_normal,
    per_sample,
    pseudo_huber,
    u_shaped,
    velocity_loss,
)
from lidar_synth.generate.flow.solvers import solve, uniform_grid
from lidar_synth.lab.train.moments import match_moments
from lidar_synth.noise import gaussian, uniform


def test_the_path_runs_from_data_to_noise_at_its_velocity() -> None:
    y0 = gaussian(0, range(4), (2, 3, 5), dtype=torch.float64)
    y1 = gaussian(1, range(4), (2, 3, 5))
    assert torch.equal(interpolate(y0, y1, torch.zeros(4)), y0)
    assert torch.equal(interpolate(y0, y1, torch.ones(4)), y1)
    t = torch.tensor([0.0, 0.25, 0.5, 0.9], dtype=torch.float64)
    example = flow_matching(y0, y1, t)
    later = interpolate(y0, y1, t + 0.1)
    assert torch.allclose(later, example.y + 0.1 * example.velocity)
    assert torch.equal(example.t, t) and example.teacher_evaluations == 0


def test_the_flow_matching_loss_is_minimal_at_the_true_velocity() -> None:
    """For Gaussian data, the optimal velocity E[y1 - y0 | y_t] is known, and its residual is
    independent of y_t."""
    count = 20000
    y0 = 0.5 + 0.1 * gaussian(0, range(count), (1,), dtype=torch.float64)
    example = flow_matching(
        y0,
        gaussian(1, range(count), (1,), dtype=torch.float64),
        uniform(2, range(count)),
    )
    left = (example.velocity - gaussian_velocity(example.y, example.t)).flatten()
    for feature in (
        torch.ones(count),
        example.y.flatten(),
        example.t,
        example.y.flatten() * example.t,
    ):
        assert abs((left * feature).mean()) < 4 * (left * feature).std() / math.sqrt(
            count
        )
    best = velocity_loss(gaussian_velocity, example, METRICS["squared_l2"])
    assert best.ndim == 0 and best == pytest.approx(left.square().mean().item())
    for other in (1.05, 0.95):
        scaled = lambda y, t, c, other=other: other * gaussian_velocity(y, t)  # noqa: E731
        assert velocity_loss(scaled, example, METRICS["squared_l2"]) > best


def test_the_loss_passes_the_condition_on() -> None:
    example = replace(
        flow_matching(torch.zeros(2, 3), torch.ones(2, 3), torch.tensor([0.2, 0.4])),
        cond=3.0,
    )
    loss = velocity_loss(lambda y, t, c: c * torch.ones_like(y), example, METRICS["l1"])
    assert loss.item() == 2.0


def test_autoguidance_reduces_the_error_that_both_models_share() -> None:
    """Data of standard deviation 0.1, a model fitted to 0.15, and a weaker one fitted to 0.2."""
    model, weaker = (
        partial(gaussian_velocity, spread=spread) for spread in (1.5 * STD, 2 * STD)
    )
    noise = gaussian(0, range(4000), (1,), dtype=torch.float64)
    grid = uniform_grid(50)

    def spread(scale: float) -> float:
        y = solve(autoguide(model, weaker, scale), noise, grid)
        assert float(y.mean()) == pytest.approx(MEAN, abs=0.01)
        return float(y.std())

    assert autoguide(model, weaker, 1.0) is model
    assert spread(0.0) == pytest.approx(2 * STD, rel=0.05)
    assert spread(1.0) == pytest.approx(1.5 * STD, rel=0.05)
    assert spread(2.0) == pytest.approx(STD, rel=0.15)


def test_autoguidance_passes_the_condition_on() -> None:
    y = torch.randn(3, 2)
    t = torch.rand(3)
    cond = torch.randn(3, 2)
    out = autoguide(lambda y, t, c: y + c, lambda y, t, c: y - c, 3.0)(y, t, cond)
    assert torch.allclose(out, y + 5 * cond, atol=1e-5)
    # Dtype under autocast.
    halves = (
        lambda y, t, c: (y + c).bfloat16(),
        lambda y, t, c: (y - c).bfloat16(),
    )
    assert torch.allclose(autoguide(*halves, 3.0)(y, t, cond), y + 5 * cond, atol=0.2)


def test_autoguidance_is_limited_to_its_time_interval() -> None:
    y = torch.ones(5, 2)
    t = torch.tensor([0.05, 0.1, 0.5, 0.9, 0.95])
    out = autoguide(lambda y, t, c: 3 * y, lambda y, t, c: y, 2.0, within=(0.1, 0.9))(
        y, t, None
    )
    assert out[:, 0].tolist() == [3, 5, 5, 5, 3] and torch.equal(out[:, 0], out[:, 1])


@pytest.mark.parametrize("name", METRICS)
def test_metrics_are_distances_per_sample(name: str) -> None:
    a = gaussian(0, range(3), (2, 4, 5))
    b = gaussian(1, range(3), (2, 4, 5))
    m = METRICS[name](a, b)
    assert m.shape == (3,) and (m > 0).all()
    assert torch.equal(m, METRICS[name](b, a))
    assert METRICS[name](a, a).tolist() == [0, 0, 0]
    assert torch.equal(m[1:], METRICS[name](a[1:], b[1:]))
    half = METRICS[name](a.bfloat16(), b.bfloat16())
    assert half.dtype == torch.float32 and torch.allclose(half, m, rtol=0.02)
    with pytest.raises(DataError, match=r"shapes \(3, 2, 4, 5\) and \(3, 40\)"):
        METRICS[name](a, b.flatten(1))


def test_metrics_equal_values_computed_by_hand() -> None:
    a = torch.tensor([[3.0, 0.0, 0.0, 0.0]])
    b = torch.tensor([[0.0, -4.0, 0.0, 0.0]])
    assert METRICS["squared_l2"](a, b).item() == 25 / 4
    assert METRICS["l1"](a, b).item() == 7 / 4
    # c = 2 sqrt(4) = 4: sqrt(9 + 16) - 4 and sqrt(16 + 16) - 4
    assert pseudo_huber(a, b, 2.0).item() == pytest.approx((1 + math.sqrt(32) - 4) / 4)


@pytest.mark.parametrize("case", range(3))
def test_pseudo_huber_equals_that_of_r2flow(golden: Golden, case: int) -> None:
    stored = load_file(golden / "r2flow_losses.safetensors")
    vectors = {k.split("/")[1]: v for k, v in stored.items() if f"_{case}/" in k}
    v = vectors["v"].requires_grad_()
    loss = pseudo_huber(v, vectors["u"]).mean()
    assert loss.item() == pytest.approx(vectors["loss"].item(), rel=1e-6)
    loss.backward()
    assert torch.allclose(v.grad, vectors["grad_v"], rtol=1e-5, atol=1e-12)
    # In float32, sqrt(e^2 + c^2) - c loses small errors to rounding, by an amount that depends on
    # the machine.
    c = 0.03 * math.sqrt(v[0].numel())
    other = pseudo_huber(v, vectors["u"], 0.03).mean()
    assert other.item() == pytest.approx(
        vectors["loss_coef_0.03"].item(), rel=1e-6, abs=2**-24 * c
    )


@pytest.mark.parametrize("name", ["uniform", "u_shaped", "logit_normal"])
def test_distributions_of_t_equal_those_of_r2flow(golden: Golden, name: str) -> None:
    """R2Flow's time runs the other way; all three distributions are symmetric and are compared both
    ways."""
    vectors = load_file(golden / "r2flow_losses.safetensors")
    t = TIMESTEPS[name](uniform(0, range(10000))).double()
    for ours in (t, 1 - t):
        quantiles = vectors[f"timesteps/{name}/quantiles"]
        p = vectors["timesteps/probabilities"]
        share_below = (ours[:, None] <= quantiles).double().mean(0)
        assert (share_below - p).abs().max() < 0.03
        assert ours.mean() == pytest.approx(
            vectors[f"timesteps/{name}/moments"][0].item(), abs=0.01
        )
        assert ours.std() == pytest.approx(
            vectors[f"timesteps/{name}/moments"][1].item(), abs=0.01
        )


@pytest.mark.parametrize("name", TIMESTEPS)
def test_distributions_of_t_are_quantile_functions_within_0_and_1(name: str) -> None:
    u = torch.tensor([2.0**-24, 0.1, 0.5, 0.7, 1 - 2.0**-24])
    t = TIMESTEPS[name](u)
    assert (t.diff() > 0).all() and t[0] >= 0 and t[-1] <= 1
    odds = 2 if name.endswith("shifted") else 1
    t = t / (odds - (odds - 1) * t)
    assert t[2].item() == pytest.approx(0.5)
    other = TIMESTEPS[name](1 - u)
    assert (other / (odds - (odds - 1) * other) + t - 1).abs().max() < 1e-5


@pytest.mark.parametrize(
    ("quantile", "density"),
    [
        (
            u_shaped,
            lambda t: (
                4
                * (torch.exp(4 * t) + torch.exp(4 * (1 - t)))
                / (2 * (math.exp(4) - 1))
            ),
        ),
        (
            logit_normal,
            lambda t: (
                torch.exp(-(torch.logit(t) ** 2) / 2)
                / (math.sqrt(2 * math.pi) * t * (1 - t))
            ),
        ),
    ],
)
def test_quantile_functions_have_the_documented_densities(
    quantile: Callable[[Tensor], Tensor], density: Callable[[Tensor], Tensor]
) -> None:
    u = torch.linspace(0.05, 0.95, 19, dtype=torch.float64, requires_grad=True)
    t = quantile(u)
    (slope,) = torch.autograd.grad(t.sum(), u)
    assert torch.allclose(1 / slope, density(t.detach()))


def test_per_sample_keeps_the_dtype_of_the_state() -> None:
    y = torch.zeros(3, 2, 4, 5, dtype=torch.float64)
    assert per_sample(torch.arange(3), y).shape == (3, 1, 1, 1)
    assert per_sample(torch.arange(3), y).dtype == torch.float64


def test_matched_states_have_the_means_of_the_others_and_vary_a_little_more() -> None:
    own, wanted = gaussian(0, range(40), (2, 3, 4)).chunk(2)
    wanted = wanted * torch.tensor([1.0, 2.0, 3.0])[:, None] + torch.tensor(5.0)
    scale, shift = match_moments(own, wanted)
    assert scale.shape == shift.shape == (2, 3)
    found = own * scale[..., None] + shift[..., None]
    assert torch.allclose(found.mean((0, 3)), wanted.mean((0, 3)), atol=1e-5)
    ratio = wanted.std((0, 3)) / own.std((0, 3))
    assert torch.allclose(found.std((0, 3)), ratio**1.5 * own.std((0, 3)), atol=1e-5)
