"""Convolutional blocks over maps (B, C, H, W) with the memory format channels last, whose columns
wrap around."""

import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import WrapConv
from lidar_synth.generate.models.layers import rms_norm

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


def cell_norm(x: Tensor) -> Tensor:
    """RMS norm over the channels of each cell of (B, C, H, W)."""
    return rms_norm(x.movedim(1, -1)).movedim(-1, 1)


def split(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, P C, h, w), P cells of a patch first, to (B, C, h rows, w columns)."""
    batch, _, h, w = x.shape
    x = x.movedim(1, -1).reshape(batch, h, w, *patch, -1).transpose(2, 3)
    return x.reshape(batch, h * patch[0], w * patch[1], -1).movedim(-1, 1)


def to_patches(x: Tensor, patch: tuple[int, int]) -> Tensor:
    """(B, C, H, W) to (N, C, P), all patches of all images row by row, P = rows * columns."""
    batch, channels, height, width = x.shape
    x = x.reshape(
        batch, channels, height // patch[0], patch[0], width // patch[1], patch[1]
    )
    return x.permute(0, 2, 4, 1, 3, 5).reshape(-1, channels, patch[0] * patch[1])


def from_patches(
    x: Tensor, patch: tuple[int, int], resolution: tuple[int, int]
) -> Tensor:
    """The inverse of ``to_patches``."""
    rows = resolution[0] // patch[0]
    columns = resolution[1] // patch[1]
    x = x.reshape(-1, rows, columns, x.shape[1], *patch)
    return x.permute(0, 3, 1, 4, 2, 5).reshape(len(x), -1, *resolution)
