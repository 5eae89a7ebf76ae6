"""Position and time encodings: ray angles and timesteps as features of tokens.

Angles are (2, H, W): elevation, then azimuth, radians. Attention uses a rotary encoding with
integer harmonics of the angles (``Rotary``). One of four further encodings is added to the tokens:
a learned table, or one of three fixed features of the angles, mapped by a small network.
"""

import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.generate.models.layers import Exact, Mapping, normal_values


class RayAngles(Exact):
    """Stores the elevation and azimuth of every cell; averages them over patches.

    Args:
        resolution: H, W.
        angles: (2, H, W) radians; None = NaN until a checkpoint is loaded, so that missing angles
            are noticed.
    """

    cells: Tensor

    def __init__(self, resolution: Sequence[int], angles: Tensor | None) -> None:
        super().__init__()
        cells = torch.full((2, *resolution), torch.nan) if angles is None else angles
        self.register_buffer("cells", cells.detach().to(torch.float32, copy=True))

    def forward(self, patch: Sequence[int], levels: int) -> list[Tensor]:
        """(2, rows, columns) angles of the tokens of each level, finest first: means over patches,
        then over 2 x 2."""
        means = [F.avg_pool2d(self.cells[None], tuple(patch))]
        while len(means) < levels:
            means.append(F.avg_pool2d(means[-1], 2))
        return [m[0] for m in means]


