"""A codebook: vectors are quantised to the nearest code, and codes are trained to follow their
vectors."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import to_map, to_tokens
from lidar_synth.generate.models.layers import PIECE

CODEBOOKS = ("gradient", "ema")
"""How codes are trained: by the gradient of the distance, or as exponential moving averages of
their vectors."""

DECAY = 0.99
"""Decay of the moving averages, per batch."""

# Average vectors per batch below which a code of an "ema" codebook is dead and is reset.
_LEAST = 0.03


class Codebook(nn.Module):
    """Vector quantisation (van den Oord et al., "Neural Discrete Representation Learning", NeurIPS
    2017).

    Args:
        count: number of codes; 0 = no quantisation.
        channels: K, channels of a code.
        kind: one of ``CODEBOOKS``.
    """

    counts: Tensor
    sums: Tensor

    def __init__(self, count: int, channels: int, kind: str) -> None:
        super().__init__()
        self.codes = nn.Parameter(
            torch.empty(count, channels), requires_grad=kind == "gradient" and count > 0
        )
        if count:
            nn.init.uniform_(self.codes, -1 / count, 1 / count)
        moving = count if kind == "ema" else 0
        self.register_buffer("counts", torch.zeros(moving))
        self.register_buffer("sums", torch.zeros(moving, channels))

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
    def follow(self, z: Tensor, index: Tensor) -> None:
        """Update the codes of an "ema" codebook by the maps (B, K, h, w) that ``index`` (B, h w)
        assigns to them."""
        if not len(self.counts):
            return
        tokens = to_tokens(z).flatten(0, 1).float()
        index = index.flatten()
        counts = torch.bincount(index, minlength=len(self)).to(tokens.dtype)
        sums = torch.zeros_like(self.sums).index_add_(0, index, tokens)
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(counts)
            torch.distributed.all_reduce(sums)
        self.counts.lerp_(counts, 1 - DECAY)
        self.sums.lerp_(sums, 1 - DECAY)
        self._replace_dead(tokens)
        self.codes.copy_(self.sums / self.counts[:, None])

    def _replace_dead(self, tokens: Tensor) -> None:
        """Give codes that are hardly used new sums and counts, from vectors (N, K) of a batch."""
        dead = self.counts < _LEAST
        # Evenly spaced vectors of the batch replace dead codes: a deterministic choice.
        places = torch.linspace(
            0, len(tokens) - 1, len(self), device=tokens.device
        ).long()
        # Without an index by ``dead``, whose number of entries a GPU would have to be asked for.
        self.sums.copy_(torch.where(dead[:, None], tokens[places], self.sums))
        self.counts.masked_fill_(dead, 1.0)


@torch.no_grad()
def follow(z: Tensor, shift: Tensor, scale: Tensor) -> None:
    """Update running mean and standard deviation (K,) by those of z (B, K, h, w), in place."""
    spread, mean = torch.std_mean(z.float(), (0, 2, 3))
    fresh = (scale == 1).all() & (shift == 0).all()
    share = torch.where(fresh, 1.0, 1 - DECAY)
    shift.lerp_(mean, share)
    scale.lerp_(spread.clamp(min=1e-4), share)
