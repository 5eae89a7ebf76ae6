"""HDiT: the attention against its definition, the network against its symmetries, bad input."""

import copy
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings, strategies as st
from torch import Tensor

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models import NETWORKS, attention, build_network, layers
from lidar_synth.generate.models.attention import NeighbourhoodAttention
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.generate.models.hdit.transformer import from_patches, to_patches
from lidar_synth.generate.models.positions import POSITIONS

SMALL: dict[str, Any] = {
    "resolution": (8, 64),
    "width": 16,
    "time_width": 16,
    "depths": (1, 1, 1),
    "heads": (2, 4, 4),
}


pytestmark = pytest.mark.usefixtures("one_thread")


def angles(rows: int, columns: int) -> Tensor:
    """Ray angles of a grid: descending elevation, ascending azimuth."""
    grid = torch.meshgrid(
        torch.linspace(0.05, -0.4, rows),
        torch.linspace(-3.1, 3.1, columns),
        indexing="ij",
    )
    return torch.stack(grid)


def network(seed: int = 0, **arguments: Any) -> HDiT:
    """A small network with random weights (in a fresh one, every residual layer is zero)."""
    torch.manual_seed(seed)
    net = HDiT(
        **{
            **SMALL,
            "angles": angles(*arguments.get("resolution", SMALL["resolution"])),
            **arguments,
        }
    )
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return net.eval()


def distance(a: Tensor, b: Tensor) -> float:
    """Relative distance in the l2 norm."""
    return float((a - b).detach().norm() / b.norm())


