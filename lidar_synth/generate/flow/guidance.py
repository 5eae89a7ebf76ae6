"""Guidance of a velocity: by its condition, and by a weaker velocity (autoguidance)."""

from typing import Any

import torch
from torch import Tensor

from lidar_synth.generate.flow.path import Velocity, per_sample


def guide(velocity: Velocity, scale: float, blank: Tensor) -> Velocity:
    """Classifier-free guidance (Ho and Salimans, 2022): v(y, t, blank) + scale (v(y, t, c) - v(y,
    t, blank)).

    Args:
        velocity: a velocity trained with conditions and, with some probability, with blank ones.
        scale: 1 = no guidance; larger scales follow the condition more closely, with less
            diversity.
        blank: (...) the blank condition of one sample, as ``velocity`` takes it.
    """

    def guided_velocity(y: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        blanks = blank.expand(len(y), *blank.shape)
        # One evaluation of twice the batch, so that the network computes what does not depend on
        # the batch once.
        both = velocity(
            torch.cat((y, y)), torch.cat((t, t)), torch.cat((cond, blanks.to(cond)))
        )
        with_condition, without = both.chunk(2)
        return torch.lerp(without, with_condition, scale)

    return velocity if scale == 1 else guided_velocity


def autoguide(
    velocity: Velocity,
    weaker: Velocity,
    scale: float,
    within: tuple[float, float] = (0.0, 1.0),
) -> Velocity:
    """Autoguidance (Karras et al., "Guiding a Diffusion Model with a Bad Version of Itself",
    NeurIPS 2024): v_weaker + scale (v - v_weaker), which reduces errors that both share, with or
    without a condition.

    Args:
        velocity: the velocity to guide.
        weaker: a velocity for the same data and conditions with larger errors of the same kind:
            from a smaller network, or one trained for fewer iterations.
        scale: 1 = no guidance.
        within: smallest and largest time with guidance; guidance at high noise reduces diversity
            (Kynkaanniemi et al., "Applying Guidance in a Limited Interval", NeurIPS 2024).
    """
    low, high = within

    def guided_velocity(y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
        scales = torch.where((t >= low) & (t <= high), scale, 1.0)
        base = weaker(y, t, cond)
        return base + per_sample(scales, y) * (velocity(y, t, cond) - base)

    return velocity if scale == 1 else guided_velocity
