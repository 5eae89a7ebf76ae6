"""Autoencoder of dense range images that two CPU cores can train and decode.

An image (C, H, W) in [-1, 1] becomes a latent (Z, H / 4, W / 16) in (-1, 1). The decoder works on
patches of 2 x 8 cells and predicts the surfaces that the cells of a patch can show (surfaces.py).
It is cheap, because only its last linear layer works on single cells.
"""

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models.bounded_latent import BoundedAutoencoder, row_bias
from lidar_synth.generate.models.convolution import check_shape, pair, reduced
from lidar_synth.generate.models.layers import cell_norm
from lidar_synth.generate.models.objective import Objective
from lidar_synth.generate.models.surface_codec.blocks import (
    PATCH,
    Block,
    from_patches,
    split,
    to_patches,
)
from lidar_synth.generate.models.surface_codec.bounds import bounds_of, codes_of
from lidar_synth.generate.models.surface_codec.measure_noise import Seen, measure_noise
from lidar_synth.generate.models.surface_codec.planes import share_planes
from lidar_synth.generate.models.surface_codec.relief import SPANS, relief_fields
from lidar_synth.generate.models.surface_codec.surfaces import (
    DRAWS,
    NUMBERS,
    PER_CELL,
    Noise,
    Surfaces,
    surfaces_of,
)
from lidar_synth.geometry.normalize import NORMALISATIONS

DOWN = (4, 16)
"""Rows and columns of one latent cell."""


