"""Approximate nearest-neighbour search for near duplicates in large banks, with an inverted file.

A signature is projected onto random signs and rounded to bytes. This sketch preserves distances to
a few per cent (Johnson and Lindenstrauss; Achlioptas, "Database-friendly random projections",
2003). Randomly sampled sketches are the centres of Voronoi cells. A scan is compared with the
earlier scans in the ``PROBES`` cells with the nearest centres (Jegou et al., "Product quantization
for nearest neighbor search", 2011); of these, the ``CANDIDATES`` nearest sketches are compared by
their full signatures. Exact copies are always found, by their hash.

All steps before the full signatures compute with integers that float32 represents exactly: the
result does not depend on the machine, the number of threads or the block size. The time grows with
N^1.5.
"""

import hashlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.geometry.arrays import Float64Array, Int64Array
from lidar_synth.noise import keyed_rng

DIMENSIONS = 64
"""Dimensions of a sketch."""

CELLS_PER_ROOT = 2
"""Number of cells, divided by the square root of the number of scans."""

PROBES = 16
"""Number of cells that a scan is compared with."""

CROWD = 4096
"""Largest number of scans of a cell to compare with; the first ones are taken. At a million scans a
cell holds about an eighth of that, unless very many scans are nearly identical; then the first of
them are found."""

CANDIDATES = 6
"""Number of nearest sketches whose full signatures are compared."""

ROWS = 1024
"""Signatures processed at a time."""

PAIRS = 1 << 19
"""Pairs of sketches compared at a time: 4 MB of keys."""

# quantisation steps of a signature's entries in [0, 1]: sums of 1024 entries are exact in float32
_STEPS = 4095
_SAMPLE = (
    65_536  # signatures from which the centre and scale of the sketches are estimated
)
_SPREAD = 4  # standard deviations that the range of a byte covers
# larger than any scan number; its product with a distance is exact in float64
_NUMBERS = 2.0**30
_NONE = 2.0**53 - 1  # larger than any key


