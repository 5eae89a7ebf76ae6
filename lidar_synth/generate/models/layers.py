"""Layers shared by networks: a norm modulated by time, a gated feed-forward layer, a mapping
network.

Tokens are (B, N, C), so that a linear layer is one matrix product without a copy.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from typing_extensions import Self

EPS = 1e-6
"""Added to the mean square in RMS norms."""

PIECE = 1 << 20
"""Floats of the largest temporary array per piece on a CPU: 4 MB. Larger blocks are returned to the
system when they are freed, and allocating each page anew is slow."""


def piece_length(x: Tensor, items: int, floats: int) -> int:
    """The number of items to compute at once, so that temporary arrays stay within ``PIECE`` on a
    CPU.

    It is all items if gradients are recorded, on an accelerator, and under ``torch.compile``.

    Args:
        x: a tensor of the computation, which gives the device.
        items: number of items.
        floats: size of the temporary array per item.
    """
    if (
        x.device.type != "cpu"
        or torch.is_grad_enabled()
        or torch.compiler.is_compiling()
    ):
        return items
    pieces = -(-items * floats // PIECE)
    return -(-items // pieces)


def rms_norm(x: Tensor, eps: float = EPS) -> Tensor:
    """x / rms(x) over the last dimension (..., C)."""
    if (
        x.device.type != "cpu"
        or x.dtype != torch.float32
        or torch.is_grad_enabled()
        or torch.compiler.is_compiling()
    ):
        return F.rms_norm(x, x.shape[-1:], eps=eps)
    # Half as many passes over memory as torch's own on a CPU.
    square = torch.linalg.vector_norm(x, dim=-1, keepdim=True).square_()
    out: Tensor = x * square.div_(x.shape[-1]).add_(eps).rsqrt_()
    return out


def cell_norm(x: Tensor) -> Tensor:
    """RMS norm over the channels of each cell of (B, C, H, W)."""
    return rms_norm(x.movedim(1, -1)).movedim(-1, 1)


class Exact(nn.Module):
    """A module whose buffers stay float32 when the network is cast to half precision.

    An angle of 3 rad in bfloat16 has an error of up to 0.008 rad; in the 128th harmonic, that is
    one radian.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Viewed as integers, the buffers move between devices, but casts of floats do not apply to
        # them.
        super()._apply(  # type: ignore[no-untyped-call]
            lambda t: fn(t.view(torch.int32)).view(torch.float32), recurse
        )
        return self


class RMSNorm(nn.Module):
    """RMS norm with a learned gain, g x / rms(x). Unlike torch's, it accepts inputs and gains of
    different dtypes.

    Args:
        dim: C, channels of a token.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        return rms_norm(x) * self.weight


class AdaRMSNorm(nn.Module):
    """RMS norm whose gain is predicted from the time embedding e: (1 + W e) x / rms(x).

    Args:
        dim: C, channels of a token.
        embedding: E, channels of the time embedding.
    """

    def __init__(self, dim: int, embedding: int) -> None:
        super().__init__()
        self.gain = nn.Linear(embedding, dim, bias=False)
        nn.init.zeros_(self.gain.weight)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """x (B, N, C) and time (B, E) to (B, N, C)."""
        out: Tensor = rms_norm(x) * (1 + self.gain(time))[:, None]
        return out


class GatedFeedForward(nn.Module):
    """W2 (a gelu(b)) with (a, b) = W1 x (GEGLU; Shazeer, "GLU Variants Improve Transformer", 2020).

    Args:
        dim: C, channels in and out.
        ratio: hidden channels per channel.
    """

    def __init__(self, dim: int, ratio: float) -> None:
        super().__init__()
        hidden = int(dim * ratio)
        self.expand = nn.Linear(dim, 2 * hidden, bias=False)
        self.contract = nn.Linear(hidden, dim, bias=False)
        nn.init.zeros_(self.contract.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        # Two products instead of one keep both halves contiguous, which makes gelu twice as fast on
        # a CPU.
        value, gate = self.expand.weight.chunk(2)
        out: Tensor = self.contract(F.linear(x, value) * F.gelu(F.linear(x, gate)))
        return out


class Mapping(nn.Module):
    """Residual feed-forward layers between two norms, for the embeddings of time and position.

    Args:
        dim: C, channels in and out.
        ratio: hidden channels per channel.
        depth: number of feed-forward layers.
    """

    def __init__(self, dim: int, ratio: float, depth: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(RMSNorm(dim) for _ in range(depth + 2))
        self.layers = nn.ModuleList(GatedFeedForward(dim, ratio) for _ in range(depth))

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        first, *inner, last = self.norms
        x = first(x)
        for norm, layer in zip(inner, self.layers, strict=True):
            x = x + layer(norm(x))
        out: Tensor = last(x)
        return out


def normal_values(*shape: int, std: float = 1.0) -> Tensor:
    """Normally distributed initial values. On "meta" there are none: torch would import its
    compiler, which takes a second."""
    values = torch.empty(shape)
    return values if values.is_meta else values.normal_(std=std)
