"""The distributions that a decoder predicts for each cell, from which an image is sampled."""

from typing import NamedTuple

import torch
from torch import Tensor

from lidar_synth.generate.models.town_codec.planes import RangeMixture
from lidar_synth.generate.models.town_codec.reflectance import ZeroInflatedLogistic


class CellDistributions(NamedTuple):
    """The decoder's prediction for every cell.

    Args:
        surfaces: the range, given a return.
        readings: the other values, such as the reflectance, given a return.
        returned: (B, 1, H, W) logits of a return.
        classes: (B, K, H, W) logits of the label's codes; K = 0 without labels.
    """

    surfaces: RangeMixture
    readings: ZeroInflatedLogistic
    returned: Tensor
    classes: Tensor

    def sample(self, uniform_noise: Tensor | None) -> Tensor:
        """Returns (1 or 0) and readings, (B, 1 + V, H, W).

        Args:
            uniform_noise: (B, 2 + V, H, W) numbers in (0, 1); the first channel is for the range,
                the last for the return. None = the mode.
        """
        if uniform_noise is None:
            return torch.cat([(self.returned > 0).float(), self.readings.mode()], 1)
        returned = self.returned.float() + torch.logit(uniform_noise[:, -1:])
        return torch.cat([(returned > 0).float(), self.readings.sample(uniform_noise[:, 1:-1])], 1)

    def residual(self, seen: Tensor) -> Tensor:
        """(B, 1 + 2 V, H, W) observed minus predicted, in units of the predicted scale.

        Args:
            seen: (B, 1 + V, H, W) returns and readings as ``sample`` gives them.
        """
        returned = seen[:, :1]
        values = seen[:, 1:]
        off = torch.where(returned > 0, self.readings.residual(values), 0.0)
        return torch.cat([returned - torch.sigmoid(self.returned.float()), off], 1)
