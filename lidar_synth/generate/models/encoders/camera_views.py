"""Encoder of camera images that are cut into views side by side: convolutions turn each view into
tokens."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import check_shape, halve, pair, reduced
from lidar_synth.generate.models.network import Encoder


class ViewEncoder(Encoder):
    """Encodes a camera image, cut into views side by side, as tokens; a small network for training
    from scratch.

    Args:
        resolution: h, w of the image; with four convolutions, h is a multiple of 16 and w of 16
            times ``views``.
        views: number of views.
        channels: channels of a token.
        widths: channels of the convolutions, each of which halves rows and columns.
    """

    condition: ClassVar[str] = "camera"
    argument: ClassVar[str] = "context_channels"

    def __init__(
        self,
        resolution: Sequence[int] = (96, 320),
        views: int = 4,
        channels: int = 128,
        widths: Sequence[int] = (32, 64, 96, 128),
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.channels = channels
        self.views = views
        grid = reduced(
            self.resolution,
            [(1, views)] + [(2, 2)] * len(widths),
            f"an image of {views} views",
        )
        self.body = halve(widths)
        self.place = nn.Parameter(torch.empty(widths[-1], *grid))
        self.view_embedding = nn.Parameter(torch.empty(views, 1, widths[-1]))
        nn.init.trunc_normal_(self.place, std=0.02)
        nn.init.trunc_normal_(self.view_embedding, std=0.02)
        self.project = nn.Linear(widths[-1], channels)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, h, w) uint8 to (B, tokens, channels).

        Raises:
            DataError: on another size.
        """
        check_shape(image, (3, *self.resolution), "a camera image")
        x = split_views(image, self.views).to(self.project.weight.dtype) / 127.5 - 1
        x = self.body(x.contiguous(memory_format=torch.channels_last)) + self.place
        x = x.flatten(2).transpose(1, 2)  # (B views, N, C)
        x = x.reshape(-1, self.views, *x.shape[1:]) + self.view_embedding
        out: Tensor = self.project(x.flatten(1, 2))
        return out


def split_views(image: Tensor, views: int) -> Tensor:
    """(B, 3, h, w) to (B views, 3, h, w / views), views from left to right."""
    batch, channels, rows, columns = image.shape
    return (
        image.reshape(batch, channels, rows, views, columns // views)
        .movedim(3, 1)
        .flatten(0, 1)
    )
