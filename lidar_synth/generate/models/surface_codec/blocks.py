"""Convolutional blocks over maps (B, C, H, W) with the memory format channels last, whose columns
wrap around."""

import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import WrapConv, fold, to_tokens, unfold
from lidar_synth.generate.models.layers import cell_norm

PATCH = (2, 8)
"""Rows and columns of a patch."""


class Block(nn.Module):
    """x + linear(silu(conv(norm(x)))), where the norm is over the channels of one cell.

    Args:
        channels: C.
        reach: dilation of the convolution, in columns.
    """

    def __init__(self, channels: int, reach: int = 1) -> None:
        super().__init__()
        self.near = WrapConv(channels, channels, dilation=(1, reach))
        self.mix = nn.Conv2d(channels, channels, 1)
        nn.init.zeros_(self.mix.weight)
        nn.init.zeros_(self.mix.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        out: Tensor = x + self.mix(F.silu(self.near(cell_norm(x))))
        return out


def split(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, P C, h, w), P cells of a patch first, to (B, C, h rows, w columns)."""
    batch, _, h, w = x.shape
    x = x.movedim(1, -1).reshape(batch, h, w, *patch, -1).transpose(2, 3)
    return x.reshape(batch, h * patch[0], w * patch[1], -1).movedim(-1, 1)


def to_patches(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, C, H, W) to (N, C, P), all patches of all images row by row, P = rows * columns."""
    return to_tokens(fold(x, patch)).reshape(-1, x.shape[1], patch[0] * patch[1])


def from_patches(
    x: Tensor, patch: tuple[int, int], resolution: tuple[int, int]
) -> Tensor:
    """The inverse of ``to_patches``."""
    rows = resolution[0] // patch[0]
    columns = resolution[1] // patch[1]
    cells = x.reshape(-1, rows, columns, x.shape[1] * x.shape[2])
    return unfold(cells.movedim(-1, 1), patch)