def by_definition(
    q: Tensor, k: Tensor, v: Tensor, grid: tuple[int, int], window: tuple[int, int]
) -> Tensor:
    """Neighbourhood attention by its definition, token by token."""
    out = torch.empty_like(v)
    for row in range(grid[0]):
        top = min(max(row - window[0] // 2, 0), grid[0] - window[0])
        for column in range(grid[1]):
            columns = [
                (column + d) % grid[1]
                for d in range(-(window[1] // 2), window[1] // 2 + 1)
            ]
            keys = [
                r * grid[1] + c for r in range(top, top + window[0]) for c in columns
            ]
            token = row * grid[1] + column
            weights = torch.einsum("bhd,bnhd->bnh", q[:, token], k[:, keys]).softmax(1)
            out[:, token] = torch.einsum("bnh,bnhd->bhd", weights, v[:, keys])
    return out


def test_a_network_is_told_where_its_step_ends() -> None:
    fresh = HDiT(**SMALL, ends=True, angles=angles(*SMALL["resolution"])).eval()
    trained = network(ends=True)
    y = torch.randn(2, 2, 8, 64)
    with torch.no_grad():
        # At first the end makes no difference.
        assert torch.equal(fresh.step(torch.rand(2)), torch.zeros(2, 16))
        ends = [
            trained(y, 0.8, None, end) for end in (0.0, 0.5, torch.tensor([0.0, 0.5]))
        ]
        assert distance(ends[0], ends[1]) > 0.01
        assert torch.allclose(ends[2][0], ends[0][0], atol=1e-4) and torch.allclose(
            ends[2][1], ends[1][1], atol=1e-4
        )
        with pytest.raises(DataError, match="built without ends"):
            network()(y, 0.8, None, 0.0)


@settings(max_examples=40)
@given(
    grid=st.tuples(st.integers(3, 9), st.integers(4, 24)),
    window=st.tuples(st.sampled_from([1, 3, 5]), st.sampled_from([1, 3, 9])),
    tile=st.tuples(st.integers(1, 4), st.integers(1, 16)),
    seed=st.integers(0, 1000),
    recorded=st.booleans(),
)
def test_neighbourhood_attention_is_exact(
    grid: tuple[int, int],
    window: tuple[int, int],
    tile: tuple[int, int],
    seed: int,
    recorded: bool,
) -> None:
    window = (min(window[0], (grid[0] - 1) // 2 * 2 + 1), window[1])
    torch.manual_seed(seed)
    q, k, v = torch.randn(3, 2, grid[0] * grid[1], 2, 4, dtype=torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attention, "TILE", tile)
        attend = NeighbourhoodAttention(grid, window)
    with torch.set_grad_enabled(recorded):
        torch.testing.assert_close(
            attend(q, k, v), by_definition(q, k, v, grid, window)
        )


def test_every_query_attends_to_its_full_window() -> None:
    attend = NeighbourhoodAttention((4, 12), (3, 9))
    assert (attend.mask.sum(1) == 27).all()
    assert attend.tokens.flatten().sort().values.tolist() == list(range(48))


@settings(max_examples=30)
@given(
    rows=st.integers(1, 4),
    columns=st.integers(1, 4),
    patch=st.tuples(st.integers(1, 3), st.integers(1, 4)),
)
def test_from_patches_inverts_to_patches(
    rows: int, columns: int, patch: tuple[int, int]
) -> None:
    resolution = (rows * patch[0], columns * patch[1])
    x = torch.randn(2, *resolution, 3)
    assert torch.equal(from_patches(to_patches(x, patch), patch, resolution), x)


def test_the_full_network_has_the_published_size() -> None:
    with torch.device("meta"):
        net = build_network("hdit", {"resolution": [64, 1024]})
    assert sum(p.numel() for p in net.parameters()) == 80_908_420


@pytest.mark.parametrize("position", POSITIONS)
@pytest.mark.parametrize("resolution", [(8, 64), (24, 96), (12, 80)])
@torch.no_grad()
def test_every_position_encoding_works_at_several_resolutions(
    position: str, resolution: tuple[int, int]
) -> None:
    net = network(resolution=resolution, position=position, channels=7)
    y = torch.randn(2, 7, *resolution)
    v = net(y, torch.tensor([0.2, 0.9]))
    assert v.shape == y.shape
    assert v.isfinite().all()
    for i, t in enumerate([0.2, 0.9]):
        torch.testing.assert_close(net(y[i : i + 1], t)[0], v[i], rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_the_network_is_equivariant_to_rotations_about_the_vertical() -> None:
    """If the angles are rotated with the image, the network has no seam at the first column."""
    net = network(position="polar_coordinates")
    y, shift = (
        torch.randn(1, 2, 8, 64),
        16,
    )  # a token of the coarsest level has 16 columns
    turned = copy.deepcopy(net)
    turned.angles.cells = net.angles.cells.roll(shift, -1)
    torch.testing.assert_close(
        turned(y.roll(shift, -1), 0.5),
        net(y, 0.5).roll(shift, -1),
        rtol=1e-4,
        atol=1e-4,
    )
    assert distance(net(y.roll(shift, -1), 0.5), net(y, 0.5).roll(shift, -1)) > 1e-2


@torch.no_grad()
def test_computing_in_pieces_gives_the_same_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net = network()
    y = torch.randn(3, 2, 8, 64)
    whole = net(y, 0.5)
    monkeypatch.setattr(layers, "PIECE", 2000)
    assert layers.piece_length(y, 100, 300) < 10
    torch.testing.assert_close(net(y, 0.5), whole, rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_a_batch_of_tiles_above_a_gpus_limit_is_divided(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    batches: list[int] = []
    operator = F.scaled_dot_product_attention

    def watched(q: Tensor, *others: Any, **options: Any) -> Tensor:
        batches.append(len(q))
        return operator(q, *others, **options)

    net = network()
    y = torch.randn(3, 2, 8, 64)
    whole = net(y, 0.5)
    monkeypatch.setattr(F, "scaled_dot_product_attention", watched)
    monkeypatch.setattr(attention, "MOST", 5)
    torch.testing.assert_close(net(y, 0.5), whole, rtol=1e-5, atol=1e-5)
    assert max(batches) == 5


@torch.no_grad()
def test_condition_maps_change_the_velocity() -> None:
    net = network(condition_channels=3)
    y = torch.randn(2, 2, 8, 64)
    cond = torch.randn(2, 3, 8, 64)
    v = net(y, 0.5, cond)
    assert v.shape == y.shape
    assert distance(net(y, 0.5, 2 * cond), v) > 1e-3
    for given_, found in (
        (None, "no condition"),
        (cond[:, :2], r"\(2, 2, 8, 64\)"),
        (cond[:1], r"\(1, 3, 8, 64\)"),
    ):
        with pytest.raises(DataError, match=rf"{found}.*expected \(2, 3, 8, 64\)"):
            net(y, 0.5, given_)
    with pytest.raises(DataError, match="takes no condition"):
        network()(y, 0.5, cond)


@torch.no_grad()
def test_condition_tokens_change_the_velocity() -> None:
    net = network(context_channels=5)
    y = torch.randn(2, 2, 8, 64)
    cond = torch.randn(2, 7, 5)
    v = net(y, 0.5, cond)
    assert v.shape == y.shape
    # The order of tokens does not matter.
    torch.testing.assert_close(
        net(y, 0.5, cond[:, torch.randperm(7)]), v, rtol=1e-4, atol=1e-4
    )
    other = net(y, 0.5, torch.stack([cond[0], -cond[1]]))
    torch.testing.assert_close(other[0], v[0], rtol=1e-5, atol=1e-5)
    assert distance(other[1], v[1]) > 1e-3
    for given_, found in (
        (None, "no condition"),
        (cond[..., :4], r"\(2, 7, 4\)"),
        (cond[:1], r"\(1, 7, 5\)"),
    ):
        with pytest.raises(DataError, match=rf"{found}.*expected \(2, tokens, 5\)"):
            net(y, 0.5, given_)


def test_states_and_times_of_another_shape_are_refused() -> None:
    net = network()
    for shape in ((2, 3, 8, 64), (2, 2, 8, 32), (2, 8, 64)):
        with pytest.raises(DataError, match=r"expected \(B, 2, 8, 64\)"):
            net(torch.zeros(shape), 0.5)
    with pytest.raises(DataError, match=r"times of shape \(3,\) for 2 states"):
        net(torch.zeros(2, 2, 8, 64), torch.zeros(3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": (8, 60)}, r"resolution \(8, 60\).*multiples of \(4, 16\)"),
        ({"resolution": (6, 64)}, "multiples of"),
        ({"resolution": (8,)}, "arguments of its class"),
        ({"heads": (2, 4)}, "heads"),
        ({"heads": (2, 4, 5)}, "multiples of 4"),
        ({"window": (2, 9)}, "odd"),
        ({"window": (9, 9)}, r"window \(9, 9\) on a grid of"),
        ({"position": "sine"}, "one of learned"),
        ({"patch": (0, 4)}, "arguments of its class"),
        ({"widht": 32}, "widht"),
        ({"angles": torch.zeros(2, 8, 8)}, r"\(2, 8, 64\)"),
    ],
    ids=str,
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_network("hdit", SMALL | arguments)


def test_unknown_architectures_are_refused() -> None:
    with pytest.raises(ConfigError, match=f"'unet9'.*one of {', '.join(NETWORKS)}"):
        build_network("unet9", {})


@torch.no_grad()
def test_missing_ray_angles_give_nan() -> None:
    assert network(angles=None)(torch.randn(1, 2, 8, 64), 0.5).isnan().all()


def test_gradient_checkpointing_gives_the_same_gradients() -> None:
    net = network()
    y = torch.randn(1, 2, 8, 64)
    gradients = []
    for net.gradient_checkpointing in (False, True):
        net.zero_grad()
        net(y, 0.3).square().mean().backward()
        gradients.append([p.grad for p in net.parameters()])
    assert all(g is not None and g.abs().sum() > 0 for g in gradients[0])
    torch.testing.assert_close(gradients[1], gradients[0])


@torch.no_grad()
def test_half_precision_keeps_the_angles_in_float32() -> None:
    """In bfloat16, the velocity stays close and has the state's dtype; angles and harmonics are not
    rounded."""
    net = network()
    y = torch.randn(2, 2, 8, 64)
    expected = net(y, 0.4)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net(y, 0.4)
    exact = {name: b.clone() for name, b in net.named_buffers()}
    half = net.to(torch.bfloat16)
    assert {p.dtype for p in half.parameters()} == {torch.bfloat16}
    assert sum(b.is_floating_point() for b in exact.values()) == 5
    assert all(torch.equal(b, exact[name]) for name, b in half.named_buffers())
    for v in (mixed, half(y, 0.4)):
        assert v.dtype == torch.float32
        assert 1e-4 < distance(v, expected) < 0.1


@pytest.mark.slow
@torch.no_grad()
def test_it_compiles_as_one_graph() -> None:
    net = network()
    y = torch.randn(2, 2, 8, 64)
    t = torch.tensor([0.1, 0.8])
    compiled = torch.compile(net, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(y, t), net(y, t), rtol=1e-4, atol=1e-4)
