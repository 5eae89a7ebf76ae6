"""A small range-view segmenter: per-cell classes of a range image, and features for comparing sets
of scans.

It is a U-Net with circular padding of columns. It serves to evaluate scans (do generated labels
agree with the predictions of a segmenter trained on other scans?) and as the reference trainer's
network; it is not tuned for benchmarks.
"""

from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.datasets.classes import NAMES

ROW_BANDS = 4
"""Bands of rows over which features are averaged separately, so that high and low objects are
distinguished."""


class _Wrapped(torch.autograd.Function):
    """Circular padding by one column on each side; a third of the time of
    ``F.pad(mode="circular")`` on a CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return torch.cat([x[..., -1:], x, x[..., :1]], -1)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        [grad] = grads
        inner = grad[..., 1:-1].clone(memory_format=torch.preserve_format)
        inner[..., -1] += grad[..., 0]
        inner[..., 0] += grad[..., -1]
        return inner


class CircularConv(nn.Module):
    """3 x 3 convolution, norm and ReLU, with circular padding of columns and zero padding of
    rows."""

    def __init__(
        self, inputs: int, outputs: int, stride: tuple[int, int] = (1, 1)
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, padding=(1, 0), bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        padded: Tensor = _Wrapped.apply(x)  # type: ignore[no-untyped-call]
        out: Tensor = F.relu(self.norm(self.conv(padded)))
        return out


class RangeSegmenter(nn.Module):
    """Predicts the class of every cell of a range image.

    Args:
        classes: number of classes.
        widths: channels per level. Every level after the first halves the columns, and from the
            third on the rows too.
    """

    def __init__(
        self,
        classes: int = len(NAMES),
        widths: tuple[int, ...] = (16, 32, 64, 96),
    ) -> None:
        super().__init__()
        widths = tuple(widths)
        self.strides = [(1, 2)] + [(2, 2)] * (len(widths) - 2)
        self.stem = CircularConv(4, widths[0])
        self.down = nn.ModuleList(
            nn.Sequential(CircularConv(a, b, s), CircularConv(b, b))
            for (a, b), s in zip(pairwise(widths), self.strides, strict=True)
        )
        self.up = nn.ModuleList(CircularConv(a + b, a) for a, b in pairwise(widths))
        self.head = nn.Conv2d(widths[0], classes, 1)

    def decode(self, x: Tensor) -> Tensor:
        """(B, 4, H, W) to the decoder's last feature map (B, widths[0], H, W)."""
        skips = [self.stem(x)]
        for level in self.down:
            skips.append(level(skips[-1]))
        x = skips.pop()
        for level, skip in zip(reversed(self.up), reversed(skips), strict=True):
            x = level(torch.cat([skip, F.interpolate(x, size=skip.shape[2:])], 1))
        return x

    def forward(self, x: Tensor) -> Tensor:
        """(B, 4, H, W) to logits (B, classes, H, W)."""
        logits: Tensor = self.head(self.decode(x))
        return logits

    def features(self, x: Tensor) -> Tensor:
        """(B, 4, H, W) to (B, ROW_BANDS * widths[0]) means of the decoder's last feature
        map over bands of rows."""
        return F.adaptive_avg_pool2d(self.decode(x), (ROW_BANDS, 1)).flatten(1)


def segmenter_input(distance: Tensor, reflectance: Tensor, height: Tensor) -> Tensor:
    """Input of the segmenter from a batch of range images, with values of order one.

    Args:
        distance: (B, H, W) metres, 0 = no return.
        reflectance: (B, H, W) in [0, 1].
        height: (H, W) sine of each cell's elevation, z of the sensor's rays; on the device of the
            input.

    Returns:
        (B, 4, H, W): log2(1 + d) / 6, z / 2, reflectance, and 1 where there is a return.
    """
    distance = distance.to(height.device)
    reflectance = reflectance.to(height.device)
    returned = (distance > 0).to(distance.dtype)
    return torch.stack(
        [
            torch.log2(1 + distance) / 6,
            distance * height / 2,
            reflectance * returned,
            returned,
        ],
        1,
    )
