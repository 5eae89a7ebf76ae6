"""Attention over a neighbourhood on a range image, exact and in plain PyTorch.

Each token attends to a window of tokens around it. Columns wrap, as the image is a full turn. At the top and
at the bottom the window is moved inwards so that it keeps its size (Hassani et al., "Neighborhood Attention
Transformer", CVPR 2023). Attention over a set knows no order, so that moving the window is the same as
padding: the row that lies j rows above the top is replaced by row 2m + 1 - j, with m rows to each side. For
three rows, row 2 is set above row 0; the window of row 0 is then {2, 0, 1}. Columns are padded by those of the
other side. After that all windows are alike, and a tile of queries together with its margin of keys is
ordinary attention under one constant mask. Padding and tiling are done once, on the numbers of the tokens.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.models.layers import piece_length

Grid = tuple[int, int]
"""Rows and columns: of an image, of its tokens, of a window."""

TILE: Grid = (2, 16)
"""Queries of a tile at most. A larger one wastes more products and copies less; the result is the same."""


class NeighbourhoodAttention(nn.Module):
    """softmax(q k^T) v over the window around each token of a grid.

    Args:
        grid: rows and columns of tokens.
        window: rows and columns of a neighbourhood, odd; no more rows than the grid, half of its columns at most
            as many as the grid's.

    Raises:
        ConfigError: on a window that is not.
    """

    tokens: Tensor
    keys: Tensor
    place: Tensor
    mask: Tensor

    def __init__(self, grid: Grid, window: Grid) -> None:
        super().__init__()
        if min(window) < 1 or not window[0] % 2 & window[1] % 2 or window[0] > grid[0] or window[1] // 2 > grid[1]:
            raise ConfigError(f"window {window} on a grid of {grid} tokens", "odd, and within the grid")
        tile = (_divisor(grid[0], TILE[0]), _divisor(grid[1], TILE[1]))
        span = (tile[0] + window[0] - 1, tile[1] + window[1] - 1)
        numbers = torch.arange(grid[0] * grid[1], device="cpu").view(grid)  # real, even where weights are not (meta)
        tokens = _tiles(numbers, tile, tile)
        buffers = {
            "tokens": tokens,  # (tiles, n) whose queries a tile holds; each token once
            "keys": _tiles(_surround(numbers, window), span, tile),  # (tiles, m) those of a tile and of its margin
            "place": tokens.flatten().argsort(),  # (N,) where each token stands in ``tokens``
            "mask": _near(tile, window),  # (n, m) whether a key lies in a query's window
        }
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer, persistent=False)

    def forward(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Queries and keys (B, N, heads, D), scaled already, and values (B, N, heads, E), tokens row by row, to
        (B, N, heads, E)."""
        length = piece_length(q, len(self.keys), self.keys.shape[1] * q[:, 0].numel())
        out = []
        for tokens, keys in zip(torch.split(self.tokens, length), torch.split(self.keys, length), strict=True):
            tiles = _tiled(q, tokens), _tiled(k, keys), _tiled(v, keys)
            h = attention(*tiles, self.mask)
            out.append(h.transpose(1, 2).reshape(len(v), -1, *v.shape[2:]))
        return _pick(torch.cat(out, 1), self.place)


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q k^T) v of (B, heads, n, D) and (B, heads, m, D), scaled already, where ``mask`` (n, m) is true."""
    if q.device.type != "cpu" or not torch.is_grad_enabled():
        return F.scaled_dot_product_attention(q, k, v, mask, scale=1.0)
    # For so few keys the backward pass of the fused product is the slower one on a CPU, by far in bfloat16.
    scores = q @ k.transpose(-1, -2)
    scores = scores if mask is None else scores.masked_fill(~mask, -torch.inf)
    return scores.softmax(-1).to(v.dtype) @ v


def _tiled(x: Tensor, index: Tensor) -> Tensor:
    """The tokens (tiles, n) of x (B, N, heads, D) as (B tiles, heads, n, D)."""
    return _pick(x, index.flatten()).reshape(-1, index.shape[1], *x.shape[2:]).transpose(1, 2)


def _pick(x: Tensor, index: Tensor) -> Tensor:
    """The tokens (n,) of x (B, N, ...) as (B, n, ...)."""
    # One index over all rows: its gradient is several times as fast on a CPU as that along dimension 1.
    rows = index + x.shape[1] * torch.arange(len(x), device=x.device)[:, None]
    return x.flatten(0, 1).index_select(0, rows.flatten()).reshape(*rows.shape, *x.shape[2:])


def _divisor(size: int, limit: int) -> int:
    """The largest divisor of ``size`` up to ``limit``."""
    return next(n for n in range(min(size, limit), 0, -1) if size % n == 0)


def _surround(x: Tensor, window: Grid) -> Tensor:
    """(H, W) with the margin that makes all windows alike; see the module's docstring."""
    m, n = window[0] // 2, window[1] // 2
    rows, columns = x.shape
    x = torch.cat((x[m + 1 : 2 * m + 1], x, x[rows - 2 * m - 1 : rows - m - 1]))
    return torch.cat((x[:, columns - n :], x, x[:, :n]), 1)


def _tiles(x: Tensor, size: Grid, step: Grid) -> Tensor:
    """(H, W) to (tiles, rows columns), overlapping where ``size`` is larger than ``step``."""
    return x.unfold(0, size[0], step[0]).unfold(1, size[1], step[1]).flatten(2).flatten(0, 1)


def _near(tile: Grid, window: Grid) -> Tensor:
    """(n, m) whether a key of a tile's span lies in the window of a query."""
    axes = []
    for size, reach in zip(tile, window, strict=True):
        offset = torch.arange(size + reach - 1, device="cpu") - torch.arange(size, device="cpu")[:, None]
        axes.append((offset >= 0) & (offset < reach))
    return (axes[0][:, None, :, None] & axes[1][None, :, None, :]).flatten(2).flatten(0, 1)
