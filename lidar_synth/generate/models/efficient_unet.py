"""R2DM's U-Net (Nakashima and Kurazume, "LiDAR Data Synthesis with Denoising Diffusion
Probabilistic Models", ICRA 2024) as the velocity network of a rectified flow.

The network is an Efficient U-Net (Saharia et al., "Imagen", NeurIPS 2022) with circular columns
that is given features of the ray angles. It was trained as a continuous-time diffusion model: at a
logarithmic signal-to-noise ratio l it sees x = a y0 + s e with a^2 = sigmoid(l), s^2 = sigmoid(-l).
A state y = (1 - t) y0 + t e of the rectified path is the same up to scale::

    l = 2 log((1 - t) / t), within [-15, 15]        x = y / sqrt((1 - t)^2 + t^2)
    v = (y - y0') / t

where y0' is the network's estimate of the data, clipped to [-1, 1] as R2DM's sampler does. An Euler
step is then a step of its deterministic sampler (DDIM).
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.convolution import (
    Attention,
    Norm,
    WrapConv,
    activate,
    check_condition,
    check_shape,
    pair,
    reduced,
    run,
)
from lidar_synth.generate.models.network import Network
from lidar_synth.generate.models.positions import BASES, RayAngles

PREDICTIONS = ("eps", "v", "x_0")
"""What the weights were trained to predict: the noise, a e - s y0, or the data."""
LIMIT = 15.0
"""Largest logarithm of the signal-to-noise ratio."""
EARLIEST = 1 / (1 + math.exp(LIMIT / 2))
"""Its time; the latest is 1 - EARLIEST."""

_EPS = 1e-6
_LONGEST = 10_000.0  # inverse of the lowest frequency of the embedding
_HALF = math.sqrt(0.5)  # keeps the variance of a sum


class EfficientUNet(Network):
    """Velocity network v(y, t) in the paper's convention: t = 1 noise, t = 0 data, v = y1 - y0.

    The defaults are R2DM's.

    Args:
        resolution: H, W of the image, multiples of 2^(levels - 1).
        channels: C of the image.
        width: channels after the first convolution.
        time_width: channels of the embedding of the noise level.
        multipliers: channels per level in units of ``width``.
        blocks: residual blocks per level.
        groups: groups of the norms.
        heads: attention heads of the coarsest level.
        position: a key of ``BASES``, the features of the ray angles; None = none.
        predicts: one of ``PREDICTIONS``.
        angles: (2, H, W) elevation and azimuth of every cell, radians; None if a checkpoint will be
            loaded.

    Raises:
        ConfigError: on values that do not fit together.
    """

    needs_ray_angles: ClassVar[bool] = True
    condition_channels = 0
    context_channels = 0

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 2,
        width: int = 64,
        time_width: int = 256,
        multipliers: Sequence[int] = (1, 2, 4, 8),
        blocks: Sequence[int] = (3, 3, 3, 3),
        groups: int = 8,
        heads: int = 8,
        position: str | None = "fourier_features",
        predicts: str = "eps",
        angles: Tensor | None = None,
    ) -> None:
        super().__init__()
        if predicts not in PREDICTIONS or position not in (None, *BASES):
            raise ConfigError(
                f"predicts={predicts!r}, position={position!r}",
                f"one of {PREDICTIONS}, and one of {(None, *BASES)}",
            )
        if len(multipliers) != len(blocks):
            raise ConfigError(
                f"{len(multipliers)} multipliers, {len(blocks)} numbers of blocks",
                "one of each per level",
            )
        self.resolution = pair(resolution)
        reduced(self.resolution, [(2, 2)] * (len(blocks) - 1), "an image")
        self.channels = channels
        self.predicts = predicts
        self.gradient_checkpointing = False
        """Recompute the activations of the levels in the backward pass instead of storing them."""
        self.angles = RayAngles(self.resolution, angles)
        self.position = position
        features = 0
        if position is not None:
            known = BASES[position](torch.zeros(2, *self.resolution, device="cpu"))
            features = known.shape[-1]
        self.embed = nn.Sequential(
            nn.Linear(width, time_width), nn.SiLU(), nn.Linear(time_width, time_width)
        )
        self.width = width
        shared = time_width, groups, heads
        widths = [width, *(width * m for m in multipliers)]
        last = len(blocks) - 1
        self.enter = WrapConv(channels + features, width)
        self.down = nn.ModuleList(
            EfficientLevel(
                widths[i], widths[i + 1], n, *shared, halves=i > 0, attends=i == last
            )
            for i, n in enumerate(blocks)
        )
        self.up = nn.ModuleList(
            EfficientLevel(
                widths[i + 1] * (2 if i < last else 1),
                widths[i],
                blocks[i],
                *shared,
                doubles=i > 0,
                attends=i == last,
            )
            for i in reversed(range(len(blocks)))
        )
        self.leave = WrapConv(width, channels)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]  # it has one

    def forward(
        self, y: Tensor, t: Tensor | float, cond: Tensor | None = None
    ) -> Tensor:
        """The velocity dy/dt.

        Args:
            y: (B, C, H, W) states.
            t: (B,) times in [0, 1], or one for all.
            cond: None.

        Raises:
            DataError: on another shape, or a condition.
        """
        check_shape(y, (self.channels, *self.resolution), "a state")
        check_condition(cond, len(y), (0, 0, 0), 0)
        time = torch.as_tensor(t, dtype=torch.float64, device=y.device)
        time = time.expand(len(y)).reshape(-1, 1, 1, 1)
        clamped = time.clamp(EARLIEST, 1 - EARLIEST)
        ratio = 2 * torch.log((1 - clamped) / clamped)
        x = y.double() / ((1 - time) ** 2 + time**2).sqrt()
        estimate = self.predict(x.to(y.dtype), ratio.flatten().to(y.dtype)).double()
        signal = ratio.sigmoid().sqrt()
        noise = (-ratio).sigmoid().sqrt()
        if self.predicts == "eps":
            estimate = (x - noise * estimate) / signal
        elif self.predicts == "v":
            estimate = signal * x - noise * estimate
        return ((y - estimate.clamp(-1, 1)) / time.clamp(min=EARLIEST)).to(y.dtype)

    def predict(self, x: Tensor, ratio: Tensor) -> Tensor:
        """What the weights were trained to predict from states x (B, C, H, W) of variance 1 and the
        logarithms (B,) of their signal-to-noise ratios."""
        time = activate(self.embed(sinusoids(ratio, self.width)))
        if self.position is not None:
            features = BASES[self.position](self.angles.cells).to(x.dtype)
            x = torch.cat((x, features.movedim(-1, 0).expand(len(x), -1, -1, -1)), 1)
        h = self.enter(x)
        skips = []
        for level in self.down:
            h = run(level, self.gradient_checkpointing, h, time)
            skips.append(h)
        skips.pop()
        for level in self.up:
            h = run(level, self.gradient_checkpointing, h, time)
            if skips:
                h = torch.cat((h, skips.pop()), 1)
        out: Tensor = self.leave(h)
        return out


class EfficientLevel(nn.Module):
    """Residual blocks of one resolution, with the change of resolution before or after them.

    Args:
        inputs, outputs: channels.
        blocks: number of residual blocks.
        embedding: channels of the embedding of the noise level.
        groups: groups of the norms.
        heads: attention heads.
        halves: whether rows and columns are halved before.
        doubles: whether they are doubled after.
        attends: whether every cell attends to all after the blocks.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        blocks: int,
        embedding: int,
        groups: int,
        heads: int,
        halves: bool = False,
        doubles: bool = False,
        attends: bool = False,
    ) -> None:
        super().__init__()
        self.before = WrapConv(inputs, outputs) if halves else None
        first = outputs if halves else inputs
        self.blocks = nn.ModuleList(
            TimedResidual(outputs if i else first, outputs, embedding, groups)
            for i in range(blocks)
        )
        self.attention = Attention(outputs, heads, _EPS, groups) if attends else None
        self.after = WrapConv(outputs, outputs) if doubles else None

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """(B, inputs, H, W) and the activated embedding (B, E) to (B, outputs, H', W')."""
        if self.before is not None:
            x = halve(self.before(x))
        for block in self.blocks:
            x = block(x, time)
        if self.attention is not None:
            x = self.attention(x) * _HALF
        if self.after is not None:
            x = self.after(double(x))
        return x


