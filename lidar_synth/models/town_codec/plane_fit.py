"""Patches that see the same plane settle on it: least squares over a neighbourhood, weighted by attention.

A patch of a few cells sees too little of a wall to say how far it is to a per cent, and patches that are each off by
as much are a wall that bends. What they say together is better. With the azimuth p of a ray, the tangent e of its
elevation and s = 1 / (r cos(elevation)), every plane has s = a cos p + b sin p + c e, with the same a, b and c wherever
it is seen from the sensor. So each patch attends to those around it, and what it finds are the moments of a fit.
"""

import math

import torch
from torch import Tensor, nn

from lidar_synth.models.attention import Grid, NeighbourhoodAttention

FEATURES = 16
"""Numbers by which patches know each other."""
ALIKE = 0.15
"""Distances that differ by this share are on different planes, as far as a network knows that has not been trained."""
RISE = 8.0
"""Factor of tangents, which over a few rows differ less than azimuths do."""
RIDGE = 1e-4
"""Weight of a plane that faces the sensor, against neighbourhoods that say nothing of a slope."""


class Consensus(nn.Module):
    """Planes that neighbours agree on.

    Args:
        channels: of the features of a patch.
        grid: rows and columns of patches; the columns are a full turn.
        patch: rows and columns of a patch.
        count: planes per patch.
        window: rows and columns of a neighbourhood, odd, in patches.
        rise: (H,) tangents of the elevations of the rows of cells, to begin with.
    """

    def __init__(self, channels: int, grid: Grid, patch: Grid, count: int, window: Grid, rise: Tensor) -> None:
        super().__init__()
        self.grid, self.patch, self.count = grid, patch, count
        self.near = NeighbourhoodAttention(grid, window)
        self.look = nn.Conv2d(channels, count * (2 * FEATURES + 1), 1)
        self.strict = nn.Parameter(torch.full((count, 1), -2 * math.log(ALIKE) - math.log(2)))
        self.rise = nn.Parameter(rise.float())
        nn.init.normal_(self.look.weight, std=0.02)
        nn.init.zeros_(self.look.bias)  # type: ignore[arg-type]  # it has one

    def forward(self, x: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        """What neighbours agree on, and whether to follow them.

        Args:
            x: (B, C, h, w) features.
            distance: (B, K, h, w) logarithms of what each patch says of its middle by itself, metres.

        Returns:
            (B, K, H, W) inverse ranges and (B, K, h, w) shares in (0, 1).
        """
        seen, shown, trust = self.look(x).float().unflatten(1, (self.count, -1)).split([FEATURES, FEATURES, 1], 2)
        # -k (d - d')^2, but for what is the same for all keys, is a product too.
        strict, far = self.strict.float().exp(), _tokens(distance[:, :, None])
        query = torch.cat([_tokens(seen), 2 * strict * far, torch.ones_like(far)], -1)
        key = torch.cat([_tokens(shown), far, -strict * far**2], -1)
        rise = self.rise.float().view(-1, self.patch[0]).mean(1, keepdim=True).expand(self.grid)
        azimuth = (torch.arange(self.grid[1], device=x.device) * (2 * math.pi / self.grid[1])).expand(self.grid)
        cos, sin, up = (z.flatten()[:, None, None] for z in (azimuth.cos(), azimuth.sin(), RISE * rise))
        inverse = torch.exp(-far) * (1 + (up / RISE) ** 2).sqrt()
        places = [z.expand_as(inverse) for z in (cos * cos, cos * sin, sin * sin, cos * up, sin * up, up * up)]
        found = self.near(query, key, torch.cat([*places, cos * inverse, sin * inverse, up * inverse], -1))
        plane = [z[..., 0].transpose(1, 2).reshape(*distance.shape) for z in _fit(found, cos, sin, up, inverse)]
        return self._cells(*plane), trust[:, :, 0].sigmoid()

    def _cells(self, facing: Tensor, across: Tensor, climb: Tensor) -> Tensor:
        """The inverse ranges (B, K, H, W) of planes (B, K, h, w), each in the frame of its patch."""
        rows, columns = self.patch
        offset = torch.arange(columns, device=facing.device) - (columns - 1) / 2
        turn = (offset * (2 * math.pi / (self.grid[1] * columns))).repeat(self.grid[1])
        a, b, c = (z.repeat_interleave(rows, -2).repeat_interleave(columns, -1) for z in (facing, across, climb))
        rise = self.rise.float()[:, None]
        return (a * turn.cos() + b * turn.sin() + c * RISE * rise) / (1 + rise**2).sqrt()


def _tokens(x: Tensor) -> Tensor:
    """(B, K, D, h, w) as (B, N, K, D)."""
    return x.flatten(3).permute(0, 3, 1, 2)


def _fit(found: Tensor, cos: Tensor, sin: Tensor, up: Tensor, alone: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Planes (B, N, K, 1) from moments (B, N, K, 9), in frames that are turned to azimuths of ``cos`` and ``sin``;
    where these say nothing, a plane that faces the sensor where a patch by itself says it is."""
    cc, cs, ss, cu, su, uu, ci, si, ui = torch.split(found, 1, -1)
    m00 = cos * cos * cc + 2 * cos * sin * cs + sin * sin * ss + RIDGE
    m01 = (cos * cos - sin * sin) * cs + cos * sin * (ss - cc)
    m11 = sin * sin * cc - 2 * cos * sin * cs + cos * cos * ss + RIDGE
    m02, m12, m22 = cos * cu + sin * su, cos * su - sin * cu, uu + RIDGE
    y0, y1, y2 = cos * ci + sin * si + RIDGE * alone, cos * si - sin * ci, ui
    # Gauss: the matrix is positive.
    below, last = m01 / m00, m02 / m00
    m11, m12, m22 = m11 - below * m01, m12 - below * m02, m22 - last * m02
    y1, y2 = y1 - below * y0, y2 - last * y0
    last = m12 / m11
    climb = (y2 - last * y1) / (m22 - last * m12)
    across = (y1 - m12 * climb) / m11
    return (y0 - m01 * across - m02 * climb) / m00, across, climb
