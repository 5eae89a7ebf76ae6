"""Layers of convolutional networks over range images, whose columns wrap around and whose rows do
not.

Tensors have the memory format channels last, in which convolutions, norms and attention over tokens
need no copies on a CPU.
"""

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.models.attention import Grid

GROUPS = 32
"""Groups of a group norm, as in latent diffusion and LiDM. A group of a single channel removes the
channel's mean and, with it, the time embedding: networks with fewer than 64 channels need fewer
groups."""


class WrapConv(nn.Conv2d):
    """Convolution with circular padding of columns (a full turn) and zero padding of rows.

    Args:
        inputs, outputs: channels.
        kernel: rows and columns.
        stride: rows and columns.
        pad: columns to the left and to the right, rows above and below; by default the size is
            kept, with an odd column or row added to the right or below.
        bias: whether to add a bias.
        dilation: rows and columns between neighbouring weights of the kernel.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: Grid = (3, 3),
        stride: Grid = (1, 1),
        pad: tuple[int, int, int, int] | None = None,
        bias: bool = True,
        dilation: Grid = (1, 1),
    ) -> None:
        rows, columns = (d * (k - 1) for k, d in zip(kernel, dilation, strict=True))
        self.left, self.right, above, below = pad or (
            columns // 2,
            columns - columns // 2,
            rows // 2,
            rows - rows // 2,
        )
        # The convolution itself adds symmetric padding of rows, without a copy.
        self.below = 0 if above == below else below - above
        super().__init__(
            inputs,
            outputs,
            kernel,
            stride,
            padding=(above, 0),
            dilation=dilation,
            bias=bias,
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        if self.left or self.right:
            x = torch.cat(
                (x[..., x.shape[-1] - self.left :], x, x[..., : self.right]), -1
            )
        if self.below:
            x = F.pad(x, (0, 0, 0, self.below))
        return super().forward(x)


class Norm(nn.GroupNorm):
    """Group norm with the greatest common divisor of ``groups`` and the channels as number of
    groups."""

    def __init__(self, channels: int, eps: float, groups: int = GROUPS) -> None:
        super().__init__(math.gcd(groups, channels), channels, eps)


def activate(x: Tensor) -> Tensor:
    """SiLU, in place if gradients are disabled."""
    return F.silu(x, inplace=not torch.is_grad_enabled())


class Residual(nn.Module):
    """x + f(x), where f is two times norm, SiLU, convolution; the time embedding is added in
    between.

    Args:
        inputs, outputs: channels.
        kernel: rows and columns of both kernels.
        embedding: channels of the time embedding; 0 = none.
        eps, groups: arguments of the norms.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: Grid = (3, 3),
        embedding: int = 0,
        eps: float = 1e-6,
        groups: int = GROUPS,
    ) -> None:
        super().__init__()
        self.norm1 = Norm(inputs, eps, groups)
        self.conv1 = WrapConv(inputs, outputs, kernel)
        self.time = nn.Linear(embedding, outputs) if embedding else None
        self.norm2 = Norm(outputs, eps, groups)
        self.conv2 = WrapConv(outputs, outputs, kernel)
        self.shortcut = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else None
        if embedding:
            nn.init.zeros_(self.conv2.weight)
            nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, time: Tensor | None = None) -> Tensor:
        """(B, inputs, H, W) and, with an embedding, SiLU of it (B, E), to (B, outputs, H, W)."""
        h = self.conv1(activate(self.norm1(x)))
        if self.time is not None:
            h = h + self.time(time)[:, :, None, None]
        out: Tensor = self.conv2(activate(self.norm2(h))) + (
            x if self.shortcut is None else self.shortcut(x)
        )
        return out


class Attention(nn.Module):
    """x + self-attention over all cells.

    Args:
        channels: channels of a cell.
        heads: number of heads, a divisor of the channels.
        eps, groups: arguments of the norm.
    """

    def __init__(
        self, channels: int, heads: int = 1, eps: float = 1e-6, groups: int = GROUPS
    ) -> None:
        super().__init__()
        self.heads = heads
        self.norm = Norm(channels, eps, groups)
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, x: Tensor, context: Tensor | None = None) -> Tensor:
        """(B, C, H, W) to (B, C, H, W); ``context`` is ignored."""
        q, k, v = self.qkv(to_tokens(self.norm(x))).chunk(3, -1)
        return x + to_map(self.out(attend(q, k, v, self.heads)), x)


class ContextBlock(nn.Module):
    """x + a transformer block: self-attention over all cells, cross-attention to context tokens,
    gated feed-forward (the spatial transformer of Rombach et al., "High-Resolution Image Synthesis
    with Latent Diffusion Models", 2022).

    Args:
        channels: channels of a cell.
        heads: number of heads, a divisor of the channels.
        context: channels of a context token.
        groups: groups of the norm.
    """

    def __init__(
        self,
        channels: int,
        heads: int,
        context: int,
        groups: int = GROUPS,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.norm = Norm(channels, 1e-6, groups)
        self.enter = nn.Linear(channels, channels)
        self.leave = nn.Linear(channels, channels)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.out = nn.Linear(channels, channels)
        self.query = nn.Linear(channels, channels, bias=False)
        self.key_value = nn.Linear(context, 2 * channels, bias=False)
        self.context_out = nn.Linear(channels, channels)
        self.expand = nn.Linear(channels, 8 * channels)
        self.contract = nn.Linear(4 * channels, channels)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, x: Tensor, context: Tensor | None = None) -> Tensor:
        """(B, C, H, W) and the context (B, N, K) to (B, C, H, W)."""
        assert context is not None  # checked by the network
        h = self.enter(to_tokens(self.norm(x)))
        q, k, v = self.qkv(self.norms[0](h)).chunk(3, -1)
        h = h + self.out(attend(q, k, v, self.heads))
        k, v = self.key_value(context).chunk(2, -1)
        h = h + self.context_out(attend(self.query(self.norms[1](h)), k, v, self.heads))
        value, gate = self.expand(self.norms[2](h)).chunk(2, -1)
        h = h + self.contract(value * F.gelu(gate))
        return x + to_map(self.leave(h), x)


