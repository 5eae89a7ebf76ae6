"""An autoencoder of range images with a codebook (VQ-VAE), after LiDM's.

Columns wrap around. The decoder is curve-wise: the beams of a sensor trace curves, and its finest
levels convolve along rows only (1 x 4). ``encode`` returns the latent before quantisation, and
``decode`` first quantises it (Ran et al., "Towards Realistic Scene Generation with LiDAR Diffusion
Models", CVPR 2024), which removes small errors of a flow.

Input and output have the channels of the image; labels are encoded as bits. With ``mask``, the
decoder has one more
channel that predicts returns: a cell is empty where it is below 0.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.attention import Grid
from lidar_synth.generate.models.codebook import Codebook, follow
from lidar_synth.generate.models.convolution import (
    GROUPS,
    Attention,
    Norm,
    Residual,
    WrapConv,
    activate,
    check_shape,
    fold,
    pair,
    reduced,
    run,
    unfold,
)
from lidar_synth.generate.models.network import Autoencoder
from lidar_synth.generate.models.objective import Objective, expected

CURVE = (1, 4)
"""Kernel of the decoder's levels that have as many rows as the image."""


class _Step(NamedTuple):
    """Change of resolution: kernel and padding (left, right, above, below) of the encoder, kernel
    of the decoder."""

    down: Grid
    pad: tuple[int, int, int, int]
    up: Grid


# By stride.
_STEPS: dict[Grid, _Step] = {
    (1, 2): _Step((3, 3), (0, 1, 1, 1), (1, 5)),
    (1, 4): _Step((3, 5), (1, 1, 1, 1), (1, 7)),
    (2, 1): _Step((3, 3), (1, 1, 1, 1), (5, 1)),
    (2, 2): _Step((3, 3), (0, 1, 0, 1), (3, 3)),
}


class Reconstruction(NamedTuple):
    """Result of a forward pass, for the training loss.

    Args:
        output: (B, C, H, W) decoded image; gradients pass the codebook straight through to the
            encoder. (B, C + 1, H, W) for a network with a mask, which is the last channel.
        gap: (B,) mean squared distance of the latent to its codes, with gradients to the encoder.
        code_gap: (B,) the same distance with gradients to the codes.
    """

    output: Tensor
    gap: Tensor
    code_gap: Tensor


