"""The U-Net: inputs, circular columns, the position table, and a diffusion network as a
velocity."""

from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.flow.path import Velocity
from lidar_synth.generate.flow.solvers import solve, uniform_grid
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.convolution import WrapConv, fold, unfold
from lidar_synth.generate.models.efficient_unet import EfficientUNet
from lidar_synth.generate.models.lidm.diffusion import (
    DiffusionUNet,
    schedule_times,
    step_of,
)
from lidar_synth.generate.models.lidm.unet import UNet

SMALL: dict[str, Any] = {
    "resolution": (8, 32),
    "channels": 3,
    "width": 16,
    "multipliers": (1, 2),
    "blocks": 1,
    "attention": (1,),
    "head_channels": 8,
    "groups": 4,
}


pytestmark = pytest.mark.usefixtures("one_thread")


def network(kind: str = "unet", **arguments: Any) -> nn.Module:
    """A network with random weights (a fresh one returns zero)."""
    torch.manual_seed(0)
    net = build_network(kind, {**SMALL, **arguments})
    for parameter in net.parameters():
        nn.init.normal_(parameter, std=0.1)
    return net.eval()


def state(count: int = 2, shape: tuple[int, ...] = (3, 8, 32)) -> Tensor:
    return torch.randn(count, *shape, generator=torch.Generator().manual_seed(1))


T = torch.tensor([0.3, 0.8])


def test_a_fresh_network_returns_zero() -> None:
    assert not build_network("unet", SMALL)(state(), T).any()


@torch.no_grad()
@pytest.mark.parametrize("kind", ["unet", "diffusion_unet", "efficient_unet"])
def test_another_default_dtype_changes_nothing(kind: str) -> None:
    y = state(shape=(3, 16, 64))
    if kind == "efficient_unet":
        net: nn.Module = EfficientUNet(
            (16, 64), 3, width=32, angles=torch.zeros(2, 16, 64)
        ).eval()
        for parameter in net.parameters():
            nn.init.normal_(parameter, std=0.1)
    else:
        net = network(kind, resolution=(16, 64))
    expected = net(y, T)
    torch.set_default_dtype(torch.bfloat16)
    try:
        assert torch.equal(net(y, T), expected)
    finally:
        torch.set_default_dtype(torch.float32)


@torch.no_grad()
@pytest.mark.parametrize(
    "arguments", [{}, {"patch": (2, 2)}, {"multipliers": (1, 2, 3), "blocks": 2}]
)
def test_samples_of_a_batch_are_independent(arguments: dict[str, Any]) -> None:
    net = network(**arguments)
    together = net(state(), T)
    assert together.shape == (2, 3, 8, 32)
    for i in range(2):
        assert torch.allclose(
            net(state()[i : i + 1], T[i]), together[i : i + 1], atol=1e-5
        )
    assert not torch.allclose(net(state(), T + 0.1), together, atol=1e-3)


@torch.no_grad()
def test_columns_wrap_around_and_rows_do_not() -> None:
    net = network(position=False)
    y = state()
    out = net(y, T)
    # By a multiple of the total stride.
    assert torch.allclose(net(y.roll(2, -1), T), out.roll(2, -1), atol=1e-4)
    assert not torch.allclose(net(y.roll(2, -2), T), out.roll(2, -2), atol=1e-2)


@torch.no_grad()
def test_the_position_table_distinguishes_columns() -> None:
    net = network(position=True)
    y = state()
    assert not torch.allclose(net(y.roll(2, -1), T), net(y, T).roll(2, -1), atol=1e-2)
    assert sum(p.numel() for p in net.parameters()) - sum(
        p.numel() for p in network(position=False).parameters()
    ) == (16 * 8 * 32)


@pytest.mark.parametrize(
    "arguments",
    [{}, {"context_channels": 5}, {"condition_channels": 2}, {"patch": (2, 4)}],
)
@pytest.mark.parametrize("checkpointing", [False, True])
def test_every_weight_gets_a_gradient(
    arguments: dict[str, Any], checkpointing: bool
) -> None:
    net = network(**arguments)
    assert isinstance(net, UNet)
    net.gradient_checkpointing = checkpointing
    cond = {
        "context_channels": torch.randn(2, 4, 5),
        "condition_channels": torch.randn(2, 2, 8, 32),
    }
    net(state(), T, cond.get(next(iter(arguments), ""))).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        # A norm after it can cancel a bias.
        assert parameter.grad.any() or "conv1.bias" in name, name


