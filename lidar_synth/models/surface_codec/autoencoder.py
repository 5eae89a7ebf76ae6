"""Autoencoder of dense range images that two CPU cores can train and decode.

An image (C, H, W) in [-1, 1] becomes a latent (Z, H / 4, W / 16) in (-1, 1). The latent is bounded and the decoder is
trained on noisy latents, so that it tolerates the errors of a flow. Every norm is over the channels of one cell. The
decoder works on patches of 2 x 8 cells and predicts what the cells of a patch can show (``surfaces``); only the last
linear layer knows single cells, which makes it cheap.
"""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.normalize import NORMALISATIONS
from lidar_synth.models.codebook import follow
from lidar_synth.models.convolution import check_shape, pair, reduced
from lidar_synth.models.network import Network
from lidar_synth.models.surface_codec.blocks import Block, cell_norm, from_patches, split, to_patches
from lidar_synth.models.surface_codec.surfaces import DRAWS, NUMBERS, PER_CELL, Noise, Surfaces, surfaces_of
from lidar_synth.models.town_codec.autoencoder import Residual

PATCH = (2, 8)
"""Rows and columns of a patch."""
DOWN = (4, 16)
"""Rows and columns of one latent cell."""


class SurfaceAutoencoder(Network):
    """Images to latents and back.

    Args:
        resolution: H, W of the image, multiples of 4 and 16.
        channels: C of the image: range, reflectance, then ``bits``.
        bits: channels of the image that are an analog code (``normalize.encode_labels``).
        codes: how many codes there are.
        latent_channels: Z.
        encoder_widths: channels of the encoder on patches and on latent cells.
        widths: channels of the decoder on patches and on latent cells.
        reaches: dilations of the decoder's blocks on latent cells, since a wall is straight over many of them.
        depth: blocks of the decoder on patches.
        surfaces: K of a patch.
        normalisation: a name of ``NORMALISATIONS``, that of the range.

    Raises:
        ConfigError: on values that do not fit together.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "channels", "normalisation")
    is_autoencoder: ClassVar[bool] = True

    shift: Tensor
    scale: Tensor
    roughness: Tensor
    alike: Tensor
    returned_alike: Tensor

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 7,
        bits: int = 5,
        codes: int = 20,
        latent_channels: int = 8,
        encoder_widths: Sequence[int] = (48, 96),
        widths: Sequence[int] = (64, 128),
        reaches: Sequence[int] = (1, 1, 2, 4, 8),
        depth: int = 2,
        surfaces: int = 3,
        normalisation: str = "r2flow",
    ) -> None:
        super().__init__()
        if channels != 2 + bits or not 2**bits >= codes > 1 or normalisation not in NORMALISATIONS:
            raise ConfigError(
                f"{channels} channels, {codes} codes in {bits} bits, normalisation {normalisation!r}",
                f"range, reflectance and enough bits for the codes; one of {', '.join(NORMALISATIONS)}",
            )
        if any(not 1 <= reach <= pair(resolution)[1] // DOWN[1] for reach in reaches):
            raise ConfigError(f"reaches {list(reaches)}", f"columns of a latent, from 1 to {resolution[1] // DOWN[1]}")
        self.resolution, self.channels, self.bits, self.codes = pair(resolution), channels, bits, codes
        self.surfaces, self.normalisation = surfaces, NORMALISATIONS[normalisation]
        self.latent_shape = (latent_channels, *reduced(self.resolution, [DOWN], "an image"))
        """Channels, rows and columns of a latent."""
        self.draws = DRAWS
        """Random numbers per cell that sampling an image takes."""
        self.widths = tuple(self.resolution[1] // merged for merged in (1, 2))
        """Columns that images can be decoded to."""
        cells, rows, (outer, inner) = PATCH[0] * PATCH[1], self.resolution[0], widths
        # Learned biases by row: on a road, a beam's elevation gives its range.
        self.place_stem = _rows(encoder_widths[0], rows // PATCH[0])
        self.place_latent, self.place_outer = _rows(inner, rows // DOWN[0]), _rows(outer, rows // PATCH[0])
        # Not a convolution: oneDNN's with this kernel and stride gives wrong values in bfloat16 (torch 2.13).
        self.stem = nn.Linear((channels + 1) * cells, encoder_widths[0])
        self.encode_outer = Residual(encoder_widths[0])
        self.merge = nn.Conv2d(encoder_widths[0], encoder_widths[1], 2, 2)
        self.encode_inner = nn.Sequential(*(Residual(encoder_widths[1]) for _ in range(2)))
        self.to_latent = nn.Conv2d(encoder_widths[1], latent_channels, 1)
        self.from_latent = nn.Conv2d(latent_channels, inner, 1)
        self.decode_inner = nn.Sequential(*(Block(inner, reach) for reach in reaches))
        self.split = nn.Conv2d(inner, 4 * outer, 1)
        self.decode_outer = nn.Sequential(*(Block(outer) for _ in range(depth)))
        self.head = nn.Linear(outer, surfaces * (NUMBERS + codes) + cells * (surfaces + PER_CELL))
        with torch.no_grad():  # starts near and far, facing the sensor, with a wide scale
            self.head.weight.mul_(0.5)
            start = self.head.bias.zero_()[: surfaces * (NUMBERS + codes)].view(surfaces, -1)
            start[:, 0] = torch.linspace(1.2, 4.0, surfaces + 2)[1:-1]
            start[:, 3], start[:, 6] = -3, -1.5
        # Latents have mean 0 and variance 1 per channel, as a flow from standard normal noise needs.
        self.register_buffer("shift", torch.zeros(latent_channels))
        self.register_buffer("scale", torch.ones(latent_channels))
        # As ``measure_noise`` finds them in scans.
        self.register_buffer("roughness", torch.full((codes,), 0.1))
        self.register_buffer("alike", torch.zeros(codes))
        self.register_buffer("returned_alike", torch.zeros(()))

    def forward(self, x: Tensor, noise: Tensor) -> Surfaces:
        """Encodes images (B, C, H, W) and decodes them with ``noise`` (B, *latent_shape) added to the bounded latents;
        in training mode, updates the running statistics of the latents."""
        z = self.squeeze(x)
        if self.training:
            follow(z.detach(), self.shift, self.scale)
        return self.expand(z + noise)

    @property
    def noise(self) -> Noise:
        """The noise of sampled cells."""
        return Noise(self.roughness, self.alike, self.returned_alike)

    def encoder(self) -> list[nn.Parameter]:
        """The weights of the encoder; all others belong to the decoder."""
        parts = self.stem, self.encode_outer, self.merge, self.encode_inner, self.to_latent
        return [self.place_stem, *(weight for part in parts for weight in part.parameters())]

    def squeeze(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) to bounded latents in (-1, 1), float32."""
        check_shape(x, (self.channels, *self.resolution), "an image")
        x = x.to(self.stem.weight.dtype)
        returned = (x[:, :1] > -1).to(x.dtype)
        patches = to_patches(torch.cat([x, returned], 1), PATCH).flatten(1)
        rows, columns = self.resolution[0] // PATCH[0], self.resolution[1] // PATCH[1]
        h = self.stem(patches).unflatten(0, (-1, rows, columns)).movedim(-1, 1)
        h = self.encode_outer(h + self.place_stem)
        return torch.tanh(self.to_latent(self.encode_inner(self.merge(h))).float())

    def expand(self, z: Tensor, image: Tensor | None = None, merged: int = 1) -> Surfaces:
        """Bounded latents (B, *latent_shape) to the surfaces of all patches, N = B H W / 16 row by row; they do not
        depend on the image. ``merged`` columns become one."""
        z = z.to(self.from_latent.weight.dtype).contiguous(memory_format=torch.channels_last)
        h = self.decode_inner(self.from_latent(z) + self.place_latent)
        h = self.decode_outer(split(self.split(h), (2, 2)) + self.place_outer)
        numbers = self.head(cell_norm(h).movedim(1, -1).flatten(0, 2))
        return surfaces_of(numbers, self.surfaces, self.codes, PATCH, merged)

    def encode(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) in [-1, 1], range -1 = no return, to latents (B, *latent_shape) of mean 0 and variance 1
        per channel."""
        return (self.squeeze(x) - _channel(self.shift)) / _channel(self.scale)

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents to images.

        Args:
            z: (B, *latent_shape).
            uniform_noise: (B, draws, H, W') numbers in (0, 1) to sample an image with; None = the most likely image. W'
                is one of ``widths``, and becomes the width of the image.

        Returns:
            (B, C, H, W'): range -1 where there is no return; bits as logits of the most likely code, whose magnitude
            grows with its probability.
        """
        check_shape(z, self.latent_shape, "a latent")
        rows, columns = self.resolution if uniform_noise is None else uniform_noise.shape[-2:]
        if uniform_noise is None:
            uniform_noise = torch.full((len(z), DRAWS, rows, columns), 0.5, device=z.device)
        if columns not in self.widths:
            raise DataError(f"noise for {columns} columns", f"one of {', '.join(map(str, self.widths))}")
        merged = self.resolution[1] // columns
        patch = PATCH[0], PATCH[1] // merged
        surfaces = self.expand(self.bounded(z), merged=merged)
        cells = surfaces.sample(to_patches(uniform_noise, patch), self.noise, self.normalisation)
        distance, value, code, likely = torch.split(from_patches(cells, patch, (rows, columns)), 1, 1)
        bits = torch.cat([(code.long() >> b & 1) * 2.0 - 1.0 for b in reversed(range(self.bits))], 1)
        return torch.cat([distance, value, bits * (2 * torch.atanh(likely.clamp(max=0.9999)))], 1)

    def bounded(self, z: Tensor) -> Tensor:
        """Normalised latents (B, *latent_shape) back to the bounded ones of ``squeeze``."""
        return z * _channel(self.scale) + _channel(self.shift)


def _rows(channels: int, rows: int) -> nn.Parameter:
    """(1, C, rows, 1), the same in all columns."""
    return nn.Parameter(torch.zeros(1, channels, rows, 1))


def _channel(x: Tensor) -> Tensor:
    """(Z,) as (1, Z, 1, 1)."""
    return x.view(1, -1, 1, 1)
