"""Layers that networks share: a norm that time modulates, a gated feed-forward layer, a mapping network.

Tokens lie as (B, N, C), so that a linear layer is one matrix product and no copy.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from typing_extensions import Self

EPS = 1e-6
"""Added to a mean square before its root is divided by."""

PIECE = 1 << 20
"""Floats of the largest temporary array of one piece on a CPU: 4 MB. Memory in larger blocks goes back to the system
when it is freed, and each of its pages has to be asked for again."""


def piece_length(x: Tensor, items: int, floats: int) -> int:
    """How many of ``items`` to compute at once where each takes a temporary array of ``floats``.

    All of them where gradients are recorded, on an accelerator, and under ``torch.compile``.

    Args:
        x: a tensor of the computation, for its device.
    """
    if x.device.type != "cpu" or torch.is_grad_enabled() or torch.compiler.is_compiling():
        return items
    pieces = -(-items * floats // PIECE)
    return -(-items // pieces)


class Exact(nn.Module):
    """A module whose own buffers stay float32 when the network is moved to half precision.

    An angle of 3 rad in bfloat16 is off by up to 0.008; times the 128th harmonic that is a radian.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Seen as integers, the bits follow to another device, and no cast of floats applies to them.
        super()._apply(lambda t: fn(t.view(torch.int32)).view(torch.float32), recurse)  # type: ignore[no-untyped-call]
        return self


class RMSNorm(nn.Module):
    """RMS norm with a learned gain, g x / rms(x); unlike torch's, for every mixture of precisions.

    Args:
        dim: C, channels of a token.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        return F.rms_norm(x, x.shape[-1:], eps=EPS) * self.weight


class AdaRMSNorm(nn.Module):
    """RMS norm whose gain comes from the embedding of time: (1 + W e) x / rms(x).

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
        out: Tensor = F.rms_norm(x, x.shape[-1:], eps=EPS) * (1 + self.gain(time))[:, None]
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
        # Two products in place of one keep both halves contiguous: gelu is twice as fast on a CPU.
        value, gate = self.expand.weight.chunk(2)
        out: Tensor = self.contract(F.linear(x, value) * F.gelu(F.linear(x, gate)))
        return out


class Mapping(nn.Module):
    """Residual feed-forward layers between two norms, for the embeddings of time and place.

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
