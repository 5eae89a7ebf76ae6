"""HDiT: an hourglass transformer that predicts the velocity of a range image.

The architecture is that of R2Flow (Nakashima et al., "Fast LiDAR Data Generation with Rectified
Flows", ICRA 2025) after Crowson et al., "Scalable High-Resolution Pixel-Space Image Synthesis with
Hourglass Diffusion Transformers", ICML 2024::

    image (B, C, H, W) -> tokens of 1 x 4 cells
      -> levels with neighbourhood attention; 2 x 2 tokens merge into one of twice the width
      -> the coarsest level with global attention
      -> back up through the levels, with skip connections
    -> velocity (B, C, H, W)

A condition is given in one of two forms: maps on the grid of the state, which are added to the
tokens (``condition_channels``), or tokens, to which those of the coarsest level attend
(``context_channels``). The layers of both are initialised to zero.
"""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models.attention import Grid, NeighbourhoodAttention
from lidar_synth.generate.models.convolution import (
    check_condition,
    check_shape,
    pair,
    run,
    times_of,
)
from lidar_synth.generate.models.hdit.transformer import (
    Expand,
    Level,
    Merge,
    TransformerBlock,
    from_patches,
    to_patches,
)
from lidar_synth.generate.models.layers import RMSNorm
from lidar_synth.generate.models.network import Network
from lidar_synth.generate.models.positions import (
    LEARNED,
    POSITIONS,
    AnglePosition,
    LearnedPosition,
    RayAngles,
    Rotary,
    StepEmbedding,
    TimeEmbedding,
)


