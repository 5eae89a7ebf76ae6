"""Drawing from coarse to fine: who may look at whom, and that neighbours come out alike where they
are."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor

from lidar_synth.generate.models.town_codec.autoencoder import Autoencoder
from lidar_synth.generate.models.town_codec.multiscale import LATTICES, at_lattice

SHAPE = 8, 32
pytestmark = pytest.mark.usefixtures("one_thread")


def network(answers: float) -> Autoencoder:
    """``answers``: deviation of the weights that begin as nothing."""
    torch.manual_seed(0)
    net = Autoencoder(SHAPE, widths=[12, 16], fine=8)
    with torch.no_grad():
        for name, weight in net.named_parameters():
            if "answer" in name:
                weight.normal_(0, answers)
    return net.eval()


def depths() -> Tensor:
    """(H, W) the first lattice that a cell lies on."""
    depth = torch.zeros(1, *SHAPE, dtype=torch.long)
    for i in reversed(range(len(LATTICES))):
        at_lattice(LATTICES[i], depth)[:] = i
    return depth[0]


def test_lattices_are_one_within_the_other_and_end_with_all_cells() -> None:
    assert LATTICES[-1] == (1, 1)
    for coarse, fine in pairwise(LATTICES):
        assert all(a in (b, 2 * b) for a, b in zip(coarse, fine, strict=True))


@pytest.mark.parametrize("channel", [0, 1], ids=["return", "reading"])
@pytest.mark.parametrize("depth", range(len(LATTICES)))
def test_cells_look_at_coarser_lattices_only(depth: int, channel: int) -> None:
    """Otherwise the product of what is predicted of the cells were no likelihood of the image."""
    net = network(0.3)
    x = torch.rand(1, 7, *SHAPE) - 0.5
    z = torch.randn(1, *net.latent_shape)
    row, column = (depths() == depth).nonzero()[-1].tolist()
    other = x.clone()
    other[0, channel, row, column] = -1.0
    with torch.inference_mode():
        a, b = (
            torch.cat([h.returned, *h.readings, h.classes], 1)
            for h in (net.expand(z, x), net.expand(z, other))
        )
    told = (a != b).any(1)[0]
    assert not told[depths() <= depth].any()
    assert told.any() == (depth < len(LATTICES) - 1)


def test_a_cell_without_a_return_reads_nothing() -> None:
    net = network(0.3)
    x = torch.rand(1, 7, *SHAPE) - 0.5
    x[:, 0, 0, 0] = -1.0
    other = x.clone()
    other[:, 1, 0, 0] = 0.9
    z = torch.randn(1, *net.latent_shape)
    with torch.inference_mode():
        assert torch.equal(net.expand(z, x).returned, net.expand(z, other).returned)


@pytest.mark.slow
def test_drawn_neighbours_are_alike_where_those_that_were_learnt_were() -> None:
    """Nearly all that readings differ by is common to blocks of cells, and the latent does not say
    it: cells that were drawn one by one would have nothing to do with each other."""
    net = network(0.0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        net.heads.bias[
            3
        ] = -2.0  # the spread of readings: away from its limit, where there is no slope
    z = torch.zeros(16, *net.latent_shape)
    optimizer = torch.optim.Adam(net.parameters(), 1e-2)
    for _ in range(200):
        x = torch.zeros(16, 7, *SHAPE)
        common, own = (
            torch.randn(16, *shape, generator=generator) for shape in (net.latent_shape[1:], SHAPE)
        )
        x[:, 1] = 0.1 * common.repeat_interleave(4, 1).repeat_interleave(8, 2) + 0.03 * own
        optimizer.zero_grad()
        predicted = net.expand(z, x).readings
        predicted.nll(x[:, 1:2]).mean().backward()
        optimizer.step()
    spreads = predicted.spreads.exp()[:, 0]
    assert spreads[:, depths() > 0].mean() < 0.5 * spreads[:, depths() == 0].mean()
    uniform_noise = torch.rand(64, net.draws, *SHAPE, generator=generator).clamp(1e-6, 1 - 1e-6)
    with torch.inference_mode():
        drawn = net.decode(z[:1].expand(64, -1, -1, -1), uniform_noise)[:, 1]
    pairs = torch.stack([drawn[..., ::2].flatten(), drawn[..., 1::2].flatten()])
    assert torch.corrcoef(pairs)[0, 1] > 0.2
