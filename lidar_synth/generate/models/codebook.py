"""A codebook: vectors are quantised to the nearest code; a loss moves codes to their vectors."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import to_map, to_tokens
from lidar_synth.generate.models.layers import PIECE

DECAY = 0.99
"""Decay of running statistics, per batch."""


class Codebook(nn.Module):
    """Vector quantisation (van den Oord et al., "Neural Discrete Representation Learning", NeurIPS
    2017).

    Args:
        count: number of codes; 0 = no quantisation.
        channels: K, channels of a code.
    """

    def __init__(self, count: int, channels: int) -> None:
        super().__init__()
        self.codes = nn.Parameter(torch.empty(count, channels), requires_grad=count > 0)
        if count:
            nn.init.uniform_(self.codes, -1 / count, 1 / count)

    def __len__(self) -> int:
        return len(self.codes)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Maps (B, K, h, w) to the nearest codes, (B, K, h, w), and their indices, (B, h w)."""
        tokens = to_tokens(z)
        if not len(self):
            return z, tokens.new_zeros(tokens.shape[:2], dtype=torch.long)
        index = self.nearest(tokens.detach().flatten(0, 1)).view(tokens.shape[:2])
        return to_map(F.embedding(index, self.codes), z).to(z.dtype), index

    @torch.no_grad()
    def nearest(self, tokens: Tensor) -> Tensor:
        """(N, K) vectors to the (N,) indices of the nearest codes, which maximise z e - |e|^2 /
        2."""
        codes = self.codes.float()
        half = codes.square().sum(1) / -2
        length = (
            max(1, PIECE // len(codes)) if tokens.device.type == "cpu" else len(tokens)
        )
        pieces = torch.split(tokens.float(), length)
        with torch.autocast(tokens.device.type, enabled=False):
            return torch.cat(
                [torch.addmm(half, piece, codes.T).argmax(1) for piece in pieces]
            )


@torch.no_grad()
def follow(z: Tensor, shift: Tensor, scale: Tensor) -> None:
    """Update running mean and standard deviation (K,) by those of z (B, K, h, w), in place."""
    spread, mean = torch.std_mean(z.float(), (0, 2, 3))
    fresh = (scale == 1).all() & (shift == 0).all()
    share = torch.where(fresh, 1.0, 1 - DECAY)
    shift.lerp_(mean, share)
    scale.lerp_(spread.clamp(min=1e-4), share)