@torch.no_grad()
def test_conditions_change_the_velocity() -> None:
    beside = network(condition_channels=2)
    y = state()
    assert not torch.allclose(
        beside(y, T, torch.zeros(2, 2, 8, 32)),
        beside(y, T, torch.ones(2, 2, 8, 32)),
        atol=1e-3,
    )
    context = network(context_channels=5)
    tokens = torch.randn(2, 4, 5)
    out = context(y, T, tokens)
    assert not torch.allclose(out, context(y, T, tokens * 2), atol=1e-3)
    # The order of tokens does not matter.
    assert torch.allclose(out, context(y, T, tokens.flip(1)), atol=1e-5)


@torch.no_grad()
def test_precision_and_memory_format_change_only_rounding() -> None:
    net = network()
    y = state()
    out = net(y, T)
    assert torch.allclose(
        net.to(memory_format=torch.channels_last)(y, T), out, atol=1e-5
    )  # type: ignore[call-overload]
    rough = net.bfloat16()(y, T)
    assert rough.dtype == torch.float32
    assert 0 < (rough - out).abs().mean() < 0.05 * out.abs().mean()


@pytest.mark.parametrize(
    ("arguments", "cond", "message"),
    [
        ({}, torch.zeros(2, 2, 8, 32), "none: the network takes no condition"),
        ({"condition_channels": 2}, None, r"no condition; expected \(2, 2, 8, 32\)"),
        (
            {"condition_channels": 2},
            torch.zeros(2, 2, 4, 32),
            r"a condition of shape \(2, 2, 4, 32\)",
        ),
        (
            {"context_channels": 5},
            torch.zeros(2, 4, 6),
            r"shape \(2, 4, 6\); expected \(2, tokens, 5\)",
        ),
        ({"context_channels": 5}, None, "no condition"),
    ],
)
def test_conditions_of_another_shape_are_refused(
    arguments: dict[str, Any], cond: Tensor | None, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        network(**arguments)(state(), T, cond)


def test_states_and_times_of_another_shape_are_refused() -> None:
    with pytest.raises(
        DataError, match=r"a state of shape \(2, 3, 8, 16\); expected \(B, 3, 8, 32\)"
    ):
        network()(state(shape=(3, 8, 16)), T)
    with pytest.raises(DataError, match=r"times of shape \(3,\) for 2 states"):
        network()(state(), torch.zeros(3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"resolution": (8, 33)},
            r"of \(8, 33\) rows and columns; expected multiples of \(2, 2\)",
        ),
        ({"patch": (3, 1)}, r"a state of \(8, 32\)"),
        ({"patch": (8, 1)}, r"patches of \(8, 1\)"),
        ({"head_channels": 24}, "multiples of head_channels"),
        ({"width": 15}, "even"),
        ({"colour": 1}, "colour"),
    ],
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_network("unet", {**SMALL, **arguments})


@settings(max_examples=20)
@given(
    st.integers(1, 3),
    st.integers(1, 4),
    st.integers(1, 3),
    st.integers(1, 3),
    st.integers(1, 3),
)
def test_unfold_is_the_inverse_of_fold(
    p: int, q: int, rows: int, columns: int, channels: int
) -> None:
    x = torch.randn(2, channels, p * rows, q * columns)
    folded = fold(x, (p, q))
    assert folded.shape == (2, channels * p * q, rows, columns)
    assert torch.equal(unfold(folded, (p, q)), x)
    assert torch.equal(folded[0, :, 0, 0], x[0, :, :p, :q].flatten())


@pytest.mark.parametrize(
    ("kernel", "stride", "pad", "dilation"),
    [
        ((3, 3), (1, 1), None, (1, 1)),
        ((1, 4), (1, 1), None, (1, 1)),
        ((3, 3), (2, 2), (0, 1, 0, 1), (1, 1)),
        ((3, 3), (1, 1), None, (1, 3)),
    ],
)
def test_a_circular_convolution_equals_one_on_a_padded_image(
    kernel: Any, stride: Any, pad: Any, dilation: Any
) -> None:
    conv = WrapConv(2, 3, kernel, stride, pad, dilation=dilation)
    x = torch.randn(1, 2, 4, 8)
    rows, columns = (d * (k - 1) for k, d in zip(kernel, dilation, strict=True))
    left, right, above, below = pad or (
        columns // 2,
        columns - columns // 2,
        rows // 2,
        rows - rows // 2,
    )
    padded = nn.functional.pad(
        nn.functional.pad(x, (left, right, 0, 0), "circular"), (0, 0, above, below)
    )
    assert torch.allclose(
        conv(x),
        nn.functional.conv2d(padded, conv.weight, conv.bias, stride, dilation=dilation),
        atol=1e-6,
    )


# --- a denoising diffusion network as a velocity
# --------------------------------------------------------------------

MEAN = 0.7
SPREAD = 0.4
TIMES = schedule_times(0.0015, 0.0195, 1000)


