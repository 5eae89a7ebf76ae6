"""An encoder on patches whose latents are bounded, and how it is trained.

The latent lies in (-1, 1) in place of a codebook, and the decoder is trained on noisy latents, so
that it tolerates the errors of a flow. Every norm is over the channels of one cell, so that crops
(in training) and full turns (in use) give the same result.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.generate.models.codebook import follow
from lidar_synth.generate.models.convolution import WrapConv, check_shape
from lidar_synth.generate.models.layers import cell_norm
from lidar_synth.generate.models.network import Autoencoder
from lidar_synth.generate.models.objective import Objective
from lidar_synth.geometry.normalize import encode_labels


class NormedResidual(nn.Module):
    """x + conv(silu(conv(norm(x)))) on C channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = WrapConv(channels, channels)
        self.second = WrapConv(channels, channels)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        out: Tensor = x + self.second(F.silu(self.first(cell_norm(x))))
        return out


class BoundedAutoencoder(Autoencoder):
    """Images (B, C, H, W) to latents and back. A subclass calls ``add_encoder``, and has ``embed``,
    ``expand`` and ``nll``.

    Attributes:
        bits: channels of the image that are an analog code of the label, the last ones.
    """

    bits: int

    def add_encoder(
        self,
        stem: nn.Module,
        widths: Sequence[int],
        rows: int,
        depth: int,
        latent_channels: int,
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
        self.encode_inner = nn.Sequential(
            *(NormedResidual(inner) for _ in range(depth))
        )
        self.to_latent = nn.Conv2d(inner, latent_channels, 1)
        self.add_scale(latent_channels)

    @abstractmethod
    def embed(self, x: Tensor) -> Tensor:
        """Images with a channel of their returns, (B, C + 1, H, W), to patches (B, widths[0], rows,
        columns)."""

    @abstractmethod
    def expand(self, z: Tensor) -> Any:
        """Bounded latents (B, *latent_shape) to the distributions of the cells."""

    @abstractmethod
    def nll(self, predicted: Any, x: Tensor, objective: Objective) -> Tensor:
        """The negative log-likelihood of images (B, C, H, W) under the predicted distributions, a
        scalar."""

    def forward(self, x: Tensor, noise: Tensor) -> Any:
        """Encodes images (B, C, H, W) and expands them with ``noise`` (B, *latent_shape) added to
        the bounded latents; in training mode, updates the running statistics of the latents."""
        z = self.squeeze(x)
        if self.training:
            follow(z.detach(), self.shift, self.scale)
        return self.expand(z + noise)

    def loss(self, x: Tensor, noise: Tensor, objective: Objective) -> Tensor:
        """The negative log-likelihood of images (B, C, H, W) from their latents with noise, a
        scalar; a share of the images (``Losses.unlabelled``) is encoded without labels."""
        shape = self.latent_shape
        latent_noise = noise.flatten(1)[:, : math.prod(shape)].reshape(-1, *shape)
        shown = x
        if objective.losses.unlabelled:
            blank = encode_labels(torch.full_like(x[:, 0], IGNORE, dtype=torch.uint8))
            hidden = torch.cat([x[:, : -self.bits], blank.to(x)], 1)
            chosen = (
                torch.special.ndtr(noise[:, -1, -1, -1]) < objective.losses.unlabelled
            )
            shown = torch.where(chosen.view(-1, 1, 1, 1), hidden, x)
        return self.nll(
            self(shown, objective.losses.noise * latent_noise), x, objective
        )

    def decoder_loss(self, z: Tensor, x: Tensor, objective: Objective) -> Tensor:
        """The negative log-likelihood of images (B, C, H, W) from given latents (B, *latent_shape),
        a scalar."""
        return self.nll(self.expand(self.bounded(z)), x, objective)

    def encoder(self) -> list[nn.Parameter]:
        """The weights of the encoder; all others belong to the decoder."""
        parts = (
            self.stem,
            self.encode_outer,
            self.merge,
            self.encode_inner,
            self.to_latent,
        )
        return [
            self.place_stem,
            *(weight for part in parts for weight in part.parameters()),
        ]

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
        return self.normed(self.squeeze(x))


def row_bias(channels: int, rows: int) -> nn.Parameter:
    """(1, C, rows, 1), the same in all columns."""
    return nn.Parameter(torch.zeros(1, channels, rows, 1))
