"""Patches of a range image as mixtures of surfaces.

A patch of a few rows and columns shows K surfaces. A surface is a plane with a class, a reflectance
and a probability of a return; each cell of the patch shows one of them. The likelihood of a cell is
that of the mixture, so that the range, the label and the reflectance of a cell belong together::

    p(cell) = sum_k w_k (1 - q_k)                                            without a return
    p(cell) = sum_k w_k q_k Laplace(range) ZeroInflatedLogistic(reflectance) p_k(class)
                                                                             with one

Seen from a laser, the inverse range of a plane is linear in the ray's direction, and within a patch
in row and column: three numbers describe it.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lidar_synth.generate.models.surface_codec.bounds import Bounds
from lidar_synth.generate.models.surface_codec.reflectance import ZeroInflatedLogistic
from lidar_synth.generate.models.surface_codec.relief import to_normal
from lidar_synth.geometry.normalize import Normalisation

SLOPES = 0.3, 0.05
"""Relative change of the inverse range per row and per column for a slope of 1."""
SPREADS = 3e-3, 0.3
"""Limits of a range's scale, normalised."""
DIM = -4.6, 0.0
"""Limits of the logarithm of a reflectance's scale."""
NUMBERS = 8
"""Values of a surface beside its class: log range, two slopes, log scale of the range, return, and
the reflectance's median, log scale and logit of 0."""
PER_CELL = 2
"""Values of a cell beside its choice of a surface: offsets of the logit of a return and of the
reflectance."""

DRAWS = 5
"""Random numbers per cell: for the choice of a surface, the return, the range, the reflectance, and
for what the cells of a patch have in common."""


_SURE = 1e-6  # distance from 0 and 1 that keeps a logit finite


class Noise(NamedTuple):
    """The noise of cells, by class, as ``measure_noise`` finds it.

    Args:
        roughness: (C,) share of a range's scale that differs from cell to cell; the rest is doubt
            about the surface.
        relief: (C, F) factors of the fields of relief, in a range's scale; 0 for what is flat.
        reflectance: (C,) correlation of the reflectances of cells that show one surface of a patch.
    """

    roughness: Tensor
    relief: Tensor
    reflectance: Tensor


class Surfaces(NamedTuple):
    """The distributions of the cells of N patches with K surfaces and P cells each.

    Args:
        inverse: (N, K, P) inverse range, 1 / metres.
        scale: (N, K, 1) scale of the normalised range.
        returned: (N, K, P) logits of a return.
        reflectance: of (N, K, P) normalised reflectances.
        classes: (N, K, C) log probabilities of the classes.
        weights: (N, K, P) log probabilities of the surfaces.
    """

    inverse: Tensor
    scale: Tensor
    returned: Tensor
    reflectance: ZeroInflatedLogistic
    classes: Tensor
    weights: Tensor

    def log_likelihood(
        self,
        x: Tensor,
        value: Tensor,
        code: Tensor,
        normalisation: Normalisation,
        temper: tuple[float, float],
    ) -> Tensor:
        """(N, P) log likelihoods of cells.

        Args:
            x: (N, P) normalised ranges, -1 without a return.
            value: (N, P) normalised reflectances.
            code: (N, P) classes, int64.
            normalisation: of the ranges.
            temper: exponents of the likelihoods of range and reflectance.
        """
        x = x[:, None]
        value = value[:, None]
        far = normalise_inverse(self.inverse, normalisation)
        distance = -(x - far).abs() / self.scale - (2 * self.scale).log()
        shown = -self.reflectance.nll(value)
        seen = (
            F.logsigmoid(self.returned)
            + temper[0] * distance
            + temper[1] * shown
            + self._of(code)
        )
        return torch.logsumexp(
            self.weights + torch.where(x > -1, seen, F.logsigmoid(-self.returned)), 1
        )

    def sample(
        self,
        uniform_noise: Tensor,
        relief: Tensor,
        noise: Noise,
        normalisation: Normalisation,
        bounds: Bounds | None = None,
        codes: Tensor | None = None,
    ) -> Tensor:
        """(N, 4, P) range, -1 without a return, reflectance, class and its probability, of sampled
        cells.

        Args:
            uniform_noise: (N, DRAWS, P) numbers in (0, 1), P > K.
            relief: (N, F, P) fields of relief.
            noise: of the cells.
            normalisation: of the ranges.
            bounds: (N, P) where objects may be. A cell without a box shows another surface of its
                patch, or nothing; objects in a box have its class, with the probability of the
                class that they were drawn as, and their ranges are clipped to it.
            codes: (N, P) int64 classes that are given, negative where they are not. A cell shows
                each surface with its probability given the class.
        """
        which, back, near, dim, shared = uniform_noise.unbind(1)
        likely, code = self.classes.max(2)
        shares = self.weights.exp() if codes is None else self._given(codes)
        if bounds is not None:
            shares = _allowed(shares, bounds.codes[code], bounds)
        chosen = _choose(shares, which)[:, None]
        distance, median, returned = (
            part.gather(1, chosen)[:, 0]
            for part in (self.inverse, self.reflectance.middles, self.returned)
        )
        # What all cells of a surface have in common.
        parts = [
            self.scale[..., 0],
            *(part[..., 0] for part in self.reflectance[1:]),
            likely.exp(),
            code.float(),
        ]
        common = torch.stack([*parts, to_normal(shared[:, : self.weights.shape[1]])], 2)
        common = common.gather(1, chosen.mT.expand(-1, -1, common.shape[2]))
        scale, dull, blank, likely, kind, patch = common.unbind(2)
        if codes is not None:
            # Above 0, for the signs of its bits.
            of_code = self._of(codes).gather(1, chosen)[:, 0].exp().clamp_min(_SURE)
            likely = torch.where(codes < 0, likely, of_code)
            kind = torch.where(codes < 0, kind, codes)
        if bounds is not None:
            object_ = bounds.codes[kind.long()]
            kind = torch.where(object_ & (bounds.label >= 0), bounds.label, kind)
        tables = torch.cat(
            [noise.reflectance[:, None], noise.roughness[:, None], noise.relief], 1
        )
        alike, rough, *bumps = F.embedding(kind.long(), tables).unbind(2)
        values = ZeroInflatedLogistic(median, dull, blank).sample(
            _mixed(dim, alike, patch)
        )
        error = rough * laplace_noise(near) + sum(
            a * b for a, b in zip(bumps, relief.unbind(1), strict=True)
        )
        distance = normalise_inverse(distance, normalisation) + scale * error
        if bounds is not None:  # where no box is, far = -1: no return
            distance = torch.where(
                object_, distance.clamp(bounds.near, bounds.far), distance
            )
        distance = torch.where(returned + torch.logit(back) > 0, distance, -1.0)
        return torch.stack([distance, values, kind, likely], 1)

    def _of(self, codes: Tensor) -> Tensor:
        """(N, K, P) log probabilities of the classes (N, P) of cells, for each surface; 0 for
        negative ones."""
        index = codes.clamp_min(0)[:, None].expand(-1, self.classes.shape[1], -1)
        return self.classes.gather(2, index).masked_fill(codes[:, None] < 0, 0)

    def _given(self, codes: Tensor) -> Tensor:
        """(N, K, P) probabilities of the surfaces of cells whose classes (N, P) are given."""
        return (self.weights + self._of(codes)).softmax(1)


