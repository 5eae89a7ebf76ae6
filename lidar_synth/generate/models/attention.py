"""Attention over a neighbourhood on a range image, exact and in plain PyTorch.

Each token attends to a window of tokens around it. Columns wrap around, since the image is a full
turn. At the top and at the bottom the window is shifted inwards so that it keeps its size (Hassani
et al., "Neighborhood Attention Transformer", CVPR 2023). Attention does not depend on the order of
the keys, so that shifting the window is equivalent to padding: with m rows to each side, the row
that lies j rows above the top is replaced by row 2m + 1 - j. For three rows, row 2 is placed above
row 0; the window of row 0 is then {2, 0, 1}. Columns are padded circularly. After padding, all
windows have the same form, and a tile of queries with its margin of keys is ordinary attention
under one constant mask. Padding and tiling are computed once, on token indices.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.layers import piece_length

Grid = tuple[int, int]
"""Rows and columns of an image, of its tokens, or of a window."""

TILE: Grid = (2, 16)
"""Largest number of query rows and columns per tile. Larger tiles compute more masked products and
copy less; the result is the same."""


MOST = 65_535
"""Most blocks along one side of a GPU's grid: the operator takes no larger batch of tiles."""


class NeighbourhoodAttention(nn.Module):
    """softmax(q k^T) v over the window around each token of a grid.

    Args:
        grid: rows and columns of tokens.
        window: rows and columns of a neighbourhood, odd; at most as many rows as the grid, and at
            most 2 W + 1 columns for a grid of W.

    Raises:
        ConfigError: on a window that is even or too large.
    """

    tokens: Tensor
    keys: Tensor
    place: Tensor
    mask: Tensor

    def __init__(self, grid: Grid, window: Grid) -> None:
        super().__init__()
        if (
            min(window) < 1
            or not window[0] % 2 & window[1] % 2
            or window[0] > grid[0]
            or window[1] // 2 > grid[1]
        ):
            raise ConfigError(
                f"window {window} on a grid of {grid} tokens",
                "odd, and within the grid",
            )
        tile = (_divisor(grid[0], TILE[0]), _divisor(grid[1], TILE[1]))
        span = (tile[0] + window[0] - 1, tile[1] + window[1] - 1)
        # a real tensor, even under the "meta" device
        numbers = torch.arange(grid[0] * grid[1], device="cpu").view(grid)
        tokens = _tiles(numbers, tile, tile)
        buffers = {
            # (tiles, n) tokens whose queries are in each tile; each token once
            "tokens": tokens,
            # (tiles, m) tokens of each tile and its margin
            "keys": _tiles(_padded(numbers, window), span, tile),
            # (N,) position of each token in ``tokens``
            "place": tokens.flatten().argsort(),
            # (n, m) whether a key is in a query's window
            "mask": _in_window(tile, window),
        }
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer, persistent=False)

    def forward(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Queries and keys (B, N, heads, D), already scaled, and values (B, N, heads, E), with
        tokens in row-major order, to (B, N, heads, E)."""
        length = piece_length(q, len(self.keys), self.keys.shape[1] * q[:, 0].numel())
        out = []
        for tokens, keys in zip(
            torch.split(self.tokens, length),
            torch.split(self.keys, length),
            strict=True,
        ):
            tiles = _tiled(q, tokens), _tiled(k, keys), _tiled(v, keys)
            h = attention(*tiles, self.mask)
            out.append(h.transpose(1, 2).reshape(len(v), -1, *v.shape[2:]))
        return _pick(torch.cat(out, 1), self.place)


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q k^T) v of (B, heads, n, D) and (B, heads, m, D), already scaled, where ``mask`` (n,
    m) is true."""
    if q.device.type != "cpu" or not torch.is_grad_enabled():
        parts = (torch.split(x, MOST) for x in (q, k, v))
        done = [
            F.scaled_dot_product_attention(a, b, c, mask, scale=1.0)
            for a, b, c in zip(*parts, strict=True)
        ]
        return done[0] if len(done) == 1 else torch.cat(done)
    # With so few keys, the backward pass of the fused operator is slower on a CPU, much slower in
    # bfloat16.
    scores = q @ k.transpose(-1, -2)
    scores = scores if mask is None else scores.masked_fill(~mask, -torch.inf)
    return scores.softmax(-1).to(v.dtype) @ v


def _tiled(x: Tensor, index: Tensor) -> Tensor:
    """The tokens (tiles, n) of x (B, N, heads, D) as (B tiles, heads, n, D)."""
    return (
        _pick(x, index.flatten())
        .reshape(-1, index.shape[1], *x.shape[2:])
        .transpose(1, 2)
    )


def _pick(x: Tensor, index: Tensor) -> Tensor:
    """The tokens (n,) of x (B, N, ...) as (B, n, ...)."""
    # The gradient of one flat index is several times faster on a CPU than that of an index along
    # dimension 1.
    rows = index + x.shape[1] * torch.arange(len(x), device=x.device)[:, None]
    return (
        x.flatten(0, 1)
        .index_select(0, rows.flatten())
        .reshape(*rows.shape, *x.shape[2:])
    )


def _divisor(size: int, limit: int) -> int:
    """The largest divisor of ``size`` up to ``limit``."""
    return next(n for n in range(min(size, limit), 0, -1) if size % n == 0)


def _padded(x: Tensor, window: Grid) -> Tensor:
    """(H, W) with the margin that gives all windows the same form; see the module's docstring."""
    m = window[0] // 2
    n = window[1] // 2
    rows, columns = x.shape
    x = torch.cat((x[m + 1 : 2 * m + 1], x, x[rows - 2 * m - 1 : rows - m - 1]))
    return torch.cat((x[:, columns - n :], x, x[:, :n]), 1)


def _tiles(x: Tensor, size: Grid, step: Grid) -> Tensor:
    """(H, W) to (tiles, rows columns), overlapping where ``size`` is larger than ``step``."""
    return (
        x.unfold(0, size[0], step[0])
        .unfold(1, size[1], step[1])
        .flatten(2)
        .flatten(0, 1)
    )


def _in_window(tile: Grid, window: Grid) -> Tensor:
    """(n, m) whether a key of a tile and its margin is in the window of a query."""
    axes = []
    for size, reach in zip(tile, window, strict=True):
        offset = (
            torch.arange(size + reach - 1, device="cpu")
            - torch.arange(size, device="cpu")[:, None]
        )
        axes.append((offset >= 0) & (offset < reach))
    return (
        (axes[0][:, None, :, None] & axes[1][None, :, None, :]).flatten(2).flatten(0, 1)
    )
