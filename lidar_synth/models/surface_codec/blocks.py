"""Convolutional blocks over maps (B, C, H, W) with the memory format channels last, whose columns wrap around."""

import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.models.convolution import WrapConv
from lidar_synth.models.layers import EPS


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


def cell_norm(x: Tensor) -> Tensor:
    """RMS norm over the channels of each cell of (B, C, H, W)."""
    return F.rms_norm(x.movedim(1, -1), x.shape[1:2], eps=EPS).movedim(-1, 1)


def split(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, P C, h, w), P cells of a patch first, to (B, C, h rows, w columns)."""
    rows, columns = patch
    x = x.movedim(1, -1).unflatten(-1, (rows, columns, -1)).transpose(2, 3)
    return x.flatten(3, 4).flatten(1, 2).movedim(-1, 1)


def to_patches(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, C, H, W) to (N, C, P), all patches of all images row by row, P = rows * columns."""
    x = x.unflatten(3, (-1, patch[1])).unflatten(2, (-1, patch[0]))
    return x.permute(0, 2, 4, 1, 3, 5).flatten(0, 2).flatten(2)


def from_patches(x: Tensor, patch: tuple[int, int], resolution: tuple[int, int]) -> Tensor:
    """The inverse of ``to_patches``."""
    rows, columns = resolution[0] // patch[0], resolution[1] // patch[1]
    x = x.unflatten(2, patch).unflatten(0, (-1, rows, columns))
    return x.permute(0, 3, 1, 4, 2, 5).flatten(4).flatten(2, 3)
