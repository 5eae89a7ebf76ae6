"""Drawing an image from coarse to fine: what came out at some cells says more of those between them.

Next to a dark cell of a car lies another one, and a pane of glass answers as a whole. Were every cell drawn by itself,
a wall would be as restless as leaves. So the cells of a lattice are drawn first, then those of a lattice twice as fine,
each by what its drawn neighbours were beside what had been expected of them. In training all cells are known, and the
product of their chances, which is that of the image, comes from one pass.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.models.convolution import WrapConv

LATTICES = (4, 8), (2, 4), (1, 2), (1, 1)
"""Rows and columns from one cell to the next, coarsest first; the last are all cells of an image."""


def on(lattice: tuple[int, int], x: Tensor) -> Tensor:
    """The cells of maps (B, C, H, W) that lie on a lattice; a view."""
    return x[..., :: lattice[0], :: lattice[1]]


def ratio(coarse: tuple[int, int], fine: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a lattice from one cell of a coarser one to the next."""
    return coarse[0] // fine[0], coarse[1] // fine[1]


class Neighbours(nn.Module):
    """What the cells of a lattice learn from those of the one before. It begins as nothing.

    Args:
        channels: of the cells' features.
        surprises: numbers that say what was unexpected of a cell.
        hidden: channels in between.
        steps: ``ratio`` of the lattice before to this one, each 1 or 2.
    """

    def __init__(self, channels: int, surprises: int, hidden: int, steps: tuple[int, int]) -> None:
        super().__init__()
        self.steps = steps
        self.own, self.others = nn.Conv2d(channels, hidden, 1), WrapConv(surprises, hidden, bias=False)
        self.answer = nn.Conv2d(hidden, channels, 1)
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, surprise: Tensor) -> Tensor:
        """Features (B, C, h, w) of this lattice, and surprises of the one before, to features (B, C, h, w)."""
        wide = surprise.new_zeros(*surprise.shape[:2], *x.shape[-2:])
        on(self.steps, wide)[:] = surprise
        out: Tensor = x + self.answer(F.silu(self.own(x) + self.others(wide.to(x.dtype))))
        return out
