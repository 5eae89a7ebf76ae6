"""Relief of plants: bumps that are wider than a patch, which no latent can hold and which are
therefore drawn.

The error of a predicted range has two causes. On a wall it is doubt: the plane lies elsewhere, and
drawing that would bend the wall. On grass and leaves it is relief, correlated over several columns,
and a surface without it is smoother than any real one. The relief of a cell is a sum of fields of
standard normal values, each with its own correlation along the columns. Rows of one patch share
their values.
"""

import math

import torch
from torch import Tensor

from lidar_synth.generate.models.surface_codec.blocks import PATCH

SPANS = 4, 16
"""Columns between the independent values of the fields. Each divides the columns of any image."""


def relief_fields(uniform_noise: Tensor, merged: int) -> Tensor:
    """The fields of relief.

    Args:
        uniform_noise: (B, H, W') numbers in (0, 1), of which those in the second rows of patches
            are used.
        merged: columns of the full image that are one here, a divisor of all ``SPANS``.

    Returns:
        (B, F, H, W') fields; every value is standard normal.
    """
    rows = uniform_noise[:, 1 :: PATCH[0]]
    fields = []
    for first, span in enumerate(SPANS):
        step = span // merged
        # no number is used twice
        nodes = to_normal(rows[..., first::step]).unsqueeze(-1)
        turn = torch.arange(step, device=rows.device).float() * (math.pi / 2 / step)
        fields.append(
            (nodes * turn.cos() + nodes.roll(-1, -2) * turn.sin()).flatten(-2)
        )
    return torch.stack(fields, 1).repeat_interleave(PATCH[0], -2)


def to_normal(uniform_noise: Tensor) -> Tensor:
    """Uniform numbers in (0, 1) to standard normal ones; eight times as fast as
    ``torch.special.ndtri`` on a CPU."""
    return math.sqrt(2) * torch.erfinv(2 * uniform_noise - 1)


def correlation(span: int, lag: int) -> float:
    """The correlation of the values of a field whose columns are ``lag`` apart, averaged over all
    places."""
    turn = [column * math.pi / 2 / span for column in range(span)]
    total = 0.0
    for column in range(span):
        nodes, other = divmod(column + lag, span)
        if nodes == 0:
            total += math.cos(turn[column] - turn[other])
        elif nodes == 1:
            total += math.sin(turn[column]) * math.cos(turn[other])
    return total / span