class SurfaceAutoencoder(BoundedAutoencoder):
    """Images to latents and back.

    Args:
        resolution: H, W of the image, multiples of 4 and 16.
        channels: C of the image: range, reflectance, then ``bits``.
        bits: channels of the image that are an analog code (``normalize.encode_labels``).
        codes: number of codes.
        latent_channels: Z.
        encoder_widths: channels of the encoder on patches and on latent cells.
        widths: channels of the decoder on patches and on latent cells.
        reaches: dilations of the decoder's blocks on latent cells; large ones, since walls are
            straight over many cells.
        depth: blocks of the decoder on patches.
        surfaces: K of a patch, at most 4.
        normalisation: a name of ``NORMALISATIONS``, that of the range.

    Raises:
        ConfigError: on values that do not fit together.
    """

    decodes_given: ClassVar[frozenset[str]] = frozenset({"layout", "semantic"})
    derived_arguments: ClassVar[tuple[str, ...]] = (
        "resolution",
        "channels",
        "normalisation",
    )

    roughness: Tensor
    relief: Tensor
    alike: Tensor

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
        if (
            channels != 2 + bits
            or not 2**bits >= codes > 1
            or normalisation not in NORMALISATIONS
        ):
            raise ConfigError(
                f"{channels} channels, {codes} codes in {bits} bits, normalisation "
                f"{normalisation!r}",
                "channels range, reflectance, label, with bits for 2 or more codes; one of "
                f"{', '.join(NORMALISATIONS)}",
            )
        # a patch of half the columns has a shared number for each in a row
        if not 1 <= surfaces <= PATCH[1] // 2:
            raise ConfigError(f"{surfaces} surfaces", f"1 to {PATCH[1] // 2}")
        if any(not 1 <= reach <= pair(resolution)[1] // DOWN[1] for reach in reaches):
            raise ConfigError(
                f"reaches {list(reaches)}",
                f"columns of a latent, from 1 to {resolution[1] // DOWN[1]}",
            )
        self.resolution = pair(resolution)
        self.channels = channels
        self.bits = bits
        self.codes = codes
        self.surfaces = surfaces
        self.normalisation = NORMALISATIONS[normalisation]
        self.latent_shape = (
            latent_channels,
            *reduced(self.resolution, [DOWN], "an image"),
        )
        """Channels, rows and columns of a latent."""
        self.draws = DRAWS
        """Random numbers per cell that sampling an image takes."""
        self.widths = tuple(self.resolution[1] // merged for merged in (1, 2))
        """Columns that images can be decoded to."""
        cells = PATCH[0] * PATCH[1]
        rows = self.resolution[0]
        outer, inner = widths
        # Not a convolution: oneDNN's with this kernel and stride gives wrong values in bfloat16
        # (torch 2.13).
        stem = nn.Linear((channels + 1) * cells, encoder_widths[0])
        self.add_encoder(stem, encoder_widths, rows // PATCH[0], 2, latent_channels)
        self.place_latent = row_bias(inner, rows // DOWN[0])
        self.place_outer = row_bias(outer, rows // PATCH[0])
        self.from_latent = nn.Conv2d(latent_channels, inner, 1)
        self.decode_inner = nn.Sequential(*(Block(inner, reach) for reach in reaches))
        self.split = nn.Conv2d(inner, 4 * outer, 1)
        self.decode_outer = nn.Sequential(*(Block(outer) for _ in range(depth)))
        self.head = nn.Linear(
            outer, surfaces * (NUMBERS + codes) + cells * (surfaces + PER_CELL)
        )
        # starts near and far, facing the sensor, with a wide scale
        with torch.no_grad():
            self.head.weight.mul_(0.5)
            start = self.head.bias.zero_()[: surfaces * (NUMBERS + codes)].view(
                surfaces, -1
            )
            start[:, 0] = torch.linspace(1.2, 4.0, surfaces + 2, device="cpu")[1:-1]
            start[:, 3] = -3
            start[:, 6] = -1.5
        # As ``measure_noise`` finds them in scans.
        self.register_buffer("roughness", torch.full((codes,), 0.1))
        self.register_buffer("relief", torch.zeros(codes, len(SPANS)))
        self.register_buffer("alike", torch.zeros(codes))

    @property
    def noise(self) -> Noise:
        """The noise of sampled cells."""
        return Noise(self.roughness, self.relief, self.alike)

    def embed(self, x: Tensor) -> Tensor:
        """Images with a channel of their returns, (B, C + 1, H, W), to patches of 2 x 8 cells."""
        rows = self.resolution[0] // PATCH[0]
        columns = self.resolution[1] // PATCH[1]
        patches: Tensor = self.stem(to_patches(x, PATCH).flatten(1))
        return patches.view(len(x), rows, columns, -1).movedim(-1, 1)

    def expand(self, z: Tensor, merged: int = 1) -> Surfaces:
        """Bounded latents (B, *latent_shape) to the surfaces of all patches, N = B H W / 16 row by
        row; ``merged`` columns become one."""
        z = z.to(self.from_latent.weight.dtype).contiguous(
            memory_format=torch.channels_last
        )
        h = self.decode_inner(self.from_latent(z) + self.place_latent)
        h = self.decode_outer(split(self.split(h), (2, 2)) + self.place_outer)
        numbers = self.head(cell_norm(h).movedim(1, -1).flatten(0, 2))
        return surfaces_of(numbers, self.surfaces, self.codes, PATCH, merged)

    def nll(self, predicted: Surfaces, x: Tensor, objective: Objective) -> Tensor:
        """The mean over cells, weighted by class (``Losses.rare``), of the negative log-likelihood
        of return, class, range and reflectance together; the weights of channels are exponents of
        the likelihoods of range and reflectance."""
        code = _codes_of(x)
        share = (
            torch.bincount(code.flatten(), minlength=self.codes).float() / code.numel()
        )
        rarity = share.pow(-objective.losses.rare)[code]
        cells = to_patches(torch.cat([x[:, :2], rarity[:, None]], 1), PATCH)
        distance, value, weight = cells.unbind(1)
        codes = to_patches(code[:, None], PATCH)[:, 0]
        weights = objective.weights
        temper = weights.get("range", 1.0), weights.get("reflectance", 1.0)
        likely = predicted.log_likelihood(
            distance, value, codes, self.normalisation, temper
        )
        return -(weight * likely).sum() / weight.sum()

    def measure(self, images: Iterable[Tensor], objective: Objective) -> None:
        """Measure the noise of cells."""
        self.measure_noise(images, objective.losses.noise)

    @torch.no_grad()
    def measure_noise(self, images: Iterable[Tensor], noise: float) -> None:
        """Set the noise of cells from images (1, C, H, W), whose latents get ``noise`` of this
        standard deviation, as in training."""
        generator = torch.Generator().manual_seed(0)
        network = copy.deepcopy(self).cpu()  # the same figures on every device

        def measured(x: Tensor) -> Seen:
            x = x.cpu()
            z = network.squeeze(x)
            z = z + noise * torch.randn(z.shape, generator=generator)
            return Seen(x, _codes_of(x), network.expand(z))

        cell_noise = measure_noise(
            map(measured, images), self.codes, self.normalisation, generator
        )
        self.roughness.copy_(cell_noise.roughness)
        self.relief.copy_(cell_noise.relief)
        self.alike.copy_(cell_noise.reflectance)

    def decode(
        self,
        z: Tensor,
        uniform_noise: Tensor | None = None,
        given: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Latents to images.

        Args:
            z: (B, *latent_shape).
            uniform_noise: (B, draws, H, W') numbers in (0, 1) to sample an image with; None = the
                most likely image. W' is one of ``widths``, and becomes the width of the image.
            given: "layout": (B, 5, H, W) uint8, images of layouts: objects are in their boxes only.
                "semantic": (B, H, W) uint8, label maps: returns have the labels of the map, where
                it has any.

        Returns:
            (B, C, H, W'): range -1 where there is no return; bits as logits of the most likely
            code, whose magnitude grows with its probability.
        """
        check_shape(z, self.latent_shape, "a latent")
        rows, columns = (
            self.resolution if uniform_noise is None else uniform_noise.shape[-2:]
        )
        if uniform_noise is None:
            uniform_noise = torch.full(
                (len(z), DRAWS, rows, columns), 0.5, device=z.device
            )
        if columns not in self.widths:
            raise DataError(
                f"noise for {columns} columns",
                f"one of {', '.join(map(str, self.widths))}",
            )
        merged = self.resolution[1] // columns
        patch = PATCH[0], PATCH[1] // merged
        grid = self.resolution[0] // PATCH[0], columns // patch[1]
        surfaces = share_planes(self.expand(self.bounded(z), merged), grid, patch)
        relief = relief_fields(uniform_noise[:, -1], merged)
        drawn = to_patches(uniform_noise, patch), to_patches(relief, patch)
        given = given or {}
        bounds = None
        codes = None
        if "layout" in given:
            bounds = bounds_of(
                given["layout"], columns, patch, self.codes, self.normalisation
            )
        if "semantic" in given:
            codes = codes_of(given["semantic"], columns, patch)
        cells = surfaces.sample(*drawn, self.noise, self.normalisation, bounds, codes)
        distance, value, code, likely = torch.split(
            from_patches(cells, patch, (rows, columns)), 1, 1
        )
        bits = torch.cat(
            [(code.long() >> b & 1) * 2.0 - 1.0 for b in reversed(range(self.bits))], 1
        )
        return torch.cat(
            [distance, value, bits * (2 * torch.atanh(likely.clamp(max=0.9999)))], 1
        )


def _codes_of(x: Tensor) -> Tensor:
    """The codes (B, H, W) of images (B, C, H, W): bits after range and reflectance, highest
    first."""
    code = torch.zeros_like(x[:, 0], dtype=torch.long)
    for bit in x[:, 2:].unbind(1):
        code = 2 * code + (bit > 0)
    return code
