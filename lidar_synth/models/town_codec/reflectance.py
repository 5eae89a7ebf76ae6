"""What a sensor reads of a return beside its range, such as the reflectance: a number, or 0 for no visible reason.

One return in eleven reads 0 in scans of KITTI-360, one in six in KITTI's. A distribution with one peak makes too few of
them, or everything darker; so 0 has a chance of its own.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

BLANK = -1.0
"""A reading of 0, normalised."""
_FAR = 8.0  # scales of a reading that could hardly be less expected
_SURE = 1e-6  # how near to 0 and 1 a chance may come: its logit stays finite


class Readings(NamedTuple):
    """What each cell may read of V channels: 0, or a logistic distribution.

    Args:
        middles: (B, V, H, W) medians, normalised, of what is not 0.
        spreads: (B, V, H, W) logarithms of the distributions' scales.
        blank: (B, V, H, W) logits of a 0.
    """

    middles: Tensor
    spreads: Tensor
    blank: Tensor

    def surprise(self, x: Tensor) -> Tensor:
        """(B, V, H, W) negative log-likelihoods of normalised readings (B, V, H, W); what would lie below 0 reads 0."""
        off = (x - self.middles) * torch.exp(-self.spreads)
        number = F.logsigmoid(-self.blank)
        below = torch.logaddexp(F.logsigmoid(self.blank), number + F.logsigmoid(off))
        density = number + F.logsigmoid(off) + F.logsigmoid(-off) - self.spreads
        return -torch.where(x > BLANK, density, below)

    def unexpected(self, x: Tensor) -> Tensor:
        """(B, 2 V, H, W) how far readings (B, V, H, W) are from what was said: 0 or not, and the numbers in scales."""
        nothing = x <= BLANK
        off = ((x - self.middles) * torch.exp(-self.spreads)).clamp(-_FAR, _FAR) / 2
        return torch.cat([nothing.float() - torch.sigmoid(self.blank), torch.where(nothing, 0.0, off)], 1)

    def likeliest(self) -> Tensor:
        """(B, V, H, W) 0, or the median."""
        return torch.where(self.blank > 0, BLANK, self.middles)

    def drawn(self, chance: Tensor) -> Tensor:
        """(B, V, H, W) readings by as many numbers in (0, 1)."""
        blank = torch.sigmoid(self.blank)
        rest = ((chance - blank) / (1 - blank)).clamp(_SURE, 1 - _SURE)
        numbers = (self.middles + self.spreads.exp() * torch.logit(rest)).clamp(min=BLANK)
        return torch.where(chance < blank, BLANK, numbers)
