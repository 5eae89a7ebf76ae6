"""Autoencoder of range images that two CPU cores can train.

An image (C, H, W) in [-1, 1] becomes a latent (Z, H / 4, W / 8) in (-1, 1), the size of LiDM's (Ran
et al., "Towards Realistic Scene Generation with LiDAR Diffusion Models", CVPR 2024).

No latent can hold what is random about a sensor: whether a ray returns, the speckle of a
reflectance. The decoder therefore predicts distributions, and an image is sampled from them: the
mean would be smoother than any real scan, and a network trained on such means would take the noise
of real scans for something new.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.bounded_latent import BoundedAutoencoder, NormedResidual, row_bias
from lidar_synth.generate.models.convolution import WrapConv, check_shape, pair, reduced
from lidar_synth.generate.models.town_codec.distributions import CellDistributions
from lidar_synth.generate.models.town_codec.multiscale import (
    LATTICES,
    LatticeRefinement,
    at_lattice,
    step_ratio,
)
from lidar_synth.generate.models.town_codec.plane_fit import PlaneFit
from lidar_synth.generate.models.town_codec.planes import Planes, RangeMixture, laplace_noise
from lidar_synth.generate.models.town_codec.reflectance import ZeroInflatedLogistic
from lidar_synth.geometry.normalize import NORMALISATIONS

DETAIL = (2, 4)
"""Rows and columns of the patches that the outer convolutions work on."""
DOWN = (4, 8)
"""Rows and columns of one latent cell."""
PLANES = 2
"""Planes per patch: one, and what is behind its edge."""
SPREADS = -4.6, 0.0
"""Limits of the logarithm of the other values' scales."""
ROUGHNESS = 5e-4
"""Scale of the noise of sampled ranges, normalised: 1.3 cm at 10 m in R2Flow's scale."""

Grid = tuple[int, int]
Observe = Callable[[CellDistributions, Grid], Tensor]
"""(predicted distributions, lattice) to the values of its cells: sampled, or those of a given
image."""


