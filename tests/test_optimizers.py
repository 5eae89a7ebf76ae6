"""Optimisers: what a step of Muon does to a matrix, and in which precision."""

import pytest
import torch
from torch import nn

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.generate.models import build_network
from lidar_synth.lab.train import OPTIMIZERS


def transformer() -> nn.Module:
    torch.manual_seed(0)
    small = {
        "width": 16,
        "time_width": 16,
        "depths": [1],
        "heads": [2],
        "patch": [2, 4],
    }
    return build_network(
        "hdit",
        {"resolution": (8, 32), "channels": 3, "angles": torch.zeros(2, 8, 32)} | small,
    )


def test_a_step_of_muon_turns_all_directions_alike() -> None:
    """The update of a matrix has singular values that are about equal, whatever its gradient's
    are."""
    network = transformer()
    muon = OPTIMIZERS["muon"](network, 0.1, (0.9, 0.99), 0.0)[0]
    weight = muon.param_groups[0]["params"][0]
    before = weight.detach().clone()
    u, _, v = torch.linalg.svd(torch.randn(weight.shape), full_matrices=False)
    weight.grad = u * torch.logspace(0, -1, u.shape[1]) @ v
    muon.step()
    values = torch.linalg.svdvals(before - weight.detach())
    assert values.max() < 2 * values.min()
    rms = (before - weight.detach()).square().mean().sqrt()
    assert 0.1 < rms / 0.1 < 0.4, "as long as a step of AdamW commonly is"


@pytest.mark.parametrize(("half", "error"), [(True, 0.1), (False, 1e-4)])
def test_muon_computes_in_float32_where_bfloat16_is_slower(
    half: bool, error: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the polynomial of its five iterations (Jordan et al. 2024), applied to the singular
    values in float64."""
    monkeypatch.setattr(
        "lidar_synth.lab.train.optimizers.faster_in_bfloat16", lambda: half
    )
    muon = OPTIMIZERS["muon"](transformer(), 0.1, (0.9, 0.99), 0.0)[0]
    weight = muon.param_groups[0]["params"][0]
    before = weight.detach().clone()
    weight.grad = torch.randn(weight.shape, generator=torch.Generator().manual_seed(1))
    u, values, v = torch.linalg.svd(weight.grad.double(), full_matrices=False)
    values = values / values.norm()
    for _ in range(5):
        values = 3.4445 * values - 4.775 * values**3 + 2.0315 * values**5
    muon.step()
    expected = 0.1 * 0.2 * max(weight.shape) ** 0.5 * (u * values) @ v
    difference = (before - weight.detach() - expected).norm() / expected.norm()
    assert error / 1000 < difference < error


def test_muon_refuses_a_network_without_matrices_to_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(
        ConfigError, match="optimizer 'muon' for Conv2d; expected a transformer"
    ):
        OPTIMIZERS["muon"](nn.Conv2d(3, 3, 1), 0.1, (0.9, 0.99), 0.0)
    monkeypatch.delattr(torch.optim, "Muon")
    with pytest.raises(
        LibraryError, match=r"expected torch >= 2\.9\. Or optimizer: adamw"
    ):
        OPTIMIZERS["muon"](transformer(), 0.1, (0.9, 0.99), 0.0)