class VQVAE(Autoencoder):
    """Autoencoder of range images. The defaults are LiDM's, which encode 64 x 1024 cells to 8 x 16
    x 128.

    Args:
        resolution: H, W of the image.
        channels: C of the image.
        latent_channels: channels of the latent and of a code.
        codes: size of the codebook; 0 = no codebook, latents are bounded by tanh instead.
        width: channels at the finest level.
        multipliers: channels per level in units of ``width``.
        strides: rows and columns by which the image shrinks between two levels.
        blocks: residual blocks per level; the decoder has one more.
        attention: whether the coarsest level has attention.
        attention_levels: levels (0 = the finest) with attention after each block.
        mask: whether to predict returns in a separate channel.
        patch: rows and columns of cells that form one position of the finest level: LiDM uses (1,
            1), larger patches are faster.
        groups: groups of the norms; see ``convolution.GROUPS``.

    Raises:
        ConfigError: on values that do not fit together.
    """

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 1,
        latent_channels: int = 8,
        codes: int = 16384,
        width: int = 64,
        multipliers: Sequence[int] = (1, 2, 2, 4),
        strides: Sequence[Sequence[int]] = ((1, 2), (2, 2), (2, 2)),
        blocks: int = 2,
        attention: bool = True,
        patch: Sequence[int] = (1, 1),
        groups: int = GROUPS,
        attention_levels: Sequence[int] = (),
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.patch = pair(patch)
        self.channels = channels
        self.mask = mask
        steps = [pair(s) for s in strides]
        if len(multipliers) != len(steps) + 1 or any(s not in _STEPS for s in steps):
            raise ConfigError(
                f"multipliers {tuple(multipliers)} and strides {steps}",
                f"one multiplier more than strides, strides of {tuple(_STEPS)}",
            )
        if not set(attention_levels) <= set(range(len(multipliers))):
            raise ConfigError(
                f"attention_levels {list(attention_levels)}",
                f"levels 0 to {len(multipliers) - 1}",
            )
        self.draws = 0
        self.latent_shape = (
            latent_channels,
            *reduced(self.resolution, [self.patch, *steps], "an image"),
        )
        """Channels, rows and columns of a latent."""
        self.gradient_checkpointing = False
        """Recompute the activations of the levels in the backward pass instead of storing them."""
        widths = [width * m for m in multipliers]
        cells = self.patch[0] * self.patch[1]
        attends = [level in attention_levels for level in range(len(widths))]
        levels = (widths, steps, blocks, attends, attention, groups)
        self.encoder = ImageEncoder(cells * channels, latent_channels, width, *levels)
        self.to_latent = nn.Conv2d(latent_channels, latent_channels, 1)
        self.from_latent = nn.Conv2d(latent_channels, latent_channels, 1)
        self.decoder = Decoder(cells * (channels + mask), latent_channels, *levels)
        self.codebook = Codebook(codes, latent_channels)
        self.add_scale(latent_channels)

    def encode(self, x: Tensor) -> Tensor:
        """Images (B, C, H, W) to latents before the codebook, (B, *latent_shape), mean 0 and
        variance 1 per channel."""
        return self.normed(self._encode(x))

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        """Latents (B, *latent_shape), quantised, to images (B, C, H, W), with -1 where the mask
        predicts no return.

        ``uniform_noise`` is ignored, since decoding is deterministic.
        """
        check_shape(z, self.latent_shape, "a latent")
        z = self.bounded(z.to(self.to_latent.weight.dtype))
        output = self._decode(self.codebook(z)[0])
        if self.mask:
            return torch.where(
                output[:, self.channels :] < 0, -1.0, output[:, : self.channels]
            )
        return output

    def forward(self, x: Tensor) -> Reconstruction:
        """Encode and decode images (B, C, H, W).

        In training mode, this updates the running statistics of the latents.
        """
        z = self._encode(x)
        if self.training:
            follow(z.detach(), self.shift, self.scale)
        quantised, _ = self.codebook(z)
        through = z + (quantised - z).detach() if len(self.codebook) else z
        gap = (z - quantised.detach()).float().square().flatten(1).mean(1)
        return Reconstruction(
            self._decode(through),
            gap,
            (quantised - z.detach()).float().square().flatten(1).mean(1),
        )

    def loss(self, x: Tensor, noise: Tensor, objective: Objective) -> Tensor:
        """The loss of images (B, C, H, W), a scalar; ``noise`` is not used.

        ::

            reconstruction   the metric per channel, with the weights; label bits by cross-entropy
            codebook         squared distance of latents to their codes: ``commitment`` moves the
                             encoder, ``codebook`` the codes
            mask             distance of the mask, where there is one, to 1 = return and -1 = none
            geometric        squared distance of points, each the mean of four neighbours in a row,
                             in units of the maximum range: preserves the curves that beams trace
            adversarial      the discriminator's hinge loss; in training alone, with gradients:
                             measured by a discriminator that changes, images cannot be compared
        """
        losses = objective.losses
        result = self(x)
        output, mask = result.output.float().tensor_split([self.channels], 1)
        loss = objective.reconstruction(output, x)
        if self.mask:
            loss = (
                loss
                + losses.mask * objective.metric(mask, objective.returned(x)).mean()
            )
        if losses.geometric:
            off = objective.points(output) - objective.points(x)
            loss = loss + losses.geometric * off.square().sum(1).mean()
        if objective.discriminator is not None and torch.is_grad_enabled():
            image = expected(output, objective.tensors)
            loss = loss + self._adversarial(
                objective.discriminator, image, x, loss, objective
            )
        loss = loss + losses.commitment * result.gap.mean()
        total: Tensor = loss + losses.codebook * result.code_gap.mean()
        return total

    def _adversarial(
        self,
        judge: nn.Module,
        output: Tensor,
        x: Tensor,
        reconstruction: Tensor,
        objective: Objective,
    ) -> Tensor:
        """The terms of autoencoder and discriminator: the first uses the discriminator with frozen
        weights, the second uses detached reconstructions."""
        frozen = {name: p.detach() for name, p in judge.named_parameters()}
        fooled: Tensor = -torch.func.functional_call(judge, frozen, (output,)).mean()
        verdict = (
            F.relu(1 - judge(x)).mean() + F.relu(1 + judge(output.detach())).mean()
        )
        losses = objective.losses
        balance = self._balance(reconstruction, fooled) if losses.adaptive else 1.0
        return losses.adversarial * balance * fooled + verdict / 2

    def _balance(self, reconstruction: Tensor, fooled: Tensor) -> Tensor:
        """Ratio of the gradient norms of both terms at the decoder's last layer, at most 10^4."""
        last = self.decoder.head.weight
        one, other = (
            torch.autograd.grad(x, last, retain_graph=True)[0].norm()
            for x in (reconstruction, fooled)
        )
        balance: Tensor = (one / (other + 1e-4)).clamp(max=1e4)
        return balance

    def _encode(self, x: Tensor) -> Tensor:
        check_shape(x, (self.channels, *self.resolution), "an image")
        x = fold(x.to(self.to_latent.weight.dtype), self.patch).contiguous(
            memory_format=torch.channels_last
        )
        z: Tensor = self.to_latent(self.encoder(x, self.gradient_checkpointing))
        return z if len(self.codebook) else z.tanh()

    def _decode(self, z: Tensor) -> Tensor:
        return unfold(
            self.decoder(self.from_latent(z), self.gradient_checkpointing), self.patch
        )


