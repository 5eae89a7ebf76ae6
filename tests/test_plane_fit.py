"""Planes that neighbours agree on: a plane comes out exact whoever is asked, and another surface
does not bend it."""

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from lidar_synth.generate.models.town_codec.plane_fit import PlaneFit

pytestmark = pytest.mark.usefixtures("one_thread")

PATCH = (2, 4)
GRID = (8, 64)
ROWS = PATCH[0] * GRID[0]
COLUMNS = PATCH[1] * GRID[1]
ELEVATION = torch.linspace(0.05, -0.4, ROWS).tan()
"""Tangents, by row."""
BELOW = GRID[0] // 2
"""The first row of patches that are compared; above it they look near or over the horizon of the
planes."""
LEVEL = -ELEVATION.view(-1, PATCH[0]).mean(1)[BELOW - 2].item()
"""Smallest tangent below the horizon of the patches that count in the compared ones, two rows above
them."""


def consensus(scale: float = 0.1, window: tuple[int, int] = (3, 9)) -> PlaneFit:
    torch.manual_seed(0)
    net = PlaneFit(5, GRID, PATCH, 2, window, ELEVATION)
    with torch.no_grad():
        net.look.weight.normal_(std=scale)
    return net


def seen(a: float, b: float, c: float, azimuth: Tensor, tangent: Tensor) -> Tensor:
    """Inverse ranges of the plane a cos + b sin + c tan."""
    return (a * azimuth.cos() + b * azimuth.sin() + c * tangent) / (1 + tangent**2).sqrt()


def cells(a: float, b: float, c: float) -> Tensor:
    """(H, W) of every cell."""
    return seen(a, b, c, (torch.arange(COLUMNS) - 1.5) * 2 * math.pi / COLUMNS, ELEVATION[:, None])


def patches(a: float, b: float, c: float) -> Tensor:
    """(h, w) of the middle of every patch."""
    tangent = ELEVATION.view(-1, PATCH[0]).mean(1, keepdim=True)
    return seen(a, b, c, torch.arange(GRID[1]) * 2 * math.pi / GRID[1], tangent)


@settings(max_examples=20)
@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.6, -0.3), st.integers(0, 100))
def test_what_sees_a_plane_comes_out_as_the_plane(a: float, b: float, c: float, seed: int) -> None:
    """Whatever the features: the weights of exact points do not matter."""
    assume(math.hypot(a, b) < -c * LEVEL)  # otherwise these do not see the plane everywhere
    generator = torch.Generator().manual_seed(seed)
    distance = -patches(a, b, c).clamp_min(1e-3).log().expand(1, 2, -1, -1)
    with torch.inference_mode():
        inverse, share = consensus()(torch.randn(1, 5, *GRID, generator=generator), distance)
    assert inverse.shape == (1, 2, ROWS, COLUMNS) and share.shape == (1, 2, *GRID)
    below = slice(PATCH[0] * BELOW, None)
    torch.testing.assert_close(inverse[0, 1, below], cells(a, b, c)[below], rtol=1e-2, atol=0)


def test_a_wall_of_patches_that_are_off_is_straighter() -> None:
    torch.manual_seed(1)
    wall = patches(0.1, 0.0, 0.0)[:, :6]
    distance = torch.full((1, 2, *GRID), 4.0)
    distance[..., :6] = -(wall * (1 + 0.03 * torch.randn_like(wall))).log()
    net = consensus(scale=0.0, window=(5, 11))
    with torch.inference_mode():
        inverse, _ = net(torch.zeros(1, 5, *GRID), distance)
    off = (inverse[0, 0, :, : 4 * 6] / cells(0.1, 0.0, 0.0)[:, : 4 * 6] - 1).square().mean().sqrt()
    assert off < 0.4 * 0.03


def test_what_is_far_behind_does_not_count() -> None:
    distance = torch.full((1, 2, *GRID), math.log(5.0))
    distance[..., 3:7] = math.log(50.0)
    with torch.inference_mode():
        inverse, _ = consensus(scale=0.0)(torch.zeros(1, 5, *GRID), distance)
    ranges = 1 / inverse[0, 0, 8, [8, 14, 18, 26, 34]]
    assert torch.allclose(ranges, torch.tensor([5.0, 50.0, 50.0, 50.0, 5.0]), rtol=0.05)


def test_columns_wrap() -> None:
    net = consensus()
    x = torch.randn(1, 5, *GRID)
    distance = torch.rand(1, 2, *GRID) + 2
    with torch.inference_mode():
        inverse, share = net(x, distance)
        turned, share_turned = net(x.roll(1, -1), distance.roll(1, -1))
    assert torch.allclose(turned, inverse.roll(PATCH[1], -1), rtol=1e-3)
    assert torch.allclose(share_turned, share.roll(1, -1), atol=1e-6)