class Autoencoder(BoundedAutoencoder):
    """Images to latents and back; a codec like ``VQVAE``.

    Args:
        resolution: H, W of the image, multiples of 4 and 8.
        channels: C of the image: the range first, then other numbers such as reflectance, then
            ``bits``.
        bits: channels of the image that are an analog code (``normalize.encode_labels``).
        codes: K, how many codes there are.
        latent_channels: Z.
        widths: channels on patches of 2 x 4 cells and of 4 x 8.
        depth: residual blocks of the decoder on the coarser grid; one less after it, one less on it
            in the encoder.
        wide: dilations of further blocks of the decoder on the coarser grid, since a wall is
            straight over many cells.
        window: rows and columns of patches of 2 x 4 cells over which planes are fitted; empty = no
            plane fit.
        fine: channels of the decoder's last map, on single cells.
        normalisation: a name of ``NORMALISATIONS``, that of the range.
        angles: (2, H, W) elevation and azimuth of the cells' rays, radians; None if a checkpoint
            will be loaded.

    Raises:
        ConfigError: on values that do not fit together.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "channels", "normalisation")
    needs_ray_angles: ClassVar[bool] = True

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 7,
        bits: int = 5,
        codes: int = 20,
        latent_channels: int = 8,
        widths: Sequence[int] = (48, 96),
        depth: int = 3,
        wide: Sequence[int] = (),
        window: Sequence[int] = (),
        fine: int = 24,
        normalisation: str = "r2flow",
        angles: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        rows = self.resolution[0]
        if (
            (bits and not 2**bits >= codes > 1)
            or (not bits and codes)
            or channels <= bits
            or depth < 2
        ):
            raise ConfigError(
                f"{channels} channels, {codes} codes in {bits} bits, depth {depth}",
                "a range beside the bits, as many bits as the codes need (0 for 0), and depth >= 2",
            )
        if normalisation not in NORMALISATIONS:
            raise ConfigError(
                f"normalisation {normalisation!r}", f"one of {', '.join(NORMALISATIONS)}"
            )
        columns = self.resolution[1] // DOWN[1]
        if any(not 1 <= reach <= columns for reach in wide):
            raise ConfigError(f"wide {list(wide)}", f"columns of a latent, from 1 to {columns}")
        outer, inner = widths
        self.channels = channels
        self.values = channels - bits - 1
        self.bits = bits
        self.fine = fine
        self.draws = 2 + self.values
        """Random numbers per cell that sampling an image takes."""
        self.latent_shape = (latent_channels, *reduced(self.resolution, [DOWN], "an image"))
        """Channels, rows and columns of a latent."""
        stem = nn.Conv2d(self.channels + 1, outer, DETAIL, DETAIL)
        self.add_encoder(stem, widths, rows // DETAIL[0], depth - 1, latent_channels)
        self.place_latent = row_bias(inner, rows // DOWN[0])
        self.place_outer = row_bias(outer, rows // DETAIL[0])
        self.place_fine = row_bias(fine, rows)
        self.from_latent = nn.Conv2d(latent_channels, inner, 1)
        self.decode_inner = _blocks(inner, depth, wide)
        self.split = nn.Conv2d(inner, 4 * outer, 1)
        self.decode_outer = _blocks(outer, depth - 1)
        self.spread = nn.Conv2d(outer, DETAIL[0] * DETAIL[1] * fine, 1)
        self.refine = WrapConv(fine, fine)
        grid = rows // DETAIL[0], self.resolution[1] // DETAIL[1]
        rise = torch.zeros(rows) if angles is None else angles[0].mean(1).tan()
        consensus = PlaneFit(outer, grid, DETAIL, PLANES, pair(window), rise) if window else None
        self.planes = Planes(outer, DETAIL, PLANES, NORMALISATIONS[normalisation], consensus)
        self.sizes = [PLANES, self.values, self.values, self.values, 1, codes]
        self.heads = nn.Conv2d(fine, sum(self.sizes), 1)
        self.neighbours = nn.ModuleList(
            LatticeRefinement(fine, 1 + 2 * self.values, 2 * fine, step_ratio(a, b))
            for a, b in pairwise(LATTICES)
        )

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents to images.

        Args:
            z: (B, *latent_shape).
            uniform_noise: (B, draws, H, W) numbers in (0, 1) to sample an image with; None = the
                mode.

        Returns:
            (B, C, H, W): range -1 where there is no return; bits as logits of the most likely code,
            whose magnitude grows with its probability.
        """
        check_shape(z, self.latent_shape, "a latent")
        predicted = self._decode_lattices(
            self.bounded(z),
            lambda cells, lattice: cells.sample(
                None if uniform_noise is None else at_lattice(lattice, uniform_noise)
            ),
        )
        distance = predicted.surfaces.mode()
        seen = predicted.sample(uniform_noise)
        if uniform_noise is not None:
            distance = distance + ROUGHNESS * laplace_noise(uniform_noise[:, :1])
        parts = [torch.where(seen[:, :1] > 0, distance, -1.0), seen[:, 1:]]
        if self.bits:
            likely, code = predicted.classes.float().softmax(1).max(1)
            parts += [self._corners(code) * (2 * torch.atanh(likely.clamp(max=0.9999)))[:, None]]
        return torch.cat(parts, 1)

    def embed(self, x: Tensor) -> Tensor:
        """Images with a channel of their returns, (B, C + 1, H, W), to patches of 2 x 4 cells."""
        patches: Tensor = self.stem(x.contiguous(memory_format=torch.channels_last))
        return patches

    def expand(self, z: Tensor, image: Tensor) -> CellDistributions:
        """Bounded latents to the distributions of every cell, given its neighbours on coarser
        ``LATTICES`` of an image (B, C, H, W)."""
        seen = torch.cat([(image[:, :1] > -1).to(image.dtype), image[:, 1 : 1 + self.values]], 1)
        return self._decode_lattices(z, lambda _, lattice: at_lattice(lattice, seen))

    def _decode_lattices(self, z: Tensor, observe: Observe) -> CellDistributions:
        """The distributions of every cell, lattice by lattice; ``observe`` gives the values of the
        cells of one."""
        z = z.to(self.from_latent.weight.dtype).contiguous(memory_format=torch.channels_last)
        h = self.decode_inner(self.from_latent(z) + self.place_latent)
        h = self.decode_outer(F.pixel_shuffle(self.split(h), 2) + self.place_outer)
        planes = self.planes(h)
        h = _unpatch(self.spread(h), self.fine) + self.place_fine
        h = h + F.silu(self.refine(h))
        predicted = self.heads(at_lattice(LATTICES[0], h))
        for (known, finer), neighbours in zip(pairwise(LATTICES), self.neighbours, strict=True):
            seen = observe(self._distributions(planes, predicted, known), known)
            alone = self._distributions(planes, self.heads(at_lattice(known, h)), known)
            closer = self.heads(neighbours(at_lattice(finer, h), alone.residual(seen)))
            at_lattice(step_ratio(known, finer), closer)[:] = predicted
            predicted = closer
        return self._distributions(planes, predicted, LATTICES[-1])

    def _distributions(
        self, planes: tuple[Tensor, Tensor], predicted: Tensor, lattice: Grid
    ) -> CellDistributions:
        chosen, middles, spreads, blank, *rest = torch.split(predicted, self.sizes, 1)
        ranges, doubts = (at_lattice(lattice, part) for part in planes)
        readings = ZeroInflatedLogistic(
            middles.float(), spreads.float().clamp(*SPREADS), blank.float()
        )
        return CellDistributions(RangeMixture(ranges, doubts, chosen.float()), readings, *rest)

    def _corners(self, code: Tensor) -> Tensor:
        """Codes (B, H, W) as their bits (B, bits, H, W), -1 and 1, highest first."""
        return torch.stack([(code >> b & 1) * 2.0 - 1.0 for b in reversed(range(self.bits))], 1)


def _blocks(channels: int, depth: int, wide: Sequence[int] = ()) -> nn.Sequential:
    return nn.Sequential(*(NormedResidual(channels, reach) for reach in (*[1] * depth, *wide)))


def _unpatch(x: Tensor, channels: int) -> Tensor:
    """(B, 8 C, h, w) to (B, C, 2 h, 4 w)."""
    batch, _, rows, columns = x.shape
    x = x.reshape(batch, *DETAIL, channels, rows, columns).permute(0, 4, 1, 5, 2, 3)
    return x.reshape(batch, rows * DETAIL[0], columns * DETAIL[1], channels).movedim(-1, 1)