class Rotary(Exact):
    """Axial rotary encoding (Su et al., "RoFormer", 2021) with integer harmonics of elevation and
    azimuth.

    Of the D / 2 rotations of a head, the first half depends on elevation, the second on azimuth.
    The harmonics are spaced geometrically from 1 to half the number of rows (columns), over all
    heads together.

    Args:
        grid: rows and columns of tokens.
        heads: number of heads.
        width: D, channels of a head; a multiple of 4.
    """

    harmonics: Tensor

    def __init__(self, grid: Sequence[int], heads: int, width: int) -> None:
        super().__init__()
        highest = [math.log(max(size // 2, 1)) for size in grid]
        # Not on "meta", where these functions import torch's compiler, which takes a second.
        # ``as_tensor`` moves to the device on which networks are built.
        spread = [
            torch.linspace(0, h, heads * width // 4, device="cpu").exp().round()
            for h in highest
        ]
        # (2, heads, D / 4): neighbouring harmonics are assigned to different heads.
        self.register_buffer(
            "harmonics",
            torch.as_tensor(torch.stack(spread)).view(2, -1, heads).mT.contiguous(),
        )

    def forward(self, angles: Tensor) -> tuple[Tensor, Tensor]:
        """Angles (2, H, W) to the tokens' cosines and sines, each (N, heads, D / 2)."""
        turn = torch.cat(
            tuple(angles.flatten(1)[..., None, None] * self.harmonics[:, None]), -1
        )
        return turn.cos(), turn.sin()


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate the pairs (element i, element i + D/2) of x (..., heads, D)."""
    a, b = x.chunk(2, -1)
    return torch.stack((a * cosine - b * sine, a * sine + b * cosine), -2).flatten(-2)


def spherical_harmonics(angles: Tensor, degree: int = 4) -> Tensor:
    """Real spherical harmonics of the ray directions, orthonormal, in the order l = 0..degree and,
    for each l, m = -l..l.

    Args:
        angles: (2, H, W) radians.

    Returns:
        (H, W, (degree + 1)^2).
    """
    elevation, azimuth = angles
    z = elevation.sin()
    across = elevation.cos()
    components = {}
    for m in range(degree + 1):
        # Associated Legendre polynomials P_l^m without the sign (-1)^m, by recurrence in l,
        # starting at P_m^m.
        below = torch.zeros_like(z)
        legendre = across**m * math.prod(range(1, 2 * m, 2))
        for n in range(m, degree + 1):
            norm = (
                (2 * n + 1)
                / (2 * math.pi)
                * math.factorial(n - m)
                / math.factorial(n + m)
            )
            # y = cos(elevation) sin(-azimuth), since azimuth increases clockwise.
            components[n, -m] = math.sqrt(norm) * legendre * (m * -azimuth).sin()
            components[n, m] = (
                math.sqrt(norm if m else norm / 2) * legendre * (m * azimuth).cos()
            )
            below, legendre = (
                legendre,
                ((2 * n + 1) * z * legendre - (n + m) * below) / (n - m + 1),
            )
    return torch.stack(
        [components[n, m] for n in range(degree + 1) for m in range(-n, n + 1)], -1
    )


def fourier_features(angles: Tensor) -> Tensor:
    """Sines, then cosines, of the angles times 1, 2, 4, ... below the number of rows (columns).

    Args:
        angles: (2, H, W) radians.

    Returns:
        (H, W, 2 (ceil(log2 H) + ceil(log2 W))).
    """
    octaves = [
        torch.arange(math.ceil(math.log2(size)), device=angles.device)
        for size in angles.shape[1:]
    ]
    turn = torch.cat(
        [a[..., None] * n.exp2() for a, n in zip(angles, octaves, strict=True)], -1
    )
    return torch.cat((turn.sin(), turn.cos()), -1)


def polar_coordinates(angles: Tensor) -> Tensor:
    """The angles (2, H, W) themselves, (H, W, 2)."""
    return angles.movedim(0, -1)


BASES: dict[str, Callable[[Tensor], Tensor]] = {
    "spherical_harmonics": spherical_harmonics,
    "fourier_features": fourier_features,
    "polar_coordinates": polar_coordinates,
}
"""Fixed features of the angles, (2, H, W) to (H, W, K)."""

LEARNED = "learned"
POSITIONS = (LEARNED, *BASES)
"""The encodings that can be added to the tokens."""


class LearnedPosition(nn.Module):
    """A table with one learned vector per token.

    Args:
        grid: rows and columns of tokens.
        dim: C, channels of a token.
    """

    def __init__(self, grid: Sequence[int], dim: int) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.empty(*grid, dim))
        nn.init.trunc_normal_(self.table, std=0.02)

    def forward(self, angles: Tensor) -> Tensor:
        """The table (H, W, C); ``angles`` is ignored."""
        return self.table


class AnglePosition(nn.Module):
    """Fixed features of the ray angles, mapped by a small network.

    Args:
        basis: a key of ``BASES``.
        grid: rows and columns of tokens.
        dim: C, channels of a token.
        ratio, depth: arguments of the mapping network.
    """

    def __init__(
        self, basis: str, grid: Sequence[int], dim: int, ratio: float, depth: int
    ) -> None:
        super().__init__()
        self.basis = BASES[basis]
        self.linear = nn.Linear(
            self.basis(torch.zeros(2, *grid)).shape[-1], dim, bias=False
        )
        self.mapping = Mapping(dim, ratio, depth)

    def forward(self, angles: Tensor) -> Tensor:
        """Angles (2, H, W) to (H, W, C)."""
        out: Tensor = self.mapping(
            self.linear(self.basis(angles).to(self.linear.weight.dtype))
        )
        return out


class TimeFeatures(Exact):
    """Cosines, then sines, of 2 pi f t for normally distributed frequencies f.

    Args:
        dim: channels, even.
    """

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("frequencies", normal_values(dim // 2))

    def forward(self, t: Tensor) -> Tensor:
        """Times (B,) to (B, dim)."""
        turn = t[:, None] * (2 * math.pi * self.frequencies)
        return torch.cat((turn.cos(), turn.sin()), 1)


class TimeEmbedding(nn.Module):
    """Fourier features of time, mapped by a small network.

    Args:
        dim: E, channels of the embedding, even.
        ratio, depth: arguments of the mapping network.
    """

    def __init__(self, dim: int, ratio: float, depth: int) -> None:
        super().__init__()
        self.features = TimeFeatures(dim)
        self.linear = nn.Linear(dim, dim, bias=False)
        self.mapping = Mapping(dim, ratio, depth)

    def forward(self, t: Tensor) -> Tensor:
        """Times (B,) to (B, E)."""
        out: Tensor = self.mapping(
            self.linear(self.features(t).to(self.linear.weight.dtype))
        )
        return out


class StepEmbedding(nn.Module):
    """The length of a step, to be added to the embedding of its time; zero at first, as if no
    length was given.

    Args:
        dim: E, channels of the embedding, even.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.features = TimeFeatures(dim)
        self.hidden = nn.Linear(dim, dim)
        self.out = nn.Linear(dim, dim, bias=False)
        nn.init.zeros_(self.out.weight)

    def forward(self, length: Tensor) -> Tensor:
        """Lengths (B,) in (0, 1] to (B, E)."""
        hidden = F.silu(self.hidden(self.features(length).to(self.hidden.weight.dtype)))
        out: Tensor = self.out(hidden)
        return out
