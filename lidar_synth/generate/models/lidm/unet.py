"""A convolutional U-Net that predicts the velocity of a range image or of a latent.

The architecture is that of latent diffusion (Rombach et al., CVPR 2022) with circular columns (Ran
et al., "Towards Realistic Scene Generation with LiDAR Diffusion Models", CVPR 2024), and with
LiDAR-Flow's addition, which the paper describes in one sentence: "integrates positional embeddings
into latent features". Here, a learned table with one vector per cell is added to the features after
the first convolution and before the first block, so that every level and every skip connection has
access to a cell's position.

A condition is given in one of two forms: maps on the grid of the state, which are concatenated with
it (``condition_channels``), or tokens, to which every cell attends at every level with attention
(``context_channels``).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.convolution import (
    GROUPS,
    Attention,
    ContextBlock,
    Norm,
    Residual,
    WrapConv,
    activate,
    check_condition,
    check_shape,
    fold,
    pair,
    reduced,
    run,
    times_of,
    unfold,
)
from lidar_synth.generate.models.network import Network

MOST_BLOCKS = 1000
"""Maximum number of residual blocks of a level."""

TIME_SCALE = 1000.0
"""Factor from times in [0, 1] to the diffusion steps that the time embedding expects."""

_EPS = 1e-5  # of the residual blocks' norms, as in latent diffusion
_LONGEST = 10_000.0  # inverse of the lowest frequency of the time embedding, in steps per radian


class _Row(NamedTuple):
    """One entry of the downward or upward path: channels in and out, level, and whether it
    resamples."""

    inputs: int
    outputs: int
    level: int
    resample: bool = False


class UNet(Network):
    """Velocity network v(y, t, c) in the paper's convention: t = 1 noise, t = 0 data, v = y1 - y0.

    All arguments are plain values, which a checkpoint stores. The network computes in the dtype of
    its weights (or of autocast) and returns the dtype of y. The defaults are LiDM's.

    Args:
        resolution: H, W of the state.
        channels: C of the state.
        condition_channels: channels of a condition's maps on the same grid; 0 = no maps.
        context_channels: channels of a condition's tokens; 0 = no tokens.
        width: channels at the finest level.
        multipliers: channels per level in units of ``width``; every level after the first halves
            rows and columns.
        blocks: residual blocks per level, and one more on the upward path.
        attention: levels with attention; the middle always has attention.
        head_channels: channels of an attention head, at most a level's.
        position: whether to add the learned table.
        patch: rows and columns of cells that form one position of the finest level, for states as
            large as a range image.
        groups: groups of the norms; see ``convolution.GROUPS``.

    Raises:
        ConfigError: on values that do not fit together.
    """

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 8,
        condition_channels: int = 0,
        context_channels: int = 0,
        width: int = 256,
        multipliers: Sequence[int] = (1, 2, 4),
        blocks: int = 2,
        attention: Sequence[int] = (0, 1, 2),
        head_channels: int = 32,
        position: bool = True,
        patch: Sequence[int] = (1, 1),
        groups: int = GROUPS,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.patch = pair(patch)
        self.channels = channels
        self.condition_channels = condition_channels
        self.context_channels = context_channels
        self.width = width
        self.groups = groups
        self.gradient_checkpointing = False
        """Recompute the activations of the blocks in the backward pass instead of storing them."""
        widths = [width * m for m in multipliers]
        grid = reduced(self.resolution, [self.patch], "a state")
        reduced(
            grid,
            [(2, 2)] * (len(widths) - 1),
            f"patches of {self.patch}, which are halved between levels:",
        )
        if width % 2 or any(c % min(head_channels, c) for c in widths):
            raise ConfigError(
                f"widths {widths}",
                f"even, and multiples of head_channels {head_channels}",
            )
        cells = self.patch[0] * self.patch[1]
        embedding = 4 * width
        self.time = nn.Sequential(
            nn.Linear(width, embedding), nn.SiLU(), nn.Linear(embedding, embedding)
        )
        self.stem = WrapConv(cells * (channels + condition_channels), width)
        self.table = nn.Parameter(torch.empty(width, *grid)) if position else None
        if self.table is not None:
            nn.init.trunc_normal_(self.table, std=0.02)

        def stage(
            row: _Row, attends: bool, resample: nn.Module | None = None
        ) -> _Stage:
            attention_layer = (
                self._attention(row.outputs, head_channels) if attends else None
            )
            residual = Residual(
                row.inputs, row.outputs, embedding=embedding, eps=_EPS, groups=groups
            )
            return _Stage(residual, attention_layer, resample)

        down, up = _plan(widths, blocks)
        self.down = nn.ModuleList(
            Downsample(row.outputs)
            if row.resample
            else stage(row, row.level in attention)
            for row in down
        )
        middle = _Row(widths[-1], widths[-1], len(widths) - 1)
        self.middle = nn.ModuleList([stage(middle, True), stage(middle, False)])
        self.up = nn.ModuleList(
            stage(
                row,
                row.level in attention,
                Upsample(row.outputs) if row.resample else None,
            )
            for row in up
        )
        self.norm = Norm(widths[0], _EPS, groups)
        self.head = WrapConv(widths[0], cells * channels)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]  # the convolution has a bias

    def forward(
        self, y: Tensor, t: Tensor | float, cond: Tensor | None = None
    ) -> Tensor:
        """The velocity dy/dt at y and t.

        Args:
            y: (B, C, H, W) state.
            t: (B,) times, or one for all states, in [0, 1]; 1 = noise.
            cond: (B, condition_channels, H, W) maps or (B, N, context_channels) tokens, as the
                network takes.

        Returns:
            (B, C, H, W).

        Raises:
            DataError: on a state, times or a condition of another shape.
        """
        return self.evaluate(y, torch.as_tensor(t, device=y.device) * TIME_SCALE, cond)

    def evaluate(self, y: Tensor, step: Tensor, cond: Tensor | None) -> Tensor:
        """The output at a diffusion step in [0, 1000], which may be fractional; otherwise like
        ``forward``."""
        check_shape(y, (self.channels, *self.resolution), "a state")
        dtype = self.head.weight.dtype
        time = self._time(times_of(step, y), dtype)
        maps, context = self._condition(y, cond, dtype)
        x = fold(maps.to(dtype), self.patch).contiguous(
            memory_format=torch.channels_last
        )
        x = self.stem(x)
        if self.table is not None:
            x = x + self.table.to(x.dtype)
        skips = [x]
        for block in self.down:
            x = run(block, self.gradient_checkpointing, x, time, context)
            skips.append(x)
        for block in self.middle:
            x = run(block, self.gradient_checkpointing, x, time, context)
        for block in self.up:
            x = run(
                block,
                self.gradient_checkpointing,
                torch.cat((x, skips.pop()), 1),
                time,
                context,
            )
        return unfold(self.head(activate(self.norm(x))), self.patch).to(y.dtype)

    def _attention(self, channels: int, head_channels: int) -> nn.Module:
        heads = channels // min(head_channels, channels)
        if self.context_channels:
            return ContextBlock(channels, heads, self.context_channels, self.groups)
        block = Attention(channels, heads, _EPS, self.groups)
        nn.init.zeros_(block.out.weight)
        nn.init.zeros_(block.out.bias)
        return block

    def _time(self, steps: Tensor, dtype: torch.dtype) -> Tensor:
        """SiLU of the time embedding, (B, 4 width), the first operation of every block."""
        half = torch.arange(self.width // 2, device=steps.device).float()
        turn = steps[:, None] * torch.exp(
            half * (-math.log(_LONGEST) / (self.width // 2))
        )
        return nn.functional.silu(
            self.time(torch.cat((turn.cos(), turn.sin()), 1).to(dtype))
        )

    def _condition(
        self, y: Tensor, cond: Tensor | None, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor | None]:
        """The state concatenated with the condition's maps, and the condition's tokens."""
        check_condition(
            cond,
            len(y),
            (self.condition_channels, *self.resolution),
            self.context_channels,
        )
        if cond is None:
            return y, None
        if self.condition_channels:
            return (torch.cat((y, cond.to(y.dtype)), 1), None)
        return (y, cond.to(dtype))


class Downsample(nn.Module):
    """Halves the rows and columns by a strided convolution.

    Args:
        channels: channels of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = WrapConv(channels, channels, stride=(2, 2), pad=(1, 1, 1, 1))

    def forward(
        self, x: Tensor, time: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        """(B, C, H, W) to (B, C, H / 2, W / 2)."""
        out: Tensor = self.conv(x)
        return out


class Upsample(nn.Module):
    """Doubles the rows and columns by nearest-neighbour upsampling and a convolution.

    Args:
        channels: channels of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = WrapConv(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C, 2 H, 2 W)."""
        out: Tensor = self.conv(
            nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")
        )
        return out


class _Stage(nn.Module):
    """A residual block, then optional attention, then optional resampling."""

    def __init__(
        self,
        residual: Residual,
        attention: nn.Module | None,
        resample: nn.Module | None,
    ) -> None:
        super().__init__()
        self.residual = residual
        self.attention = attention
        self.resample = resample

    def forward(self, x: Tensor, time: Tensor, context: Tensor | None = None) -> Tensor:
        """(B, C, H, W), SiLU of the time embedding (B, E) and the context tokens to (B, C', H',
        W')."""
        x = self.residual(x, time)
        if self.attention is not None:
            x = self.attention(x, context)
        if self.resample is not None:
            x = self.resample(x)
        return x


def _plan(widths: list[int], blocks: int) -> tuple[list[_Row], list[_Row]]:
    """The entries of the downward and of the upward path; each of the latter takes one skip
    connection."""
    if blocks > MOST_BLOCKS:  # a configuration may ask for 10^9
        raise ConfigError(f"{blocks} blocks a level", f"at most {MOST_BLOCKS}")
    down = []
    skips = [widths[0]]
    channels = widths[0]
    for level, width in enumerate(widths):
        for _ in range(blocks):
            down.append(_Row(channels, width, level))
            channels = width
            skips.append(channels)
        if level < len(widths) - 1:
            down.append(_Row(channels, channels, level, True))
            skips.append(channels)
    up = []
    for level, width in reversed(list(enumerate(widths))):
        for i in range(blocks + 1):
            up.append(
                _Row(channels + skips.pop(), width, level, bool(level) and i == blocks)
            )
            channels = width
    return down, up
