"""The network that predicts the data: at every time, its velocity follows from the prediction."""

import pytest
import torch

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 16, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
ARGUMENTS = {
    "resolution": (8, 16),
    "channels": 2,
    "width": 16,
    "time_width": 16,
    "depths": (1, 1),
    "heads": (2, 2),
    "patch": (2, 2),
    "window": (3, 3),
    "angles": torch.from_numpy(SENSOR.ray_angles()),
}
TIMES = torch.tensor([1e-3, 0.05, 0.3, 0.8, 1.0])


def network(detail: float = 0.1, std: float = 0.0) -> torch.nn.Module:
    torch.manual_seed(0)
    built = build_network("denoiser", ARGUMENTS | {"detail": detail}).eval()
    if std:
        torch.nn.init.normal_(built.detokenize.weight, std=std)
    return built


def states() -> torch.Tensor:
    return torch.randn(len(TIMES), 2, 8, 16, generator=torch.Generator().manual_seed(1))


def test_the_velocity_points_from_the_state_to_the_data_estimate() -> None:
    """y - t v = (1 - t) s^2 / d y - t / sqrt(d) F, the equation in the module's docstring."""
    detail = 0.2
    y = states()
    net = network(detail, std=0.3)
    t = TIMES.view(-1, 1, 1, 1)
    spread = (1 - t) ** 2 * detail**2 + t**2
    with torch.no_grad():
        estimate = (1 - t) * detail**2 / spread * y - t / spread.sqrt() * HDiT.forward(
            net, y, TIMES
        )
        assert torch.allclose(y - t * net(y, TIMES), estimate, atol=1e-5)


def test_a_fresh_network_gives_the_best_linear_estimate() -> None:
    """F = 0: the best linear estimate for data of standard deviation s around zero."""
    y = states()
    with torch.no_grad():
        v = network()(y, TIMES)
    # T = 1: the estimate is 0.
    assert torch.allclose(y[-1] - v[-1], torch.zeros(2, 8, 16), atol=1e-6)
    # t near 0: the state itself
    assert torch.allclose(y[0] - 1e-3 * v[0], y[0], atol=5e-3)


def test_the_velocity_is_finite_and_has_a_bounded_slope_at_all_times() -> None:
    net = network(0.1, std=0.3)
    t = torch.linspace(0, 1, 21)
    y = torch.randn(21, 2, 8, 16)
    with torch.no_grad():
        v = net(y, t)
        answer = HDiT.forward(net, y, t)
    assert v.isfinite().all()
    assert (v.abs() <= y.abs() / 0.1 + answer.abs() / 0.09).all()
    with torch.no_grad():
        assert torch.allclose(net(y[:1], 0.5), net(y[:1], torch.tensor([0.5])))


def test_bfloat16_stays_close_to_float32() -> None:
    net = network(std=0.3)
    y = states()
    with torch.no_grad():
        exact = net(y, TIMES)
        rough = net.to(torch.bfloat16)(y, TIMES)
    assert rough.dtype == torch.float32
    assert (rough - exact).abs().mean() < 0.05 * exact.abs().mean()


def test_an_invalid_detail_is_refused() -> None:
    with pytest.raises(ConfigError, match="detail 0"):
        network(0.0)
    with pytest.raises(ConfigError, match="denoiser"):
        build_network("denoiser", ARGUMENTS | {"sigma": 1})
    with pytest.raises(DataError, match="shape"):
        network()(torch.zeros(1, 3, 8, 16), 0.5)