class HDiT(Network):
    """Velocity network v(y, t, c) in the paper's convention: t = 1 noise, t = 0 data, v = y1 - y0.

    All arguments but ``angles`` are plain values, which a checkpoint stores. The network computes
    in the dtype of its weights (or of autocast) and returns the dtype of y.

    Args:
        resolution: H, W of the image; each a multiple of the patch times 2^(levels - 1).
        channels: C of the image.
        condition_channels: channels of a condition's maps on the same grid; 0 = no maps.
        context_channels: channels of a condition's tokens; 0 = no tokens.
        width: channels of a token at the finest level; each further level has twice as many.
        time_width: channels of the time embedding, even.
        depths: blocks per level, finest first; all levels but the last have as many again on the
            way up.
        heads: attention heads per level.
        patch: rows and columns of cells in a token.
        window: rows and columns of tokens in a neighbourhood, odd.
        ratio: hidden channels per channel of the feed-forward layers.
        mapping_depth: layers of the mapping networks of time and position.
        position: one of ``POSITIONS``, the encoding that is added to the tokens.
        ends: whether it can be told the end of a step, and then predicts the mean velocity over it.
        angles: (2, H, W) elevation and azimuth of every cell, radians (``Sensor.ray_angles``); None
            if a checkpoint will be loaded.

    Raises:
        ConfigError: on values that do not fit together.
    """

    needs_ray_angles: ClassVar[bool] = True

    def __init__(
        self,
        resolution: Sequence[int],
        channels: int = 2,
        condition_channels: int = 0,
        context_channels: int = 0,
        width: int = 128,
        time_width: int = 256,
        depths: Sequence[int] = (3, 3, 3, 3),
        heads: Sequence[int] = (2, 4, 8, 16),
        patch: Sequence[int] = (1, 4),
        window: Sequence[int] = (3, 9),
        ratio: float = 3.0,
        mapping_depth: int = 2,
        position: str = LEARNED,
        ends: bool = False,
        angles: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.patch = pair(patch)
        self.window = pair(window)
        self.channels = channels
        self.condition_channels = condition_channels
        self.context_channels = context_channels
        self.grids = _grids(self.resolution, self.patch, len(depths))
        self.ends = ends
        """Whether it takes the end of a step."""
        self.gradient_checkpointing = False
        """Recompute the activations of the blocks in the backward pass instead of storing them."""
        _check(self.grids, width, heads, position)
        if angles is not None and angles.shape != (2, *self.resolution):
            raise ConfigError(
                f"ray angles of shape {tuple(angles.shape)}", f"{(2, *self.resolution)}"
            )

        widths = [width << i for i in range(len(depths))]
        cells = self.patch[0] * self.patch[1]
        self.angles = RayAngles(self.resolution, angles)
        self.position: nn.Module = (
            LearnedPosition(self.grids[0], width)
            if position == LEARNED
            else AnglePosition(position, self.grids[0], width, ratio, mapping_depth)
        )
        self.time = TimeEmbedding(time_width, ratio, mapping_depth)
        if ends:
            self.step = StepEmbedding(time_width)
        self.rotary = nn.ModuleList(
            Rotary(g, h, w // h)
            for g, h, w in zip(self.grids, heads, widths, strict=True)
        )
        self.near = nn.ModuleList(
            NeighbourhoodAttention(grid, self.window) for grid in self.grids[:-1]
        )
        self.tokenize = nn.Linear(cells * channels, width, bias=False)
        if condition_channels:
            self.tokenize_condition = nn.Linear(
                cells * condition_channels, width, bias=False
            )
            nn.init.zeros_(self.tokenize_condition.weight)

        def blocks(i: int, context: int = 0) -> nn.ModuleList:
            return nn.ModuleList(
                TransformerBlock(widths[i], time_width, heads[i], ratio, context)
                for _ in range(depths[i])
            )

        upper = range(len(depths) - 1)
        self.down = nn.ModuleList(blocks(i) for i in upper)
        self.merge = nn.ModuleList(Merge(widths[i]) for i in upper)
        self.middle = blocks(len(depths) - 1, context_channels)
        self.expand = nn.ModuleList(Expand(widths[i]) for i in upper)
        self.up = nn.ModuleList(blocks(i) for i in upper)
        self.norm = RMSNorm(width)
        self.detokenize = nn.Linear(width, cells * channels, bias=False)
        nn.init.zeros_(self.detokenize.weight)

    def forward(
        self,
        y: Tensor,
        t: Tensor | float,
        cond: Tensor | None = None,
        end: Tensor | float | None = None,
    ) -> Tensor:
        """The velocity dy/dt at y and t, or its mean from t to ``end``.

        Args:
            y: (B, C, H, W) state.
            t: (B,) times, or one for all states, in [0, 1]; 1 = noise.
            cond: (B, condition_channels, H, W) maps or (B, M, context_channels) tokens, as the
                network takes.
            end: (B,) times below t, or one for all; None = the velocity at t itself.

        Returns:
            (B, C, H, W).

        Raises:
            DataError: on a state, times or a condition of another shape, or on ends for a network
                without them.
        """
        self._check(y, cond)
        t = times_of(t, y)
        time = self.time(t)
        if end is not None:
            if not self.ends:
                raise DataError(
                    "the end of a step, for a network that was built without ends",
                    "a network with ends",
                )
            time = time + self.step(t - times_of(end, y))
        angles = self.angles(self.patch, len(self.grids))
        levels = [
            self._level(i, angle, self.tokenize.weight.dtype)
            for i, angle in enumerate(angles)
        ]
        place = self.position(angles[0]).flatten(0, 1)
        x = self.tokenize(self._patches(y)) + place
        if cond is not None and self.condition_channels:
            x = x + self.tokenize_condition(self._patches(cond))
        skips = []
        for i, merge in enumerate(self.merge):
            x = self._run(self.down[i], x, time, levels[i])
            skips.append(x)
            x = merge(x, self.grids[i])
        context = (
            cond.to(x.dtype) if cond is not None and self.context_channels else None
        )
        x = self._run(self.middle, x, time, levels[-1]._replace(context=context))
        for i in reversed(range(len(skips))):
            x = self.expand[i](x, skips.pop(), self.grids[i])
            x = self._run(self.up[i], x, time, levels[i])
        x = self.detokenize(self.norm(x))
        return from_patches(x, self.patch, self.resolution).movedim(-1, 1).to(y.dtype)

    def _level(self, i: int, angles: Tensor, dtype: torch.dtype) -> Level:
        """The inputs that the blocks of level i share, given the ray angles (2, rows, columns) of
        its tokens."""
        cosine, sine = self.rotary[i](angles)
        near = self.near[i] if i < len(self.near) else None
        # The elements of a ModuleList have no type.
        return Level(cosine.to(dtype), sine.to(dtype), near)  # type: ignore[arg-type]

    def _run(self, blocks: nn.Module, x: Tensor, time: Tensor, level: Level) -> Tensor:
        for block in blocks.children():
            x = run(block, self.gradient_checkpointing, x, time, level)
        return x

    def _patches(self, x: Tensor) -> Tensor:
        """(B, C, H, W) as tokens (B, N, C * cells)."""
        return to_patches(x.movedim(1, -1).to(self.tokenize.weight.dtype), self.patch)

    def _check(self, y: Tensor, cond: Tensor | None) -> None:
        check_shape(y, (self.channels, *self.resolution), "a state")
        check_condition(
            cond,
            len(y),
            (self.condition_channels, *self.resolution),
            self.context_channels,
        )


def _grids(resolution: Grid, patch: Grid, levels: int) -> list[Grid]:
    """Rows and columns of tokens at each level, finest first."""
    unit = (patch[0] << (levels - 1), patch[1] << (levels - 1))
    if any(size < u or size % u for size, u in zip(resolution, unit, strict=True)):
        raise ConfigError(
            f"resolution {resolution}",
            f"multiples of {unit}: patches of {patch} that merge 2 x 2 {levels - 1} times",
        )
    rows = resolution[0] // patch[0]
    columns = resolution[1] // patch[1]
    return [(rows >> i, columns >> i) for i in range(levels)]


def _check(grids: list[Grid], width: int, heads: Sequence[int], position: str) -> None:
    if position not in POSITIONS:
        raise ConfigError(f"position {position!r}", f"one of {', '.join(POSITIONS)}")
    if len(heads) != len(grids) or any(
        (width << i) % (4 * h) for i, h in enumerate(heads)
    ):
        raise ConfigError(
            f"heads {tuple(heads)} for width {width} and {len(grids)} levels",
            "for each level a number that divides its width into multiples of 4",
        )