class ImageEncoder(nn.Module):
    """Images (B, C, H, W) to (B, K, h, w). Arguments are those of ``VQVAE``; ``widths`` and
    ``attends`` are per level, finest first."""

    def __init__(
        self,
        channels: int,
        latent: int,
        width: int,
        widths: Sequence[int],
        strides: Sequence[Grid],
        blocks: int,
        attends: Sequence[bool],
        attention: bool,
        groups: int,
    ) -> None:
        super().__init__()
        self.stem = WrapConv(channels, width)
        inputs = [width, *widths[:-1]]
        self.levels = nn.ModuleList(
            _level(a, b, blocks, groups, has_attention)
            for a, b, has_attention in zip(inputs, widths, attends, strict=True)
        )
        self.down = nn.ModuleList(
            WrapConv(w, w, _STEPS[s].down, s, _STEPS[s].pad)
            for w, s in zip(widths[:-1], strides, strict=True)
        )
        self.middle = _middle(widths[-1], attention, groups)
        self.norm = Norm(widths[-1], 1e-6, groups)
        self.head = WrapConv(widths[-1], latent)

    def forward(self, x: Tensor, checkpointing: bool) -> Tensor:
        x = run(self.levels[0], checkpointing, self.stem(x))
        for down, level in zip(self.down, list(self.levels)[1:], strict=True):
            x = run(level, checkpointing, down(x))
        return self.head(  # type: ignore[no-any-return]
            activate(self.norm(run(self.middle, checkpointing, x)))
        )


class Decoder(nn.Module):
    """(B, K, h, w) to images (B, C, H, W). Arguments are those of ``VQVAE``; ``widths`` and
    ``attends`` are per level, finest first."""

    def __init__(
        self,
        channels: int,
        latent: int,
        widths: Sequence[int],
        strides: Sequence[Grid],
        blocks: int,
        attends: Sequence[bool],
        attention: bool,
        groups: int,
    ) -> None:
        super().__init__()
        self.stem = WrapConv(latent, widths[-1])
        self.middle = _middle(widths[-1], attention, groups)
        # One kernel per level: levels before the first stride over rows have the rows of the image.
        kernels = [CURVE, *((3, 3) if s[0] > 1 else CURVE for s in strides)]
        inputs = [*widths[1:], widths[-1]]
        levels = [
            _level(a, b, blocks + 1, groups, has_attention, k)
            for a, b, has_attention, k in zip(
                inputs, widths, attends, kernels, strict=True
            )
        ]
        self.levels = nn.ModuleList(reversed(levels))
        self.up = nn.ModuleList(
            _Upsample(w, s)
            for w, s in reversed(list(zip(widths[1:], strides, strict=True)))
        )
        self.norm = Norm(widths[0], 1e-6, groups)
        self.head = WrapConv(widths[0], channels, CURVE)

    def forward(self, z: Tensor, checkpointing: bool) -> Tensor:
        x = run(
            self.levels[0], checkpointing, run(self.middle, checkpointing, self.stem(z))
        )
        for up, level in zip(self.up, list(self.levels)[1:], strict=True):
            x = run(level, checkpointing, up(x))
        return self.head(activate(self.norm(x)))  # type: ignore[no-any-return]


class _Upsample(nn.Module):
    """Bilinear upsampling with aligned corners, then a convolution."""

    def __init__(self, channels: int, stride: Grid) -> None:
        super().__init__()
        self.stride = tuple(map(float, stride))
        self.conv = WrapConv(channels, channels, _STEPS[stride].up)

    def forward(self, x: Tensor) -> Tensor:
        x = F.interpolate(
            x, scale_factor=self.stride, mode="bilinear", align_corners=True
        )
        return self.conv(x)  # type: ignore[no-any-return]


def _level(
    inputs: int,
    outputs: int,
    blocks: int,
    groups: int,
    attends: bool,
    kernel: Grid = (3, 3),
) -> nn.Sequential:
    parts: list[nn.Module] = []
    for i in range(blocks):
        parts.append(
            Residual(inputs if i == 0 else outputs, outputs, kernel, groups=groups)
        )
        parts += [Attention(outputs, groups=groups)] if attends else []
    return nn.Sequential(*parts)


def _middle(channels: int, attention: bool, groups: int) -> nn.Sequential:
    first, last = (Residual(channels, channels, groups=groups) for _ in range(2))
    return nn.Sequential(
        first, *([Attention(channels, groups=groups)] if attention else []), last
    )
