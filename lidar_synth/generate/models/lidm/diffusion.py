"""A denoising diffusion U-Net as the velocity network of a rectified flow, without further
training.

LiDM's network predicts the noise e in x = a y0 + s e at an integer diffusion step, with a^2 + s^2 =
1 (Ho et al., "Denoising Diffusion Probabilistic Models", NeurIPS 2020). A state y = (1 - t) y0 + t
e of the rectified path has the same signal-to-noise ratio where s / a = t / (1 - t), and is the
same state up to scale::

    x = y / sqrt((1 - t)^2 + t^2)        a = (1 - t) / sqrt(...),  s = t / sqrt(...)
    v = e - y0 = (e - y) / (1 - t) = (y - y0') / t,     y0' = (x - s e) / a

This is exact at the times of the 1000 steps. Between two of them, the step is interpolated in log(s
/ a), in which the network's time embedding is smooth. Before the first and after the last step (t
below 0.037 and above 0.988 for LiDM), the network is evaluated at that step on the normalised
state, as samplers of diffusion models do at their start.
"""

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.lidm.unet import UNet


class DiffusionUNet(UNet):
    """Velocity network v(y, t, c) like ``UNet``, computed from the noise that its weights were
    trained to predict.

    Args:
        beta_start, beta_end: first and last variance of the schedule. The square roots of its
            variances are evenly spaced (latent diffusion calls this schedule "linear").
        steps: number of diffusion steps.
        arguments: arguments of ``UNet``.

    Raises:
        ConfigError: on values that do not fit together.
    """

    def __init__(
        self,
        beta_start: float = 0.0015,
        beta_end: float = 0.0195,
        steps: int = 1000,
        **arguments: Any,
    ) -> None:
        super().__init__(**arguments)
        if not 0 < beta_start <= beta_end < 1 or steps < 2:
            raise ConfigError(
                f"{steps} steps, betas {beta_start} to {beta_end}",
                "0 < start <= end < 1, at least 2 steps",
            )
        self.schedule = beta_start, beta_end, steps

    def forward(
        self, y: Tensor, t: Tensor | float, cond: Tensor | None = None
    ) -> Tensor:
        """The velocity dy/dt at y and t; arguments and result are those of ``UNet``."""
        t = torch.as_tensor(t, dtype=torch.float32, device=y.device)
        times = _times_on(y.device, *self.schedule)
        time = t.double().reshape(-1, *[1] * (y.ndim - 1))
        x = y.double() / ((1 - time) ** 2 + time**2).sqrt()
        noise = self.evaluate(x.to(y.dtype), step_of(t, times), cond).double()
        known = time.clamp(times[0], times[-1])  # the range of the schedule
        data = (x * ((1 - known) ** 2 + known**2).sqrt() - known * noise) / (1 - known)
        return torch.where(time < 0.5, (noise - y) / (1 - time), (y - data) / time).to(
            y.dtype
        )


def schedule_times(beta_start: float, beta_end: float, steps: int) -> Tensor:
    """(steps,) float64 times of the rectified path that have the signal-to-noise ratios of the
    diffusion steps."""
    betas = torch.linspace(
        beta_start**0.5, beta_end**0.5, steps, dtype=torch.float64, device="cpu"
    ).square()
    signal = (1 - betas).cumprod(0)
    return (1 - signal).sqrt() / (signal.sqrt() + (1 - signal).sqrt())


@lru_cache
def _times_on(device: torch.device, *schedule: Any) -> Tensor:
    """``schedule_times`` on a device, which is not asked to wait for them at every evaluation."""
    return schedule_times(*schedule).to(device)


def step_of(t: Tensor, times: Tensor) -> Tensor:
    """The diffusion step at each time, float32, interpolated in the logarithm of the
    signal-to-noise ratio.

    Args:
        t: times of any shape, within [0, 1]; they are clamped to the range of ``times``.
        times: (steps,) ascending times of the steps.
    """
    ratio = torch.logit(t.double().clamp(times[0], times[-1]))
    ratios = torch.logit(times)
    above = torch.searchsorted(ratios, ratio.contiguous()).clamp(1, len(times) - 1)
    low = ratios[above - 1]
    high = ratios[above]
    return (above - 1 + (ratio - low) / (high - low)).float()
