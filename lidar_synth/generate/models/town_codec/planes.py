"""Ranges as planes: each patch of a range image predicts a few planes, and each cell chooses among
them.

Seen from the sensor, the inverse range of a plane is linear in the ray's direction: of n . x = d,
along x = r u, follows 1 / r = n . u / d. Within a patch of a few cells the direction is linear in
row and column, so that three numbers describe a plane. Walls and roads come out straight, and edges
stay sharp.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar_synth.generate.models.town_codec.plane_fit import PlaneFit
from lidar_synth.geometry.normalize import Normalisation

SLOPES = 0.3, 0.1
"""Relative change of the inverse range per row and per column for a slope of 1."""
SPREADS = 5e-3, 0.3
"""Limits of the predicted scale, in normalised range. With a smaller lower limit, the road, which
is easy, would dominate the loss."""


class RangeMixture(NamedTuple):
    """A mixture of K Laplace distributions over the range of each cell.

    Args:
        values: (B, K, H, W) normalised ranges: the centres.
        spreads: (B, K, H, W) logarithms of the scales.
        chosen: (B, K, H, W) logits of the mixture weights.
    """

    values: Tensor
    spreads: Tensor
    chosen: Tensor

    def nll(self, x: Tensor) -> Tensor:
        """(B, 1, H, W) negative log-likelihood of normalised ranges (B, 1, H, W)."""
        density = self.chosen.log_softmax(1) + laplace_log_density(x, self.values, self.spreads)
        return -density.logsumexp(1, keepdim=True)

    def mode(self) -> Tensor:
        """(B, 1, H, W) the centre of the component with the largest weight."""
        return self.values.gather(1, self.chosen.argmax(1, keepdim=True))


def laplace_log_density(x: Tensor, middle: Tensor, spread: Tensor) -> Tensor:
    """Log density at ``x`` of Laplace distributions; ``spread`` is the logarithm of their scale."""
    return -(x - middle).abs() * torch.exp(-spread) - spread - math.log(2)


def laplace_noise(uniform_noise: Tensor) -> Tensor:
    """Uniform numbers in (0, 1) to samples of the Laplace distribution of scale 1."""
    off = uniform_noise - 0.5
    return -off.sign() * torch.log1p(-2 * off.abs())


class Planes(nn.Module):
    """Predicts the planes of each patch, and their ranges in its cells.

    Args:
        channels: of the map, one cell per patch.
        patch: rows and columns of a patch.
        count: planes per patch.
        normalisation: of the ranges.
        consensus: plane fit over neighbouring patches; None = each patch by itself.
    """

    def __init__(
        self,
        channels: int,
        patch: tuple[int, int],
        count: int,
        normalisation: Normalisation,
        consensus: PlaneFit | None = None,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.normalisation = normalisation
        self.consensus = consensus
        self.planes = nn.Conv2d(channels, 4 * count, 1)
        nn.init.normal_(self.planes.weight, std=0.02)
        with torch.no_grad():  # starts near and far, facing the sensor, with a wide scale
            start = self.planes.bias.zero_().view(count, 4)  # type: ignore[union-attr]
            start[:, 0] = torch.linspace(1.2, 4.0, count + 2)[1:-1]
            start[:, 3] = -3

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Maps (B, C, h, w) to normalised ranges and log spreads (B, count, H, W)."""
        with torch.autocast(
            x.device.type, enabled=False
        ):  # bfloat16 would round off half a per cent of a range
            return self._ranges(x.to(self.planes.weight.dtype))

    def _ranges(self, x: Tensor) -> tuple[Tensor, Tensor]:
        distance, across, down, spread = self.planes(x).float().unflatten(1, (-1, 4)).unbind(2)
        distance = distance.clamp(-1, 5)
        i = _offsets(self.patch[0] * x.shape[-2], self.patch[0], x.device)[:, None]
        j = _offsets(self.patch[1] * x.shape[-1], self.patch[1], x.device)
        slopes = 1 + SLOPES[0] * self._up(down) * i + SLOPES[1] * self._up(across) * j
        inverse = self._up((-distance).exp()) * slopes.clamp_min(0.05)
        if self.consensus is not None:
            agreed, trust = self.consensus(x, distance)
            inverse = torch.lerp(inverse, agreed.float(), self._up(trust.float()))
        low = self.normalisation.range_min
        high = self.normalisation.range_max
        metres = 1 / inverse.clamp(1 / (0.999 * high), 1 / (1.001 * low))
        return self.normalisation.encode(metres), self._up(spread.clamp(*map(math.log, SPREADS)))

    def _up(self, x: Tensor) -> Tensor:
        """(B, K, h, w) as (B, K, H, W), the same for all cells of a patch."""
        return x.repeat_interleave(self.patch[0], -2).repeat_interleave(self.patch[1], -1)


def _offsets(size: int, patch: int, device: torch.device) -> Tensor:
    """(size,) where a cell lies in its patch, from its centre."""
    return torch.arange(size, device=device) % patch - (patch - 1) / 2
