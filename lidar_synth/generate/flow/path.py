"""Rectified flow: the path between noise and data, and the training targets of a velocity network.

With data y0, standard normal noise y1 and time t in [0, 1], t = 1 noise and t = 0 data (the paper's
preliminaries; Liu et al., "Flow Straight and Fast", ICLR 2023)::

    y_t = (1 - t) y0 + t y1                                   the path
    v   = y1 - y0                                             its velocity dy/dt
    L   = E_{y0, y1, t} m(v_theta(y_t, t, c), v)              flow matching, Eq. (1) and (3)

The network may be any callable ``v(y, t, cond)``. The importers translate other projects'
conventions of time and sign.

To add a training metric or a distribution of t: write the function and enter it in ``METRICS`` or
``TIMESTEPS``; the tests run over the dictionaries.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import DataError

Velocity = Callable[[Tensor, Tensor, Any], Tensor]
"""``v(y, t, cond)``: y (B, ...), t (B,) float32 in [0, 1], cond as the network takes it (None =
unconditional) -> dy/dt, of y's shape. Guidance wraps one velocity in another. A network with the
attribute ``ends`` can also be told (B,) times where the step ends, v(y, t, cond, end), and gives
the mean velocity until then."""

Metric = Callable[[Tensor, Tensor], Tensor]
"""The paper's m: two (B, ...) tensors of the same shape -> (B,) means over the elements of each
sample."""

PSEUDO_HUBER = 0.00054
"""R2Flow's coefficient: c = 0.00054 sqrt(elements of a sample), 0.1955 for 2x64x1024."""


@dataclass(frozen=True)
class Example:
    """One batch of supervision: at ``y`` and ``t``, the velocity network is trained to predict
    ``velocity``.

    Args:
        y: (B, ...) states.
        t: (B,) float32 times.
        velocity: (B, ...) targets.
        teacher_evaluations: number of teacher evaluations for the batch, one per sample and step.
        cond: the condition, (B, ...) or None.
        end: (B,) times up to which the target is the mean velocity, for a network that is told;
            None otherwise.
    """

    y: Tensor
    t: Tensor
    velocity: Tensor
    teacher_evaluations: int = 0
    cond: Any = None
    end: Tensor | None = None


def per_sample(t: Tensor, y: Tensor) -> Tensor:
    """Times (B,) as (B, 1, ..., 1) in the dtype of y (B, ...), for broadcasting."""
    return t.to(y.dtype).reshape(-1, *[1] * (y.ndim - 1))


def interpolate(y0: Tensor, y1: Tensor, t: Tensor) -> Tensor:
    """y_t = (1 - t) y0 + t y1 for y0, y1 (B, ...) and t (B,)."""
    t = per_sample(t, y0)
    return (1 - t) * y0 + t * y1


def flow_matching(y0: Tensor, y1: Tensor, t: Tensor) -> Example:
    """The supervision of a teacher, Eq. (1): y_t on the straight path, and its velocity y1 - y0.

    Args:
        y0: (B, ...) data.
        y1: (B, ...) noise.
        t: (B,) times, distributed by one of ``TIMESTEPS``.
    """
    return Example(interpolate(y0, y1, t), t, y1 - y0)


def velocity_loss(velocity: Velocity, example: Example, metric: Metric) -> Tensor:
    """E m(v_theta(y_t, t, c), v), the scalar loss of teachers and students."""
    return _errors(velocity, example, metric).mean()


def balanced_velocity_loss(
    velocity: Velocity, example: Example, metric: Metric
) -> Tensor:
    """``velocity_loss`` with each sample divided by its own error, so that long steps, whose errors
    are tens of times larger, do not outweigh short ones (Geng et al., "Mean Flows for One-step
    Generative Modeling", NeurIPS 2025: p = 1, c = 0.001)."""
    errors = _errors(velocity, example, metric)
    return (errors / (errors.detach() + 1e-3)).mean()


def _errors(velocity: Velocity, example: Example, metric: Metric) -> Tensor:
    rest = (example.cond,) if example.end is None else (example.cond, example.end)
    return metric(velocity(example.y, example.t, *rest), example.velocity)


def squared_l2(a: Tensor, b: Tensor) -> Tensor:
    """(B,) mean of (a - b)^2, the paper's metric for latent models and 1-RF teachers."""
    return _error(a, b).square().mean(1)


def l1(a: Tensor, b: Tensor) -> Tensor:
    """(B,) mean of |a - b|."""
    return _error(a, b).abs().mean(1)


def pseudo_huber(a: Tensor, b: Tensor, coefficient: float = PSEUDO_HUBER) -> Tensor:
    """(B,) mean of sqrt(e^2 + c^2) - c with e = a - b and c = coefficient sqrt(elements of a
    sample); the paper's metric for pixel models, from R2Flow and Song and Dhariwal (ICLR 2024)."""
    error = _error(a, b)
    c = coefficient * math.sqrt(error.shape[1])
    square = error.square()
    # Equals sqrt(e^2 + c^2) - c without cancellation: exactly 0 for no error, on every processor.
    return (square / ((square + c * c).sqrt() + c)).mean(1)


def _error(a: Tensor, b: Tensor) -> Tensor:
    """(B, elements) a - b in float32 or higher precision."""
    if a.shape != b.shape:
        raise DataError(
            f"a metric of shapes {tuple(a.shape)} and {tuple(b.shape)}",
            "one shape (B, ...)",
        )
    error = a - b
    return error.to(torch.promote_types(error.dtype, torch.float32)).flatten(1)


METRICS: dict[str, Metric] = {
    "squared_l2": squared_l2,
    "pseudo_huber": pseudo_huber,
    "l1": l1,
}
"""Training metrics m by name."""


def u_shaped(u: Tensor, sharpness: float = 4.0) -> Tensor:
    """Density proportional to cosh(a (t - 1/2)) with a = ``sharpness``, which is highest at both
    ends; for reflow (Lee et al., "Improving the Training of Rectified Flows", NeurIPS 2024)."""
    return 0.5 + torch.asinh((2 * u - 1) * math.sinh(sharpness / 2)) / sharpness


def logit_normal(u: Tensor, mean: float = 0.0) -> Tensor:
    """t = sigmoid(n) with normally distributed n (Esser et al., "Scaling Rectified Flow
    Transformers", ICML 2024)."""
    return torch.sigmoid(mean + torch.special.ndtri(u))


TIMESTEPS: dict[str, Callable[[Tensor], Tensor]] = {
    "uniform": lambda u: u,
    "u_shaped": u_shaped,
    "logit_normal": logit_normal,
    "logit_normal_shifted": lambda u: logit_normal(u, math.log(2)),
}
"""Distributions of t as quantile functions, from uniform numbers u in (0, 1) (``noise.uniform``) to
times of the same shape. With numbers keyed by (seed, index), training is reproducible.

"logit_normal_shifted" doubles the odds of noise, t / (1 - t) (Esser et al.'s shift of 2):
neighbouring cells of a range image are so strongly correlated that its layout is already determined
at high noise."""
