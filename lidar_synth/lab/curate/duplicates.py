"""Near duplicates by signature: an exact search over all pairs, or an approximate one in large
banks."""

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.lab.curate.neighbours import Signatures, find_similar

ALL_PAIRS = 20_000
"""Largest number of scans for the exact search over all pairs."""

BLOCK = 2048
"""Signatures compared with one another at a time: 16 MB of products."""


def most_similar(
    signatures: Signatures, progress: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The most similar earlier scan of each scan; approximate for more than ``ALL_PAIRS`` scans.

    Only earlier scans count, so that the first of a group of similar scans has no duplicate and
    stays when the others are dropped.

    Args:
        signatures: (N, D) unit vectors, as ``ScanFeatures.signature``.
        progress: show a bar.

    Returns:
        (N,) similarity in [0, 1], 0 for the first scan; (N,) number of the most similar scan, -1
        for the first.
    """
    return (compare_all if len(signatures) <= ALL_PAIRS else find_similar)(
        signatures, progress
    )


def compare_all(
    signatures: Signatures, progress: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Like ``most_similar``, over all pairs; the time grows with the square of the number of
    scans."""
    count = len(signatures)
    best = np.zeros(count)
    twin = np.full(count, -1)
    starts = range(0, count, BLOCK)
    pairs = [(a, b) for a in starts for b in starts if b <= a]
    for a, b in tqdm(
        pairs, desc="duplicates", unit="block", disable=not progress, delay=2
    ):
        later, earlier = (
            signatures[first : first + BLOCK].astype(np.float32) for first in (a, b)
        )
        products = later @ earlier.T
        rows = np.arange(a, a + len(later))
        columns = np.arange(b, b + len(earlier))
        products[rows[:, None] <= columns] = -1
        found = products.argmax(1)
        similarity = products[np.arange(len(later)), found].clip(max=1)
        better = similarity > np.where(
            twin[a : a + BLOCK] < 0, -0.5, best[a : a + BLOCK]
        )
        best[a : a + BLOCK][better] = similarity[better]
        twin[a : a + BLOCK][better] = found[better] + b
    return best, twin
