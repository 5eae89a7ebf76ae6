"""Ranges as planes: a plane seen by rays comes out exact, an edge stays between two cells."""

import math

import pytest
import torch

from lidar_synth.generate.models.town_codec.planes import (
    SLOPES,
    Planes,
    RangeMixture,
    laplace_noise,
)
from lidar_synth.geometry.normalize import NORMALISATIONS

PATCH = (2, 4)


@pytest.mark.parametrize("name", NORMALISATIONS)
def test_a_patch_on_a_wall_is_a_wall(name: str) -> None:
    """A wall at x = 12 m: 1 / r = cos(azimuth) / 12; over four columns of a turn of 1024, linear to
    a millimetre."""
    scale = NORMALISATIONS[name]
    net = Planes(1, PATCH, 1, scale)
    azimuth = 0.6 + torch.arange(8) * 2 * math.pi / 1024
    seen = 12 / torch.cos(azimuth)
    with torch.no_grad():
        net.planes.weight.zero_()
        for patch in range(2):  # what the network would have to say of each patch
            inverse = 1 / seen[4 * patch : 4 * patch + 4]
            middle = inverse.mean()
            slope = (inverse[3] - inverse[0]) / 3
            net.planes.bias.copy_(
                torch.tensor([-math.log(middle), float(slope / middle) / SLOPES[1], 0.0, -3.0])
            )
            values, spreads = net(torch.zeros(1, 1, 1, 1))
            assert values.shape == spreads.shape == (1, 1, *PATCH)
            metres = scale.decode(values)[0, 0]
            assert torch.allclose(metres, seen[4 * patch : 4 * patch + 4].expand(2, -1), atol=1e-3)


def test_a_road_is_a_plane_down_the_rows() -> None:
    """Of a road 1.7 m below, 1 / r = sin(depression) / 1.7."""
    depression = torch.tensor([0.06, 0.067])
    inverse = torch.sin(depression) / 1.7
    net = Planes(1, PATCH, 1, NORMALISATIONS["r2flow"])
    with torch.no_grad():
        net.planes.weight.zero_()
        middle = inverse.mean()
        slope = float((inverse[1] - inverse[0]) / middle) / SLOPES[0]
        net.planes.bias.copy_(torch.tensor([-math.log(middle), 0.0, slope, -3.0]))
    metres = NORMALISATIONS["r2flow"].decode(net(torch.zeros(1, 1, 1, 1))[0])[0, 0]
    assert torch.allclose(metres, (1 / inverse)[:, None].expand(-1, 4), rtol=1e-4)


def test_candidates_are_returns_whatever_the_network_says() -> None:
    for name, scale in NORMALISATIONS.items():
        values, _ = Planes(3, PATCH, 2, scale)(1e3 * torch.randn(2, 3, 4, 4))
        assert (scale.decode(values) > 0).all(), name
        assert values.isfinite().all()


def test_a_cell_sees_one_surface_never_what_lies_between() -> None:
    values = torch.tensor([-0.5, 0.5]).view(1, 2, 1, 1).expand(1, 2, 4, 8)
    chosen = torch.randn(1, 2, 4, 8)
    predicted = RangeMixture(values, torch.full_like(values, -3.0), chosen)
    likeliest = predicted.mode()
    assert set(likeliest.unique().tolist()) == {-0.5, 0.5}
    assert torch.equal(likeliest[0, 0] > 0, chosen[0, 1] > chosen[0, 0])
    assert (predicted.nll(likeliest) < predicted.nll(torch.zeros_like(likeliest))).all()


def test_draws_are_those_of_laplace() -> None:
    uniform_noise = (torch.arange(10_000) + 0.5) / 10_000
    drawn = laplace_noise(uniform_noise)
    assert torch.allclose(
        torch.distributions.Laplace(0.0, 1.0).cdf(drawn), uniform_noise, atol=1e-6
    )