class Signatures(Protocol):
    """(N, D) float16 unit vectors without negative entries, in memory or on disk."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: Any, /) -> NDArray[np.float16]:
        """Rows by a slice or by an array of row numbers."""
        ...


def find_similar(
    signatures: Signatures, progress: bool = True
) -> tuple[Float64Array, Int64Array]:
    """For each signature, approximately the most similar earlier one; like ``most_similar``.

    Returns:
        (N,) similarity in [0, 1], never more than that of the exact nearest neighbour; (N,) number
        of the earlier scan, -1 where none was found.
    """
    count = len(signatures)
    similarity = np.zeros(count)
    twin = np.full(count, -1)
    with tqdm(
        total=PROBES + 3, desc="duplicates", unit="step", disable=not progress, delay=2
    ) as steps:
        first = _first_copies(signatures)
        steps.update()
        # the first of each group of copies
        own = np.flatnonzero(first == np.arange(count))
        sketches = _sketches(signatures, own)
        steps.update()
        nearest = _nearest(sketches, steps)
        for part in _parts(count):
            candidates = nearest[np.searchsorted(own, first[part])]
            # to numbers among all signatures
            found = np.where(candidates < 0, -1, own[candidates])
            copies = first[part] < np.arange(part.start, part.stop)
            found[copies] = first[part][copies, None]
            similarity[part], twin[part] = _best(signatures, part, found)
        steps.update()
    return similarity, twin


def _parts(count: int, size: int | None = None) -> Iterator[slice]:
    size = size or ROWS
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _first_copies(signatures: Signatures) -> Int64Array:
    """(N,) number of the first signature with the same bytes."""
    hashes = np.empty(len(signatures), np.uint64)
    for part in _parts(len(signatures)):
        rows = np.ascontiguousarray(signatures[part])
        hashes[part] = [
            int.from_bytes(
                hashlib.blake2b(row.tobytes(), digest_size=8).digest(), "big"
            )
            for row in rows
        ]
    _, first, group = np.unique(hashes, return_index=True, return_inverse=True)
    return first[group]


def _sketches(signatures: Signatures, own: Int64Array) -> NDArray[np.int8]:
    """(len(own), DIMENSIONS) the sketches of some signatures."""
    width = signatures[:1].shape[1]
    signs = keyed_rng(width, DIMENSIONS).choice(
        np.array([-1, 1], np.float32), (width, DIMENSIONS)
    )

    def project(rows: Int64Array) -> NDArray[np.float32]:
        values: NDArray[np.float32] = (
            np.rint(signatures[rows].astype(np.float32) * _STEPS) @ signs
        )
        return values

    some = own[np.linspace(0, len(own) - 1, min(len(own), _SAMPLE)).astype(np.int64)]
    # sums of integers below 2^53
    total = np.zeros(DIMENSIONS)
    squares = 0.0
    for part in _parts(len(some)):
        values = project(some[part]).astype(np.float64)
        total += values.sum(0)
        squares += float((values**2).sum())
    centre = np.rint(total / len(some)).astype(np.float32)
    variance = squares / len(some) - float((total / len(some)) @ (total / len(some)))
    scale = np.float32(
        127 / _SPREAD / max(np.sqrt(max(variance, 0.0) / DIMENSIONS), 1.0)
    )
    sketches = np.empty((len(own), DIMENSIONS), np.int8)
    for part in _parts(len(own)):
        sketches[part] = np.rint((project(own[part]) - centre) * scale).clip(-127, 127)
    return sketches


def _nearest(sketches: NDArray[np.int8], steps: "tqdm[Any]") -> NDArray[np.int32]:
    """(N, CANDIDATES) numbers of the nearest earlier sketches, -1 where there are fewer."""
    count = len(sketches)
    cells = min(count, int(CELLS_PER_ROOT * count**0.5) + 1)
    chosen = keyed_rng(count, cells).choice(count, cells, replace=False)
    centres = sketches[np.sort(chosen)]
    probes = np.empty((count, min(PROBES, cells)), np.min_scalar_type(cells))
    for part in _parts(count, PAIRS // cells + 1):
        keys = _keys(sketches[part], centres, np.arange(cells))
        probes[part] = (
            np.sort(np.partition(keys, probes.shape[1] - 1)[:, : probes.shape[1]])
            % _NUMBERS
        )
    order, bounds = _by_cell(probes[:, 0], cells)
    members = [order[a:b][:CROWD] for a, b in pairwise(bounds)]
    best = np.full((count, CANDIDATES), _NONE)
    for probe in probes.T:
        queries, bounds = _by_cell(probe, cells)
        for cell, (a, b) in enumerate(pairwise(bounds)):
            for part in _parts(b - a, PAIRS // (len(members[cell]) + 1) + 1):
                _compare(sketches, queries[a:b][part], members[cell], best)
        steps.update()
    best[best == _NONE] = -1
    np.fmod(best, _NUMBERS, out=best)
    return best.astype(np.int32)


def _by_cell(
    of: NDArray[np.unsignedinteger], cells: int
) -> tuple[Int64Array, Int64Array]:
    """Numbers of the sketches, sorted by cell and then ascending; start of each cell in this list,
    and its end."""
    order = np.argsort(of, kind="stable")
    return order, np.searchsorted(of[order], np.arange(cells + 1))


def _compare(
    sketches: NDArray[np.int8],
    queries: Int64Array,
    members: Int64Array,
    best: Float64Array,
) -> None:
    """Update the best candidates of each query with the earlier members of a cell."""
    keys = _keys(sketches[queries], sketches[members], members)
    keys[members >= queries[:, None]] = _NONE
    best[queries] = np.partition(
        np.concatenate([best[queries], keys], 1), CANDIDATES - 1
    )[:, :CANDIDATES]


def _keys(
    some: NDArray[np.int8], others: NDArray[np.int8], numbers: Int64Array
) -> Float64Array:
    """(M, N) sort keys: the squared distance of two sketches first, then the number of the second
    sketch."""
    a = some.astype(np.float32)
    b = others.astype(np.float32)
    own = (a * a).sum(1)
    theirs = (b * b).sum(1)
    distances = own[:, None] + theirs - 2 * (a @ b.T)  # whole numbers below 2^22
    keys: Float64Array = distances.astype(np.float64) * _NUMBERS + numbers
    return keys


def _best(
    signatures: Signatures, part: slice, found: Int64Array
) -> tuple[Float64Array, Int64Array]:
    """Similarity and number of the most similar of the candidates (M, K) of each signature; the
    first one of equals."""
    found = np.sort(found, 1)
    numbers, places = np.unique(found, return_inverse=True)
    others = signatures[numbers.clip(0)].astype(np.float32)
    own = signatures[part].astype(np.float32)
    similarity = np.full(found.shape, -1.0)
    for column, place in enumerate(places.reshape(found.shape).T):
        similarity[:, column] = np.einsum("nd,nd->n", own, others[place])
    similarity[found < 0] = -1
    best = similarity.argmax(1)
    rows = np.arange(len(found))
    return similarity[rows, best].clip(0, 1), found[rows, best]
