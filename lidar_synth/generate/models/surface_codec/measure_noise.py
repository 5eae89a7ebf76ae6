"""The noise of a codec's cells, divided into what differs from cell to cell and what the cells of a
patch share.

The decoder predicts the distribution of every cell by itself. Neighbouring cells of a wall have the
same error of the range and similar reflectances, leaves do not. Both follow from pairs of
neighbouring cells of real images that show one surface: of Laplace distributed errors e, mean |e1 -
e2| = 1.5 b, where b is the scale of what differs; the correlation of reflectances is that of their
normal scores. The relief of plants follows from the correlation of errors at two distances along a
row: at the longer one, only the wider field is correlated.
"""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.generate.models.surface_codec.blocks import (
    PATCH,
    from_patches,
    to_patches,
)
from lidar_synth.generate.models.surface_codec.relief import (
    SPANS,
    correlation,
    to_normal,
)
from lidar_synth.generate.models.surface_codec.surfaces import (
    Noise,
    Surfaces,
    normalise_inverse,
)
from lidar_synth.geometry.normalize import Normalisation

LEAST = 200
"""Pairs of cells that a class needs; others keep the mean of all classes."""
PLANTS = TRAIN_ID["vegetation"], TRAIN_ID["terrain"]
"""Classes with relief: their deviations from a plane are real. Those of walls are doubt."""
LAGS = SPANS[0] // 2, SPANS[1] // 2
"""Columns between the pairs of cells by which relief is measured."""
_LARGEST = 4.0  # error of a range in scales: beyond it, the cell shows another surface
_SURE = 1e-4


class Seen(NamedTuple):
    """An image and the surfaces that a decoder predicts for it.

    Args:
        image: (1, C, H, W).
        codes: (1, H, W) classes, int64.
        surfaces: of its patches.
    """

    image: Tensor
    codes: Tensor
    surfaces: Surfaces


def measure_noise(
    images: Iterable[Seen],
    codes: int,
    normalisation: Normalisation,
    generator: torch.Generator,
) -> Noise:
    """The noise of cells in images.

    Args:
        images: the images.
        codes: number of classes.
        normalisation: of the ranges.
        generator: random numbers for reflectances of 0, whose score is not known.
    """
    # Pairs, |e1 - e2|, products and squares of scores.
    sums = torch.zeros(codes, 4, dtype=torch.float64)
    relief = torch.zeros(codes, 1 + len(LAGS), 2, dtype=torch.float64)
    for x, code, surfaces in images:
        distance, value = to_patches(x[:, :2], PATCH).unbind(1)
        kinds = to_patches(code[:, None], PATCH)[:, 0]
        error, score, surface = _scores(
            surfaces, distance, value, kinds, normalisation, generator
        )
        # (N, rows, columns - 1) of neighbours in a row of a patch
        pairs = [
            (part.view(-1, *PATCH)[..., :-1], part.view(-1, *PATCH)[..., 1:])
            for part in (error, score, surface, kinds, distance)
        ]
        (error1, error2), (score1, score2), (surface1, surface2) = pairs[:3]
        (kind1, kind2), (range1, range2) = pairs[3:]
        same = (surface1 == surface2) & (kind1 == kind2) & (range1 > -1) & (range2 > -1)
        terms = [
            torch.ones_like(error1),
            (error1 - error2).abs(),
            score1 * score2,
            score1**2,
        ]
        for column, term in enumerate(terms):
            sums[:, column] += torch.bincount(kind1[same], term[same].double(), codes)
        cells = torch.stack([error, kinds.float(), distance], 1)
        whole = from_patches(cells, PATCH, (x.shape[2], x.shape[3]))
        relief += _products(whole[:, 0], whole[:, 1], whole[:, 2], codes)
    total = sums.sum(0)
    known = sums[:, 0] >= LEAST
    roughness = torch.where(known, sums[:, 1] / sums[:, 0], total[1] / total[0]) / 1.5
    alike = torch.where(known, sums[:, 2] / sums[:, 3], total[2] / total[3]).clamp(
        0, 0.95
    )
    return Noise(roughness, _relief(relief), alike)


def _scores(
    surfaces: Surfaces,
    distance: Tensor,
    value: Tensor,
    kinds: Tensor,
    normalisation: Normalisation,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """(N, P) errors of ranges in scales, normal scores of reflectances, and the surface that each
    cell shows."""
    far = normalise_inverse(surfaces.inverse, normalisation)
    fit = (
        surfaces.weights
        - (distance[:, None] - far).abs() / surfaces.scale
        - surfaces.scale.log()
    )
    fit = fit + surfaces.classes.gather(2, kinds[:, None].expand(-1, far.shape[1], -1))
    shown = fit.argmax(1)

    def pick(part: Tensor) -> Tensor:
        return part.expand(far.shape).gather(1, shown[:, None])[:, 0]

    error = ((distance - pick(far)) / pick(surfaces.scale)).clamp(-_LARGEST, _LARGEST)
    middle, spread, blank = (pick(part) for part in surfaces.reflectance)
    zero = blank.sigmoid()
    below = zero + (1 - zero) * torch.sigmoid((value - middle) / spread.exp())
    uniform = torch.rand(value.shape, generator=generator)
    return error, _normal(torch.where(value <= -1, below * uniform, below)), shown


def _products(error: Tensor, kinds: Tensor, distance: Tensor, codes: int) -> Tensor:
    """(C, 1 + lags, 2) sums of products of the errors (B, H, W) of two cells of a row that show one
    class, and their number; the first lag is 0."""
    sums = []
    inside = (error.abs() < _LARGEST) & (distance > -1)
    for lag in (0, *LAGS):
        same = inside & inside.roll(-lag, -1) & (kinds == kinds.roll(-lag, -1))
        products = (error * error.roll(-lag, -1))[same].double()
        kind = kinds[same].long()
        total = torch.bincount(kind, products, codes)
        sums.append(torch.stack([total, torch.bincount(kind, minlength=codes)], 1))
    return torch.stack(sums, 1)


def _relief(sums: Tensor) -> Tensor:
    """(C, 2) factors of the fields, from the sums of ``_products``."""
    square, near, far = (sums[..., 0] / sums[..., 1].clamp_min(1)).unbind(1)
    wide = torch.minimum((far / correlation(SPANS[1], LAGS[1])).clamp_min(0), square)
    narrow = (near - wide * correlation(SPANS[1], LAGS[0])) / correlation(
        SPANS[0], LAGS[0]
    )
    factors = torch.stack(
        [torch.minimum(narrow.clamp_min(0), square - wide), wide], 1
    ).sqrt()
    plants = torch.zeros(len(factors), 1, dtype=torch.float64)
    plants[list(PLANTS)] = 1
    return factors * plants * (sums[:, :1, 1] >= LEAST)


def _normal(share: Tensor) -> Tensor:
    return to_normal(share.clamp(_SURE, 1 - _SURE))