class TimedResidual(nn.Module):
    """(x + f(x)) / sqrt(2), where f is two times norm, SiLU, convolution; the embedding scales and
    shifts the second norm.

    Args:
        inputs, outputs: channels.
        embedding: channels of the embedding.
        groups: groups of the norms.
    """

    def __init__(self, inputs: int, outputs: int, embedding: int, groups: int) -> None:
        super().__init__()
        self.norm1 = Norm(inputs, _EPS, groups)
        self.conv1 = WrapConv(inputs, outputs)
        self.norm2 = nn.GroupNorm(groups, outputs, _EPS, affine=False)
        self.gain = nn.Linear(embedding, 2 * outputs)
        self.conv2 = WrapConv(outputs, outputs)
        self.shortcut = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else None
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """(B, inputs, H, W) and the activated embedding (B, E) to (B, outputs, H, W)."""
        h = self.norm2(self.conv1(activate(self.norm1(x))))
        gain, shift = self.gain(time)[..., None, None].chunk(2, 1)
        h = self.conv2(activate(h * (1 + gain) + shift))
        kept = x if self.shortcut is None else self.shortcut(x)
        out: Tensor = (kept + h) * _HALF
        return out


def halve(x: Tensor) -> Tensor:
    """(B, C, H, W) to (B, C, H / 2, W / 2), smoothed by [1, 3, 3, 1] / 8."""
    taps = torch.tensor([1, 3, 3, 1], dtype=x.dtype, device=x.device) / 8
    kernel = (taps[:, None] * taps).expand(x.shape[1], 1, 4, 4)
    x = F.pad(x, (1, 1, 0, 0), "circular")
    return F.conv2d(x, kernel, stride=2, padding=(1, 0), groups=x.shape[1])


def double(x: Tensor) -> Tensor:
    """(B, C, H, W) to (B, C, 2 H, 2 W), bilinear; beyond the first and the last row is zero."""
    x = F.pad(F.pad(x, (1, 1, 0, 0), "circular"), (0, 0, 1, 1))
    return F.interpolate(x, scale_factor=2, mode="bilinear")[..., 2:-2, 2:-2]


def sinusoids(values: Tensor, width: int) -> Tensor:
    """Sines, then cosines, (B, width) of values (B,), with angular frequencies from 1 to 1e-4."""
    count = width // 2
    step = -math.log(_LONGEST) / (count - 1)
    frequencies = (step * torch.arange(count, device=values.device).float()).exp()
    turn = values[:, None] * frequencies
    return torch.cat((turn.sin(), turn.cos()), -1).to(values.dtype)
