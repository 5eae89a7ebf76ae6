"""Feature maps to one vector of features for each scan."""

import random
from functools import lru_cache

import torch
from torch import Tensor

BANDS = 16
"""Bands of rows, and rings of distance, over which LiDM and R2Flow average features."""

SUBSAMPLE = 4096
"""Features that LiDARGen and R2Flow draw from a feature map."""


def subsample(features: Tensor) -> Tensor:
    """(C, H, W) to (4096,): the same random choice of features for every scan (LiDARGen; R2Flow's
    FRD)."""
    return features.reshape(-1)[_chosen(features.numel())]


@lru_cache(maxsize=4)
def _chosen(count: int) -> Tensor:
    return torch.tensor(random.Random(0).sample(range(count), SUBSAMPLE))


def mean_over_bands(features: Tensor) -> Tensor:
    """(C, H, W), H a multiple of 16, to (16 C,): means over 16 bands of rows, channels first
    (LiDM's FRID)."""
    return features.reshape(len(features), BANDS, -1).mean(2).flatten()


def mean_over_rings(
    features: Tensor, voxels: Tensor, size: float, furthest: float
) -> Tensor:
    """Means of the features over 16 rings of distance from the centre of gravity of the voxels
    (LiDM's FSVD, FPVD).

    The first ring ends 4 m and 1/16 of the rest from the centre; voxels beyond the last ring do not
    count.

    Args:
        features: (N, C).
        voxels: (N, 3) coordinates in voxels.
        size: of a voxel, metres.
        furthest: edge of the last ring, metres.

    Returns:
        (16 C,) by ring; 0 for an empty ring.
    """
    offset = voxels.float()
    distance = (offset - offset.mean(0)).norm(dim=1) * size
    edges = torch.linspace(4.0, furthest, BANDS + 1)
    edges[0] = 0
    ring = torch.bucketize(distance, edges, right=True) - 1
    inside = ring < BANDS
    sums = features.new_zeros(BANDS, features.shape[1]).index_add_(
        0, ring[inside], features[inside]
    )
    counts = torch.bincount(ring[inside], minlength=BANDS).clamp(min=1)
    return (sums / counts[:, None]).flatten()
