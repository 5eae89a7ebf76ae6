"""Layers of a transformer over range images: attention, feed-forward, and changes of resolution."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar_synth.generate.models.attention import (
    Grid,
    NeighbourhoodAttention,
    attention,
)
from lidar_synth.generate.models.convolution import attend
from lidar_synth.generate.models.layers import (
    EPS,
    AdaRMSNorm,
    GatedFeedForward,
    RMSNorm,
    piece_length,
    rms_norm,
)
from lidar_synth.generate.models.positions import rotate


class Level(NamedTuple):
    """Inputs that the blocks of one resolution share.

    Args:
        cosine, sine: (N, heads, D / 2) rotation of each token.
        near: neighbourhood attention; None for global attention.
        context: (B, M, K) tokens of a condition, or None.
    """

    cosine: Tensor
    sine: Tensor
    near: NeighbourhoodAttention | None
    context: Tensor | None = None


class SelfAttention(nn.Module):
    """Residual attention with normalised queries and keys and a learned temperature per head.

    Args:
        dim: C, channels of a token.
        embedding: E, channels of the time embedding.
        heads: number of heads.
    """

    def __init__(self, dim: int, embedding: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = AdaRMSNorm(dim, embedding)
        self.temperature = nn.Parameter(torch.full((heads, 1), math.log(10.0)))
        self.qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.out = nn.Linear(dim, dim, bias=False)
        nn.init.zeros_(self.out.weight)

    def forward(self, x: Tensor, time: Tensor, level: Level) -> Tensor:
        """Tokens (B, N, C) and time (B, E) to (B, N, C)."""
        length = piece_length(x, x.shape[1], len(x) * self.qkv.out_features)
        tables = zip(
            torch.split(level.cosine, length),
            torch.split(level.sine, length),
            strict=True,
        )
        pieces = [
            self._project(p, time, *t)
            for p, t in zip(torch.split(x, length, 1), tables, strict=True)
        ]
        q, k, v = (torch.cat(z, 1) for z in zip(*pieces, strict=True))
        if level.near is not None:
            h = level.near(q, k, v)
        else:
            q, k, v = (z.transpose(1, 2) for z in (q, k, v))
            h = attention(q, k, v).transpose(1, 2)
        out: Tensor = x + self.out(h.flatten(2))
        return out

    def _project(
        self, x: Tensor, time: Tensor, cosine: Tensor, sine: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values (B, N, heads, D); q k^T includes the temperature."""
        q, k, v = (
            self.qkv(self.norm(x, time))
            .reshape(*x.shape[:2], 3, self.heads, -1)
            .unbind(2)
        )
        # A vector of root mean square 1 has the length sqrt(D).
        scale = self.temperature.clamp(max=math.log(100.0)).exp() / q.shape[-1]
        q = rms_norm(q, EPS**2)
        k = rms_norm(k, EPS**2)
        return (
            rotate(q * scale, cosine, sine).to(v.dtype),
            rotate(k, cosine, sine).to(v.dtype),
            v,
        )


class ContextAttention(nn.Module):
    """Residual attention to the tokens of a condition; begins at 0, so that the weights of an
    unconditional model are a start for a conditional one.

    Args:
        dim: C, channels of a token.
        embedding: E, channels of the time embedding.
        heads: number of heads.
        context: K, channels of a condition's token.
    """

    def __init__(self, dim: int, embedding: int, heads: int, context: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = AdaRMSNorm(dim, embedding)
        self.context_norm = RMSNorm(context)
        self.query = nn.Linear(dim, dim, bias=False)
        self.key_value = nn.Linear(context, 2 * dim, bias=False)
        self.out = nn.Linear(dim, dim, bias=False)
        nn.init.zeros_(self.out.weight)

    def forward(self, x: Tensor, time: Tensor, context: Tensor) -> Tensor:
        """Tokens (B, N, C), time (B, E) and a context (B, M, K) to (B, N, C)."""
        k, v = self.key_value(self.context_norm(context)).chunk(2, -1)
        out: Tensor = x + self.out(
            attend(self.query(self.norm(x, time)), k, v, self.heads)
        )
        return out


class FeedForward(nn.Module):
    """Residual gated feed-forward layer.

    Args:
        dim: C, channels of a token.
        embedding: E, channels of the time embedding.
        ratio: hidden channels per channel.
    """

    def __init__(self, dim: int, embedding: int, ratio: float) -> None:
        super().__init__()
        self.norm = AdaRMSNorm(dim, embedding)
        self.layer = GatedFeedForward(dim, ratio)

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """Tokens (B, N, C) and time (B, E) to (B, N, C)."""
        length = piece_length(x, x.shape[1], len(x) * self.layer.contract.in_features)
        return torch.cat(
            [p + self.layer(self.norm(p, time)) for p in torch.split(x, length, 1)], 1
        )


class TransformerBlock(nn.Module):
    """Self-attention, cross-attention if the context has channels, then feed-forward.

    The arguments are those of the three layers.
    """

    def __init__(
        self, dim: int, embedding: int, heads: int, ratio: float, context: int
    ) -> None:
        super().__init__()
        self.attention = SelfAttention(dim, embedding, heads)
        self.context_attention = (
            ContextAttention(dim, embedding, heads, context) if context else None
        )
        self.feed_forward = FeedForward(dim, embedding, ratio)

    def forward(self, x: Tensor, time: Tensor, level: Level) -> Tensor:
        """Tokens (B, N, C) and time (B, E) to (B, N, C)."""
        x = self.attention(x, time, level)
        if self.context_attention is not None and level.context is not None:
            x = self.context_attention(x, time, level.context)
        out: Tensor = self.feed_forward(x, time)
        return out


class Merge(nn.Module):
    """Merges 2 x 2 tokens of C channels into one of 2 C.

    Args:
        dim: C.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(4 * dim, 2 * dim, bias=False)

    def forward(self, x: Tensor, grid: Grid) -> Tensor:
        """(B, N, C) on the finer ``grid`` to (B, N / 4, 2 C)."""
        out: Tensor = self.linear(to_patches(x.reshape(len(x), *grid, -1), (2, 2)))
        return out


class Expand(nn.Module):
    """One token of 2 C channels to 2 x 2 of C, interpolated with the skip connection by a learned
    weight.

    Args:
        dim: C.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * dim, 4 * dim, bias=False)
        self.mix = nn.Parameter(torch.zeros(dim))

    def forward(self, x: Tensor, skip: Tensor, grid: Grid) -> Tensor:
        """(B, N / 4, 2 C) and ``skip`` (B, N, C) on the finer ``grid`` to (B, N, C)."""
        fine = from_patches(self.linear(x), (2, 2), grid).flatten(1, 2)
        return torch.lerp(skip, fine.to(skip.dtype), self.mix.sigmoid().to(skip.dtype))


def to_patches(x: Tensor, patch: Grid) -> Tensor:
    """(B, H, W, C) to (B, N, p q C), patches of p x q in row-major order."""
    batch, rows, columns, _ = x.shape
    x = x.reshape(batch, rows // patch[0], patch[0], columns // patch[1], patch[1], -1)
    return x.transpose(2, 3).flatten(3).flatten(1, 2)


def from_patches(x: Tensor, patch: Grid, resolution: Grid) -> Tensor:
    """(B, N, p q C) to (B, H, W, C), the inverse of ``to_patches``."""
    rows = resolution[0] // patch[0]
    columns = resolution[1] // patch[1]
    x = x.reshape(len(x), rows, columns, *patch, -1).transpose(2, 3)
    return x.reshape(len(x), *resolution, -1)