def laplace_noise(uniform_noise: Tensor) -> Tensor:
    """Uniform numbers in (0, 1) to samples of the Laplace distribution of scale 1."""
    off = uniform_noise - 0.5
    return -off.sign() * torch.log1p(-2 * off.abs())


def _allowed(shares: Tensor, object_: Tensor, bounds: Bounds) -> Tensor:
    """Shares (N, K, P) of the surfaces, without the objects (N, K) where no box is."""
    shares = shares * ~(object_[..., None] & (bounds.near > bounds.far)[:, None])
    return shares / shares.sum(1, keepdim=True).clamp_min(1e-9)


def _choose(shares: Tensor, which: Tensor) -> Tensor:
    """(N, P) int64 surfaces of shares (N, K, P) by uniform numbers (N, P)."""
    chosen = torch.zeros_like(which, dtype=torch.int64)
    below = torch.zeros_like(which)
    for share in shares.unbind(1)[:-1]:
        below = below + share
        chosen += which > below
    return chosen


def _mixed(uniform_noise: Tensor, correlation: Tensor, shared: Tensor) -> Tensor:
    """Uniform numbers of cells, correlated by the standard normal numbers that they share (a
    Gaussian copula)."""
    single = (1 - correlation).sqrt() * to_normal(uniform_noise)
    mixed: Tensor = torch.special.ndtr(correlation.sqrt() * shared + single)
    return mixed.clamp(_SURE, 1 - _SURE)


def normalise_inverse(inverse: Tensor, normalisation: Normalisation) -> Tensor:
    """Inverse ranges as normalised ranges, inside the limits of a return."""
    low = normalisation.range_min
    high = normalisation.range_max
    return normalisation.encode(
        1 / inverse.clamp(1 / (0.999 * high), 1 / (1.001 * low))
    )


def surfaces_of(
    x: Tensor, surfaces: int, classes: int, patch: tuple[int, int], merged: int = 1
) -> Surfaces:
    """The surfaces that the numbers (N, K (NUMBERS + C) + P (K + PER_CELL)) of N patches describe,
    float32.

    Args:
        x: the numbers.
        surfaces: K.
        classes: C.
        patch: rows and columns of a patch, P cells.
        merged: number of neighbouring columns that become one, a divisor of the patch's columns.
            The P / merged cells are each at the middle of those that they replace.
    """
    rows, columns = patch
    whole, each = torch.split(
        x.float(),
        [surfaces * (NUMBERS + classes), rows * columns * (surfaces + PER_CELL)],
        1,
    )
    numbers, kinds = torch.split(
        whole.reshape(len(x), surfaces, -1), [NUMBERS, classes], 2
    )
    parts = each.reshape(len(x), surfaces + PER_CELL, -1, merged).unbind(3)
    each = torch.stack(parts).mean(0) if merged > 1 else parts[0]
    choice, offsets = torch.split(each, [surfaces, PER_CELL], 1)
    described = numbers[..., None].unbind(2)
    distance, down, across, spread, returned, median, dim, blank = described
    cell = torch.arange(each.shape[2], device=x.device)
    columns = columns // merged
    i = cell // columns - (rows - 1) / 2
    j = (cell % columns - (columns - 1) / 2) * merged
    slopes = 1 + SLOPES[0] * down * i + SLOPES[1] * across * j
    inverse = (-distance.clamp(-1, 5)).exp() * slopes.clamp_min(0.05)
    reflectance = ZeroInflatedLogistic(median + offsets[:, 1:], dim.clamp(*DIM), blank)
    scale = spread.clamp(*map(math.log, SPREADS)).exp()
    return Surfaces(
        inverse,
        scale,
        returned + offsets[:, :1],
        reflectance,
        kinds.log_softmax(2),
        choice.log_softmax(1),
    )
