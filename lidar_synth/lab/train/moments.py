"""The moments of the states of few steps, matched to those of more.

One step from noise gives little more than the mean of what the noise may become, so its states vary
less than those of four steps: in the shipped ``town`` by 2 to 10 % a channel.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lidar_synth.generate.checkpoint import Header
from lidar_synth.generate.flow.solvers import mean_velocity, solve

BATCH = 8
"""Number of samples at a time."""


@torch.no_grad()
def measure_matches(
    network: nn.Module, header: Header, noise: Tensor, conditions: Tensor | None
) -> dict[str, Any]:
    """The ``matches`` of a header: ``match_moments`` of states in fewer steps and of those in the
    steps of ``time_grid``.

    Args:
        network: v(y, t, c, end).
        header: of the student.
        noise: (B, *state) noise, on the network's device.
        conditions: (B, ...) conditions; None if unconditional.
    """

    def states(grid: Sequence[float]) -> Tensor:
        velocity = mean_velocity(network, grid)
        made = []
        for part in torch.arange(len(noise)).split(BATCH):  # type: ignore[no-untyped-call]
            cond = None if conditions is None else conditions[part].to(noise.device)
            made.append(solve(velocity, noise[part], grid, cond=cond))
        return torch.cat(made)

    wanted = states(header.time_grid)
    return {
        str(len(grid) - 1): match_moments(states(grid), wanted).tolist()
        for grid in header.other_grids
    }


def match_moments(own: Tensor, wanted: Tensor) -> Tensor:
    """The scale and the shift that give states the means of others, and a little more than their
    standard deviations.

    Args:
        own: (B, C, H, W) states.
        wanted: (B, C, H, W) states whose means by channel and row they shall have.

    Returns:
        (2, C, H): ``own * scale[..., None] + shift[..., None]`` has these means; ``scale`` is the
        ratio of the standard deviations to the power of 1.5.
    """
    std, mean = torch.std_mean(own, (0, 3))
    wanted_std, wanted_mean = torch.std_mean(wanted, (0, 3))
    # More than 1, as details are what one step lacks most: docs/research/dense.md.
    scale = (wanted_std / std) ** 1.5
    return torch.stack((scale, wanted_mean - scale * mean))
