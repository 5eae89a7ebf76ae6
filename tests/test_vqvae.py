"""The autoencoder: shapes, circular columns, the codebook and its training."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.lidm.vqvae import VQVAE

SMALL: dict[str, Any] = {
    "resolution": (8, 32),
    "channels": 2,
    "latent_channels": 4,
    "codes": 16,
    "width": 8,
    "multipliers": (1, 2),
    "strides": ((2, 2),),
    "blocks": 1,
    "groups": 4,
}


pytestmark = pytest.mark.usefixtures("one_thread")


def network(**arguments: Any) -> VQVAE:
    torch.manual_seed(0)
    net = build_network("vqvae", {**SMALL, **arguments})
    assert isinstance(net, VQVAE)
    if len(net.codebook.codes):
        nn.init.normal_(net.codebook.codes, std=0.3)
    return net.eval()


def image(count: int = 2) -> Tensor:
    return torch.randn(count, 2, 8, 32, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
@pytest.mark.parametrize(
    ("arguments", "shape"),
    [
        ({}, (4, 4, 16)),
        ({"strides": ((1, 2), (2, 2)), "multipliers": (1, 1, 2)}, (4, 4, 8)),
        ({"strides": ((2, 1),)}, (4, 4, 32)),
        ({"strides": ((1, 4),)}, (4, 8, 8)),
        ({"patch": (2, 4)}, (4, 2, 4)),
        ({"strides": (), "multipliers": (1,), "attention": False}, (4, 8, 32)),
    ],
)
def test_latents_and_outputs_have_the_documented_shapes(
    arguments: dict[str, Any], shape: tuple[int, ...]
) -> None:
    net = network(**arguments)
    latent = net.encode(image())
    assert net.latent_shape == shape == latent.shape[1:]
    assert net.decode(latent).shape == image().shape


def test_the_default_latent_has_the_shape_of_lidm() -> None:
    with torch.device("meta"):
        assert VQVAE((64, 1024)).latent_shape == (8, 16, 128)


@torch.no_grad()
@pytest.mark.parametrize("patch", [(1, 1), (2, 2)])
def test_the_encoder_wraps_columns_but_not_rows(patch: tuple[int, int]) -> None:
    net = network(patch=patch)
    x = image()
    z = net.encode(x)
    columns = 2 * patch[1]
    assert torch.allclose(net.encode(x.roll(columns, -1)), z.roll(1, -1), atol=1e-5)
    assert not torch.allclose(
        net.encode(x.roll(2 * patch[0], -2)), z.roll(1, -2), atol=1e-2
    )


@torch.no_grad()
def test_vectors_are_quantised_to_their_nearest_codes() -> None:
    net = network()
    z = torch.randn(2, 4, 4, 16)
    quantised, index = net.codebook(z)
    tokens = z.movedim(1, -1).flatten(0, 2)
    assert torch.equal(
        index.flatten(), torch.cdist(tokens, net.codebook.codes).argmin(1)
    )
    assert torch.equal(
        quantised.movedim(1, -1).flatten(0, 2), net.codebook.codes[index.flatten()]
    )
    again, same = net.codebook(quantised)
    assert torch.equal(same, index)
    assert torch.equal(again, quantised)


@torch.no_grad()
def test_a_small_error_of_the_latent_does_not_change_the_image() -> None:
    net = network()
    z = net.encode(image())
    codes = net.codebook(z)[0]
    assert torch.equal(net.decode(codes), net.decode(codes + 1e-3))
    assert torch.allclose(net(image()).output, net.decode(z), atol=1e-5)


def test_gradients_pass_straight_through_the_codebook() -> None:
    net = network()
    output, gap, code_gap = net(image())
    assert gap.shape == (2,) and torch.equal(gap, code_gap)
    output.square().mean().backward(retain_graph=True)
    assert (
        net.encoder.stem.weight.grad is not None and net.encoder.stem.weight.grad.any()
    )
    assert net.codebook.codes.grad is None or not net.codebook.codes.grad.any()
    net.zero_grad()
    gap.mean().backward(retain_graph=True)
    assert net.encoder.stem.weight.grad is not None and net.codebook.codes.grad is None
    net.zero_grad()
    code_gap.mean().backward()
    assert net.codebook.codes.grad is not None and net.encoder.stem.weight.grad is None


def test_training_moves_the_codes_towards_the_latents() -> None:
    """After some steps, the codes are closer to the latents of the same images than before."""
    net = network().train()
    for parameter in net.parameters():
        parameter.requires_grad_(parameter is net.codebook.codes)
    before = net(image()).gap.mean()
    optimizer = torch.optim.Adam([net.codebook.codes], 0.05)
    for _ in range(30):
        optimizer.zero_grad()
        net(image()).code_gap.mean().backward()
        optimizer.step()
    assert net.eval()(image()).gap.mean() < 0.7 * before


def test_without_a_codebook_latents_are_bounded() -> None:
    net = network(codes=0)
    assert (100 * image()).abs().max() > 100
    assert net.encode(100 * image()).abs().max() <= 1
    output, gap, code_gap = net(image())
    assert torch.equal(output, net.decode(net.encode(image())))
    assert not gap.any() and not code_gap.any()
    # DistributedDataParallel refuses one that is trained and not used
    assert not net.codebook.codes.requires_grad


@torch.no_grad()
def test_latents_have_mean_0_and_variance_1() -> None:
    net = network().train()
    x = image(8)
    raw = net.encode(x)
    assert abs(float(raw.std()) - 1) > 0.2
    net(x)
    z = net.eval().encode(x)
    assert torch.allclose(z.mean((0, 2, 3)), torch.zeros(4), atol=1e-4)
    assert torch.allclose(z.std((0, 2, 3)), torch.ones(4), atol=1e-4)
    # The decoder reverts the normalisation.
    assert torch.allclose(net.decode(z), net(x).output, atol=1e-5)


@pytest.mark.parametrize("checkpointing", [False, True])
def test_every_weight_gets_a_gradient(checkpointing: bool) -> None:
    net = network()
    net.gradient_checkpointing = checkpointing
    output, gap, code_gap = net(image())
    (output.square().mean() + gap.mean() + code_gap.mean()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name


def test_images_and_latents_of_another_shape_are_refused() -> None:
    with pytest.raises(
        DataError, match=r"a latent of shape \(1, 4, 4, 8\); expected \(B, 4, 4, 16\)"
    ):
        network().decode(torch.zeros(1, 4, 4, 8))
    with pytest.raises(
        DataError, match=r"an image of shape \(1, 1, 8, 32\); expected \(B, 2, 8, 32\)"
    ):
        network().encode(torch.zeros(1, 1, 8, 32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"resolution": (9, 32)},
            r"an image of \(9, 32\) rows and columns; expected multiples of \(2, 2\)",
        ),
        ({"multipliers": (1, 2, 3)}, "one multiplier more than strides"),
        ({"strides": ((3, 3),)}, "strides of"),
        ({"colour": 1}, "colour"),
    ],
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_network("vqvae", {**SMALL, **arguments})
