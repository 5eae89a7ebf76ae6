"""Attention-weighted plane fitting: least squares over a neighbourhood of patches.

One patch of a few cells estimates the range of a wall to about a per cent, and neighbouring patches
with independent errors give a wall that bends. A joint fit is more accurate. With the azimuth p of
a ray, the tangent e of its elevation and s = 1 / (r cos(elevation)), every plane satisfies s = a
cos p + b sin p + c e with the same a, b and c for all rays. Each patch attends to its neighbours;
the attended values are the moments of the least-squares fit.
"""

import math

import torch
from torch import Tensor, nn

from lidar_synth.generate.models.attention import Grid, NeighbourhoodAttention

FEATURES = 16
"""Size of the learned part of queries and keys."""
ALIKE = 0.15
"""Relative difference of ranges at which an untrained network takes two patches for different
planes."""
RISE = 8.0
"""Scale of the tangents, which vary less over a few rows than azimuths do."""
RIDGE = 1e-4
"""Ridge regularisation towards a plane that faces the sensor, for neighbourhoods that do not
determine a slope."""


class PlaneFit(nn.Module):
    """Fits planes to the ranges that neighbouring patches predict.

    Args:
        channels: of the features of a patch.
        grid: rows and columns of patches; the columns are a full turn.
        patch: rows and columns of a patch.
        count: planes per patch.
        window: rows and columns of a neighbourhood, odd, in patches.
        rise: (H,) tangents of the elevations of the rows of cells; initial values of a parameter.
    """

    def __init__(
        self, channels: int, grid: Grid, patch: Grid, count: int, window: Grid, rise: Tensor
    ) -> None:
        super().__init__()
        self.grid = grid
        self.patch = patch
        self.count = count
        self.near = NeighbourhoodAttention(grid, window)
        self.look = nn.Conv2d(channels, count * (2 * FEATURES + 1), 1)
        self.strict = nn.Parameter(torch.full((count, 1), -2 * math.log(ALIKE) - math.log(2)))
        self.rise = nn.Parameter(rise.float())
        nn.init.normal_(self.look.weight, std=0.02)
        nn.init.zeros_(self.look.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Ranges of the fitted planes, and the weight of the fit.

        Args:
            x: (B, C, h, w) features.
            distance: (B, K, h, w) logarithms of the ranges (metres) that each patch predicts for
                its centre.

        Returns:
            (B, K, H, W) inverse ranges of the fitted planes, and (B, K, h, w) weights in (0, 1) of
            the fit against the patch's own prediction.
        """
        seen, shown, trust = (
            self.look(x).float().unflatten(1, (self.count, -1)).split([FEATURES, FEATURES, 1], 2)
        )
        # -k (d - d')^2, up to a term that is the same for all keys, is a scalar product too.
        strict = self.strict.float().exp()
        far = _tokens(distance[:, :, None])
        query = torch.cat([_tokens(seen), 2 * strict * far, torch.ones_like(far)], -1)
        key = torch.cat([_tokens(shown), far, -strict * far**2], -1)
        rise = self.rise.float().view(-1, self.patch[0]).mean(1, keepdim=True).expand(self.grid)
        azimuth = (
            torch.arange(self.grid[1], device=x.device) * (2 * math.pi / self.grid[1])
        ).expand(self.grid)
        cos, sin, up = (
            z.flatten()[:, None, None] for z in (azimuth.cos(), azimuth.sin(), RISE * rise)
        )
        inverse = torch.exp(-far) * (1 + (up / RISE) ** 2).sqrt()
        places = [
            z.expand_as(inverse)
            for z in (cos * cos, cos * sin, sin * sin, cos * up, sin * up, up * up)
        ]
        found = self.near(
            query, key, torch.cat([*places, cos * inverse, sin * inverse, up * inverse], -1)
        )
        plane = [
            z[..., 0].transpose(1, 2).reshape(*distance.shape)
            for z in _fit(found, cos, sin, up, inverse)
        ]
        return self._cells(*plane), trust[:, :, 0].sigmoid()

    def _cells(self, facing: Tensor, across: Tensor, climb: Tensor) -> Tensor:
        """The inverse ranges (B, K, H, W) of planes (B, K, h, w), each given in the frame of its
        patch."""
        rows, columns = self.patch
        offset = torch.arange(columns, device=facing.device) - (columns - 1) / 2
        turn = (offset * (2 * math.pi / (self.grid[1] * columns))).repeat(self.grid[1])
        a, b, c = (
            z.repeat_interleave(rows, -2).repeat_interleave(columns, -1)
            for z in (facing, across, climb)
        )
        rise = self.rise.float()[:, None]
        return (a * turn.cos() + b * turn.sin() + c * RISE * rise) / (1 + rise**2).sqrt()


def _tokens(x: Tensor) -> Tensor:
    """(B, K, D, h, w) as (B, N, K, D)."""
    return x.flatten(3).permute(0, 3, 1, 2)


def _fit(
    found: Tensor, cos: Tensor, sin: Tensor, up: Tensor, alone: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Planes (B, N, K, 1) from moments (B, N, K, 9), in frames rotated to the azimuths of ``cos``
    and ``sin``. Where the moments do not determine a plane, it faces the sensor at the patch's own
    range."""
    cc, cs, ss, cu, su, uu, ci, si, ui = torch.split(found, 1, -1)
    m00 = cos * cos * cc + 2 * cos * sin * cs + sin * sin * ss + RIDGE
    m01 = (cos * cos - sin * sin) * cs + cos * sin * (ss - cc)
    m11 = sin * sin * cc - 2 * cos * sin * cs + cos * cos * ss + RIDGE
    m02 = cos * cu + sin * su
    m12 = cos * su - sin * cu
    m22 = uu + RIDGE
    y0 = cos * ci + sin * si + RIDGE * alone
    y1 = cos * si - sin * ci
    y2 = ui
    # Gaussian elimination; the matrix is positive definite.
    below = m01 / m00
    last = m02 / m00
    m11 = m11 - below * m01
    m12 = m12 - below * m02
    m22 = m22 - last * m02
    y1 = y1 - below * y0
    y2 = y2 - last * y0
    last = m12 / m11
    climb = (y2 - last * y1) / (m22 - last * m12)
    across = (y1 - m12 * climb) / m11
    return (y0 - m01 * across - m02 * climb) / m00, across, climb