class KnownNoise(DiffusionUNet):
    """The optimal noise prediction for normal data with ``MEAN`` and ``SPREAD``: e = -s grad log
    p(x), at any step."""

    def evaluate(self, y: Tensor, step: Tensor, cond: Tensor | None) -> Tensor:
        low = step.floor().clamp(max=998).long()
        ratios = torch.logit(TIMES)
        t = (
            torch.lerp(ratios[low], ratios[low + 1], step.double() - low)
            .sigmoid()
            .view(-1, 1, 1, 1)
        )
        size = ((1 - t) ** 2 + t**2).sqrt()
        a = (1 - t) / size
        s = t / size
        return (s * (y - a * MEAN) / (a**2 * SPREAD**2 + s**2)).to(y.dtype)


def known_velocity(y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
    """E[e - y0 | y] for the same data, in closed form."""
    t = t.view(-1, 1, 1, 1).to(y.dtype)
    surprise = (y - (1 - t) * MEAN) / ((1 - t) ** 2 * SPREAD**2 + t**2)
    return (t - (1 - t) * SPREAD**2) * surprise - MEAN


@pytest.fixture(scope="module")
def known() -> Velocity:
    return KnownNoise(
        resolution=(2, 2), channels=1, width=2, multipliers=(1,), blocks=1, attention=()
    )


def normal(count: int, seed: int = 0) -> Tensor:
    return torch.randn(
        count,
        1,
        2,
        2,
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.float64,
    )


def test_steps_are_found_by_their_signal_to_noise_ratio() -> None:
    whole = torch.tensor([0, 1, 45, 254, 602, 998, 999])
    assert torch.allclose(step_of(TIMES[whole], TIMES), whole.float(), atol=1e-2)
    assert step_of(torch.tensor([0.22, 0.5, 0.82]), TIMES).round().tolist() == [
        45,
        254,
        602,
    ]
    assert step_of(torch.tensor([0.0, 0.01, 0.999, 1.0]), TIMES).tolist() == [
        0,
        0,
        999,
        999,
    ]
    assert (float(TIMES[0]), float(TIMES[-1])) == (
        pytest.approx(0.037, abs=5e-4),
        pytest.approx(0.988, abs=5e-4),
    )
    betas = torch.linspace(0.0015**0.5, 0.0195**0.5, 1000, dtype=torch.float64) ** 2
    signal = (1 - betas).cumprod(0)  # the definition: s^2 = 1 - a^2
    assert torch.allclose(TIMES / (1 - TIMES), ((1 - signal) / signal).sqrt())


@torch.no_grad()
def test_the_velocity_is_exact_at_the_steps_and_close_between_them(
    known: Velocity,
) -> None:
    for t in (TIMES[[0, 10, 300, 700, 999]], torch.tensor([0.1, 0.4, 0.51, 0.9, 0.98])):
        y = normal(5)
        assert torch.allclose(
            known(y, t.float(), None), known_velocity(y, t.float()), atol=1e-4
        )


@torch.no_grad()
def test_the_velocity_beyond_the_schedule_is_clamped_and_stays_close(
    known: Velocity,
) -> None:
    y = normal(2)
    noisiest = known(y, torch.tensor([1.0, 0.995]), None)
    assert (noisiest - known_velocity(y, torch.tensor([1.0, 0.995]))).abs().max() < 0.02
    cleanest = known(0.4 * y + MEAN, torch.tensor([0.0, 0.01]), None)
    assert cleanest.isfinite().all()
    assert (
        cleanest - known_velocity(0.4 * y + MEAN, torch.tensor([0.0, 0.01]))
    ).abs().max() < 0.5


@torch.no_grad()
def test_the_flow_of_a_diffusion_network_ends_at_the_data_distribution(
    known: Velocity,
) -> None:
    data = solve(known, normal(500).float(), uniform_grid(100))
    assert float(data.mean()) == pytest.approx(MEAN, abs=0.02)
    assert float(data.std()) == pytest.approx(SPREAD, abs=0.02)


def test_an_invalid_noise_schedule_is_refused() -> None:
    with pytest.raises(ConfigError, match="0 < start <= end < 1"):
        build_network("diffusion_unet", {**SMALL, "beta_start": 0.0})


@torch.no_grad()
def test_the_velocity_is_computed_from_the_predicted_noise() -> None:
    net = network("diffusion_unet", position=False)
    assert isinstance(net, DiffusionUNet)
    y = state(1)
    t = TIMES[[300]]
    x = y / ((1 - t) ** 2 + t**2).sqrt().float()
    noise = net.evaluate(x, torch.tensor([300.0]), None)
    assert torch.allclose(net(y, t), (noise - y) / (1 - t.float()), atol=1e-3)
