"""Zero-inflated reflectance: a logistic distribution with a separate probability of 0.

One return in eleven has reflectance 0 in KITTI-360, one in six in KITTI. A distribution with one
mode samples too few of them, or makes everything darker.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

BLANK = -1.0
"""The normalised value of 0."""
_SURE = 1e-6  # distance from 0 and 1 that keeps a logit finite


class ZeroInflatedLogistic(NamedTuple):
    """Per cell and channel: 0 with some probability, else a logistic distribution.

    Args:
        middles: (B, V, H, W) medians of the logistic distributions, normalised.
        spreads: (B, V, H, W) logarithms of their scales.
        blank: (B, V, H, W) logits of a 0.
    """

    middles: Tensor
    spreads: Tensor
    blank: Tensor

    def nll(self, x: Tensor) -> Tensor:
        """(B, V, H, W) negative log-likelihood of normalised values (B, V, H, W). The logistic mass
        below 0 counts as 0."""
        off = (x - self.middles) * torch.exp(-self.spreads)
        number = F.logsigmoid(-self.blank)
        below = torch.logaddexp(F.logsigmoid(self.blank), number + F.logsigmoid(off))
        density = number + F.logsigmoid(off) + F.logsigmoid(-off) - self.spreads
        return -torch.where(x > BLANK, density, below)

    def sample(self, uniform_noise: Tensor) -> Tensor:
        """(B, V, H, W) values from uniform numbers (B, V, H, W) in (0, 1), by the inverse
        distribution function."""
        blank = torch.sigmoid(self.blank)
        rest = ((uniform_noise - blank) / (1 - blank)).clamp(_SURE, 1 - _SURE)
        numbers = (self.middles + self.spreads.exp() * torch.logit(rest)).clamp(
            min=BLANK
        )
        return torch.where(uniform_noise < blank, BLANK, numbers)
