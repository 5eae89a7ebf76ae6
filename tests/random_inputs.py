"""Random inputs of the extractors, and the few numbers to which their features are reduced: for the
peers' kept numbers and for the tests that compare ours with them."""

from collections.abc import Iterator
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

PER_SET = 5
KEPT = 3
"""Inputs in each of the two sets of a Fréchet distance, and numbers kept of the features of
each."""
SCALES = (1.0, 1.25)
"""Of the values of the inputs of both sets, so that their distance is large beside the rounding of
the features."""


def random_points(
    count: int = 3000, seed: int = 5, scale: float = 1.0
) -> NDArray[np.float32]:
    """(N, 4) points all around a sensor, 2 m to 70 m away, and their reflectance."""
    rng = np.random.RandomState(seed)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    elevation = np.radians(rng.uniform(-24.5, 2.5, count))
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    points = (
        np.stack(directions, -1)
        * np.exp(rng.uniform(np.log(2), np.log(70), count))[:, None]
        / scale
    )
    return np.column_stack([points, rng.random_sample(count)]).astype(np.float32)


def random_image(channels: int, seed: int = 6, scale: float = 1.0) -> torch.Tensor:
    """(1, C, 64, 64) normalised image with empty cells."""
    rng = np.random.RandomState(seed)
    image = (
        rng.uniform(-1, 1, (channels, 64, 64))
        * (rng.random_sample((64, 64)) < 0.8)
        * scale
    )
    return torch.from_numpy(image.astype(np.float32))[None]


def two_sets() -> Iterator[tuple[int, float]]:
    """Seed and scale of the inputs of two sets, one set after the other."""
    return ((10 + i, scale) for scale, i in product(SCALES, range(PER_SET)))


def reduced(features: NDArray[np.floating], kept: int = KEPT) -> NDArray[np.float64]:
    """(N, D) features to (N, kept), fixed random sums of all of them: the peers' Fréchet distance
    needs covariances of full rank, which few inputs have in few dimensions only."""
    weights = np.random.RandomState(7).normal(size=(features.shape[1], kept)) / np.sqrt(
        features.shape[1]
    )
    found: NDArray[np.float64] = features.astype(np.float64) @ weights
    return found
