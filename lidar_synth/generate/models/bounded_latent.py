"""What the autoencoders of the town have in common: an encoder on patches, and latents that are
bounded.

The latent lies in (-1, 1) in place of a codebook, and the decoder is trained on noisy latents, so
that it tolerates the errors of a flow. Every norm is over the channels of one cell, so that crops
(in training) and full turns (in use) give the same result.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.codebook import follow
from lidar_synth.generate.models.convolution import WrapConv, check_shape
from lidar_synth.generate.models.layers import rms_norm
from lidar_synth.generate.models.network import Network


class NormedResidual(nn.Module):
    """x + conv(silu(conv(norm(x)))).

    Args:
        channels: C.
        reach: dilation of the second convolution, in columns.
    """

    def __init__(self, channels: int, reach: int = 1) -> None:
        super().__init__()
        self.first = WrapConv(channels, channels)
        self.second = WrapConv(channels, channels, dilation=(1, reach))
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        normed = rms_norm(x.movedim(1, -1)).movedim(-1, 1)
        out: Tensor = x + self.second(F.silu(self.first(normed)))
        return out


class BoundedAutoencoder(Network, ABC):
    """Images (B, C, H, W) to latents and back. A subclass calls ``add_encoder``, and has ``embed``
    and ``expand``."""

    is_autoencoder: ClassVar[bool] = True

    channels: int
    resolution: tuple[int, int]
    shift: Tensor
    scale: Tensor

    def add_encoder(
        self, stem: nn.Module, widths: Sequence[int], rows: int, depth: int, latent_channels: int
    ) -> None:
        """Add the modules of the encoder.

        Args:
            stem: of the patches.
            widths: channels on patches and on latent cells.
            rows: of patches.
            depth: residual blocks on latent cells.
            latent_channels: Z.
        """
        outer, inner = widths
        # A learned bias by row: on a road, a beam's elevation gives its range.
        self.place_stem = row_bias(outer, rows)
        self.stem = stem
        self.encode_outer = NormedResidual(outer)
        self.merge = nn.Conv2d(outer, inner, 2, 2)
        self.encode_inner = nn.Sequential(*(NormedResidual(inner) for _ in range(depth)))
        self.to_latent = nn.Conv2d(inner, latent_channels, 1)
        # Latents have mean 0 and variance 1 per channel, as a flow from standard normal noise
        # needs.
        self.register_buffer("shift", torch.zeros(latent_channels))
        self.register_buffer("scale", torch.ones(latent_channels))

    @abstractmethod
    def embed(self, x: Tensor) -> Tensor:
        """Images with a channel of their returns, (B, C + 1, H, W), to patches (B, widths[0], rows,
        columns)."""

    @abstractmethod
    def expand(self, z: Tensor, image: Tensor) -> Any:
        """Bounded latents (B, *latent_shape) to the distributions of the cells; a decoder may
        predict some of them from other cells of the image (B, C, H, W)."""

    def forward(self, x: Tensor, noise: Tensor) -> Any:
        """Encodes images (B, C, H, W) and expands them with ``noise`` (B, *latent_shape) added to
        the bounded latents; in training mode, updates the running statistics of the latents."""
        z = self.squeeze(x)
        if self.training:
            follow(z.detach(), self.shift, self.scale)
        return self.expand(z + noise, x)

    def encoder(self) -> list[nn.Parameter]:
        """The weights of the encoder; all others belong to the decoder."""
        parts = self.stem, self.encode_outer, self.merge, self.encode_inner, self.to_latent
        return [self.place_stem, *(weight for part in parts for weight in part.parameters())]

    def squeeze(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) to bounded latents in (-1, 1), float32."""
        check_shape(x, (self.channels, *self.resolution), "an image")
        x = x.to(self.place_stem.dtype)
        h = self.embed(torch.cat([x, (x[:, :1] > -1).to(x.dtype)], 1))
        h = self.encode_outer(h + self.place_stem)
        return torch.tanh(self.to_latent(self.encode_inner(self.merge(h))).float())

    def encode(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) in [-1, 1], range -1 = no return, to latents (B, *latent_shape) of
        mean 0 and variance 1 per channel."""
        return (self.squeeze(x) - _channel(self.shift)) / _channel(self.scale)

    def bounded(self, z: Tensor) -> Tensor:
        """Normalised latents (B, *latent_shape) back to the bounded ones of ``squeeze``."""
        return z * _channel(self.scale) + _channel(self.shift)


def row_bias(channels: int, rows: int) -> nn.Parameter:
    """(1, C, rows, 1), the same in all columns."""
    return nn.Parameter(torch.zeros(1, channels, rows, 1))


def _channel(x: Tensor) -> Tensor:
    """(Z,) as (1, Z, 1, 1)."""
    return x.view(1, -1, 1, 1)
