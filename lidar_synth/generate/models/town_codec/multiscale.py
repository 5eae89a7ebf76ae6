"""Multi-scale autoregressive sampling: coarse cells first, then the cells between them given their
neighbours.

Neighbouring cells are correlated: a dark car is dark all over, and a window pane loses its returns
    as a whole. Sampled
independently, the cells of a wall would be as noisy as leaves. Therefore the cells of a coarse
lattice are sampled first, then those of a finer one, conditioned on the residuals (sampled minus
predicted) of their neighbours. In training all cells are known, so that one pass gives the exact
likelihood of the image.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.convolution import WrapConv

LATTICES = (4, 8), (2, 4), (1, 2), (1, 1)
"""Strides in rows and columns, coarsest first; the last lattice holds all cells."""


def at_lattice(lattice: tuple[int, int], x: Tensor) -> Tensor:
    """The cells of maps (B, C, H, W) that lie on a lattice; a view."""
    return x[..., :: lattice[0], :: lattice[1]]


def step_ratio(coarse: tuple[int, int], fine: tuple[int, int]) -> tuple[int, int]:
    """Stride of a coarse lattice in cells of a finer one."""
    return coarse[0] // fine[0], coarse[1] // fine[1]


class LatticeRefinement(nn.Module):
    """Updates the features of a lattice by the residuals of the next coarser one. Starts as the
    identity.

    Args:
        channels: of the features.
        residuals: channels of the residuals.
        hidden: channels in between.
        steps: ``step_ratio`` of the coarser lattice to this one, each 1 or 2.
    """

    def __init__(self, channels: int, residuals: int, hidden: int, steps: tuple[int, int]) -> None:
        super().__init__()
        self.steps = steps
        self.own = nn.Conv2d(channels, hidden, 1)
        self.others = WrapConv(residuals, hidden, bias=False)
        self.answer = nn.Conv2d(hidden, channels, 1)
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, residual: Tensor) -> Tensor:
        """Features (B, C, h, w) of this lattice and residuals (B, R, h', w') of the coarser one to
        features (B, C, h, w)."""
        wide = residual.new_zeros(*residual.shape[:2], *x.shape[-2:])
        at_lattice(self.steps, wide)[:] = residual
        out: Tensor = x + self.answer(F.silu(self.own(x) + self.others(wide.to(x.dtype))))
        return out