def attend(q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
    """softmax(q k^T / sqrt(D)) v of queries (B, N, heads D) and keys and values (B, M, heads D), as
    (B, N, heads D)."""
    q, k, v = (z.reshape(*z.shape[:2], heads, -1).transpose(1, 2) for z in (q, k, v))
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def to_tokens(x: Tensor) -> Tensor:
    """(B, C, H, W) to (B, H W, C), without a copy if the memory format is channels last."""
    return x.permute(0, 2, 3, 1).flatten(1, 2)


def to_map(tokens: Tensor, like: Tensor) -> Tensor:
    """(B, H W, C) to (B, C, H, W) with the rows and columns of ``like``, channels last."""
    return tokens.reshape(len(tokens), *like.shape[2:], -1).permute(0, 3, 1, 2)


def fold(x: Tensor, patch: Grid) -> Tensor:
    """(B, C, H, W) to (B, C p q, H / p, W / q): the cells of a patch become channels. Channels
    last."""
    batch, channels, rows, columns = x.shape
    x = x.reshape(
        batch, channels, rows // patch[0], patch[0], columns // patch[1], patch[1]
    )
    return x.permute(0, 2, 4, 1, 3, 5).flatten(3).permute(0, 3, 1, 2)


def unfold(x: Tensor, patch: Grid) -> Tensor:
    """(B, C p q, H / p, W / q) to (B, C, H, W), the inverse of ``fold``."""
    x = x.reshape(len(x), -1, *patch, *x.shape[2:])  # (B, C, p, q, h, w)
    return x.permute(0, 1, 4, 2, 5, 3).flatten(4).flatten(2, 3)


def run(block: nn.Module, checkpointing: bool, *inputs: Any) -> Tensor:
    """The output of a block; with ``checkpointing``, its activations are recomputed in the backward
    pass."""
    if checkpointing and torch.is_grad_enabled():
        return cast(Tensor, checkpoint(block, *inputs, use_reentrant=False))
    return cast(Tensor, block(*inputs))


def pair(values: Sequence[int]) -> Grid:
    """Rows and columns as a tuple; a checkpoint stores them as a list."""
    rows, columns = values
    return int(rows), int(columns)


def reduced(size: Grid, strides: Sequence[Grid], what: str) -> Grid:
    """Rows and columns after all strides; ``what`` names the image in an error.

    Raises:
        ConfigError: if the strides do not divide the size.
    """
    unit = math.prod(s[0] for s in strides), math.prod(s[1] for s in strides)
    if min(unit) < 1 or any(n < u or n % u for n, u in zip(size, unit, strict=True)):
        raise ConfigError(f"{what} of {size} rows and columns", f"multiples of {unit}")
    return size[0] // unit[0], size[1] // unit[1]


def halve(widths: Sequence[int]) -> nn.Sequential:
    """Convolutions of a camera image to features of these widths; each halves rows and columns."""
    body = nn.Sequential()
    for a, b in zip([3, *widths[:-1]], widths, strict=True):
        convolution = nn.Conv2d(a, b, 3, 2, 1, bias=False)
        body.extend([convolution, nn.BatchNorm2d(b), nn.SiLU()])
    return body


def check_shape(x: Tensor, shape: tuple[int, ...], what: str) -> None:
    """Check the shape of a batch; ``what`` names it in an error.

    Raises:
        DataError: if the shape is not (B, *shape).
    """
    if x.ndim != len(shape) + 1 or x.shape[1:] != shape:
        raise DataError(
            f"{what} of shape {tuple(x.shape)}", f"(B, {', '.join(map(str, shape))})"
        )


def times_of(t: Tensor | float, y: Tensor) -> Tensor:
    """(B,) float32 times of the states y (B, ...), from one for each or one for all.

    Raises:
        DataError: on another number of times.
    """
    t = torch.as_tensor(t, dtype=torch.float32, device=y.device)
    if t.shape not in ((), (1,), (len(y),)):
        raise DataError(
            f"times of shape {tuple(t.shape)} for {len(y)} states",
            "one time per state, or one for all",
        )
    return t.expand(len(y))


def check_condition(
    cond: Tensor | None, count: int, maps: tuple[int, int, int], tokens: int
) -> None:
    """Check the shape of a condition against what a network takes.

    Args:
        cond: the condition, or None.
        count: B, number of states.
        maps: channels, rows and columns of the maps that the network takes; 0 channels = no maps.
        tokens: channels of the tokens that the network takes; 0 = no tokens.

    Raises:
        DataError: on a missing or unexpected condition, or one of another shape.
    """
    given = (
        "no condition" if cond is None else f"a condition of shape {tuple(cond.shape)}"
    )
    if maps[0]:
        if cond is None or cond.shape != (count, *maps):
            raise DataError(given, str((count, *maps)))
    elif tokens:
        if (
            cond is None
            or cond.ndim != 3
            or (len(cond), cond.shape[2]) != (count, tokens)
        ):
            raise DataError(given, f"({count}, tokens, {tokens})")
    elif cond is not None:
        raise DataError(given, "none: the network takes no condition")
