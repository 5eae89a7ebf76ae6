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


def split(x: Tensor, rows: int, columns: int) -> Tensor:
    """(B, h, w, rows * columns * C) to (B, h * rows, w * columns, C)."""
    batch, h, w, _ = x.shape
    x = x.reshape(batch, h, w, rows, columns, -1).transpose(2, 3)
    return x.reshape(batch, h * rows, w * columns, -1)


def merge(x: Tensor, rows: int, columns: int) -> Tensor:
    """The inverse of ``split``."""
    batch, h, w, _ = x.shape
    x = x.reshape(batch, h // rows, rows, w // columns, columns, -1).transpose(2, 3)
    return x.reshape(batch, h // rows, w // columns, -1)
