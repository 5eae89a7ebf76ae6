"""Scans that are alike, by their signatures: all pairs of a bank that is not large, and of others what is found."""

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.bake.curate.neighbours import Signatures, find_alike

ALL_PAIRS = 20_000
"""Scans of which every pair is compared."""

BLOCK = 2048
"""Signatures compared with one another at a time: 16 MB of products."""


def most_alike(signatures: Signatures, progress: bool = True) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """For each scan the one before it that is most like it; of more than ``ALL_PAIRS`` the one that is found to be.

    Only those before it: of a group of scans that are alike, the first one is like none, and stays where the others
    are dropped.

    Args:
        signatures: (N, D) unit vectors, as ``Features.signature``.
        progress: show a bar.

    Returns:
        (N,) likeness in [0, 1], 0 for the first scan; (N,) number of that scan, -1 for the first.
    """
    return (compare_all if len(signatures) <= ALL_PAIRS else find_alike)(signatures, progress)


def compare_all(signatures: Signatures, progress: bool = True) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """As ``most_alike``, by every pair; the work grows with the square of the number of scans."""
    count = len(signatures)
    best, twin = np.zeros(count), np.full(count, -1)
    starts = range(0, count, BLOCK)
    pairs = [(a, b) for a in starts for b in starts if b <= a]
    for a, b in tqdm(pairs, desc="duplicates", unit="block", disable=not progress, delay=2):
        later, earlier = (signatures[first : first + BLOCK].astype(np.float32) for first in (a, b))
        products = later @ earlier.T
        products[np.arange(a, a + len(later))[:, None] <= np.arange(b, b + len(earlier))] = -1
        found = products.argmax(1)
        likeness = products[np.arange(len(later)), found].clip(max=1)
        better = likeness > np.where(twin[a : a + BLOCK] < 0, -0.5, best[a : a + BLOCK])
        best[a : a + BLOCK][better], twin[a : a + BLOCK][better] = likeness[better], found[better] + b
    return best, twin
