"""What a decoder says of the cells of an image, which is drawn from it."""

from typing import NamedTuple

import torch
from torch import Tensor

from lidar_synth.models.town_codec.planes import Surfaces
from lidar_synth.models.town_codec.reflectance import Readings


class Heads(NamedTuple):
    """What the decoder says of every cell.

    Args:
        surfaces: what it may see, as if every cell had a return.
        readings: the other values, such as the reflectance.
        returned: (B, 1, H, W) logit of a return.
        classes: (B, K, H, W) logits of the label's codes; K = 0 without labels.
    """

    surfaces: Surfaces
    readings: Readings
    returned: Tensor
    classes: Tensor

    def drawn(self, chance: Tensor | None) -> Tensor:
        """(B, 1 + V, H, W) whether there is a return (1 or 0), and readings, by numbers (B, 2 + V, H, W) in (0, 1); the
        first is for the range. None = the likeliest."""
        if chance is None:
            return torch.cat([(self.returned > 0).float(), self.readings.likeliest()], 1)
        returned = self.returned.float() + torch.logit(chance[:, -1:])
        return torch.cat([(returned > 0).float(), self.readings.drawn(chance[:, 1:-1])], 1)

    def unexpected(self, seen: Tensor) -> Tensor:
        """(B, 1 + 2 V, H, W) how far what was seen, (B, 1 + V, H, W) as ``drawn`` has it, is from what was said."""
        returned, values = seen[:, :1], seen[:, 1:]
        off = torch.where(returned > 0, self.readings.unexpected(values), 0.0)
        return torch.cat([returned - torch.sigmoid(self.returned.float()), off], 1)
