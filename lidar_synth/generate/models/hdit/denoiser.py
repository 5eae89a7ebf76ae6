"""HDiT that predicts the data instead of the velocity, for networks that are small relative to
their images.

The velocity contains the noise, which has as many degrees of freedom as the image has values;
tokens with fewer channels than their patch has values cannot represent it. The data have far fewer.
The network F therefore predicts the data, and only details that are finer than its prediction are
taken from the state (the preconditioning of Karras et al., "Elucidating the Design Space of
Diffusion-Based Generative Models", NeurIPS 2022, on the rectified path)::

    y0' = (1 - t) s^2 / d(t) y - t / sqrt(d(t)) F(y, t, c),      d(t) = (1 - t)^2 s^2 + t^2
    v   = (y - y0') / t = (t - (1 - t) s^2) / d(t) y + F(y, t, c) / sqrt(d(t))

where s is the standard deviation of these details.
"""

from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.hdit.hdit import HDiT


class Denoiser(HDiT):
    """Velocity network v(y, t, c) like ``HDiT``, computed from an estimate of the data.

    Args:
        detail: s, standard deviation of the details that are taken from the state, in normalised
            units.
        arguments: arguments of ``HDiT``.

    Raises:
        ConfigError: on values that do not fit together.
    """

    def __init__(self, detail: float = 0.1, **arguments: Any) -> None:
        super().__init__(**arguments)
        if not 0 < detail <= 1:
            raise ConfigError(f"detail {detail}", "0 < detail <= 1")
        self.detail = detail

    def forward(
        self,
        y: Tensor,
        t: Tensor | float,
        cond: Tensor | None = None,
        end: Tensor | float | None = None,
    ) -> Tensor:
        """The velocity dy/dt at y and t; arguments and result are those of ``HDiT``."""
        output = super().forward(y, t, cond, end)
        t = torch.as_tensor(t, device=y.device, dtype=torch.float32).reshape(
            -1, 1, 1, 1
        )
        data = (1 - t) * self.detail**2
        spread = (1 - t) * data + t**2
        return ((t - data) / spread * y + spread.rsqrt() * output).to(y.dtype)
