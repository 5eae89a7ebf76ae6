"""Random permutations of any length whose entries are computed independently, in constant memory.

``permute`` is a Feistel network over a grid with barely more cells than entries (Black and Rogaway,
"Ciphers with arbitrary finite domains", CT-RSA 2002). Each round shifts a cell's row by a keyed
hash of its column, or its column by a hash of its row, so that every round is a bijection. An entry
that leaves the range passes through the network again until it is back in range ("cycle walking"),
which keeps the map a bijection.
"""

from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from lidar_synth.noise import key_words

Words = NDArray[np.uint64]

TOGETHER = 4
"""Number of blocks that ``permute_blocks`` goes through at a time."""

_ROUNDS = 10  # with fewer, the orders of a handful of entries are not equally frequent


def permute(
    entries: NDArray[np.int64],
    size: int,
    seed: int,
    stream: int,
    number: int | NDArray[np.int64] = 0,
) -> NDArray[np.int64]:
    """Apply a keyed permutation of 0 .. size - 1 to some of its entries.

    Args:
        entries: (N,), 0 <= entry < size.
        size: length of the permutation, below 2^62.
        seed: 0 <= seed < 2^64.
        stream: separates permutations of different use, 0 <= stream < 2^63.
        number: number of the permutation, such as an epoch; one for all entries, or (N,).
            Permutations of different numbers are independent.

    Returns:
        (N,) 0 <= place < size; a bijection of the entries for each (size, seed, stream, number),
        the same on every machine.
    """
    if size <= 1 or not len(entries):
        return np.zeros(len(entries), np.int64)
    keys = _keys(seed, stream)
    order = _mixed(
        np.broadcast_to(np.asarray(number, np.int64), (len(entries),)).astype(np.uint64)
        + keys[-1]
    )
    places = _one_pass(entries.astype(np.uint64), size, keys, order)
    while len(outside := np.flatnonzero(places >= size)):
        places[outside] = _one_pass(places[outside], size, keys, order[outside])
    return places.astype(np.int64)


def permute_blocks(
    entries: NDArray[np.int64],
    size: int,
    block: int,
    seed: int,
    stream: int,
    number: int,
) -> NDArray[np.int64]:
    """Apply a keyed permutation that uses blocks of consecutive places at about the same time.

    Blocks come in random order, ``TOGETHER`` at a time, and the places of these blocks are shuffled
    with one another. The remaining places, too few for ``TOGETHER`` blocks, come last.

    Args:
        entries: (N,), 0 <= entry < size.
        size: length of the permutation.
        block: number of places in a block.
        seed, stream, number: as for ``permute``.

    Returns:
        (N,) 0 <= place < size; a bijection of the entries.
    """
    span = TOGETHER * block
    groups, rest = divmod(size, span)
    start = size - rest
    last = entries >= start
    places = np.empty_like(entries)
    places[last] = start + permute(entries[last] - start, rest, seed, stream, number)
    group, place = np.divmod(entries[~last], span)
    place = permute(place, span, seed, stream, number * groups + group)
    slot = group * TOGETHER + place // block
    chosen = permute(slot, groups * TOGETHER, seed, stream, number)
    places[~last] = chosen * block + place % block
    return places


def _one_pass(
    cells: Words,
    size: int,
    keys: Words,
    order: Words,
) -> Words:
    """One pass through all rounds of the network, over a grid of at least ``size`` cells."""
    rows = isqrt(size - 1) + 1
    columns = -(-size // rows)
    row = cells // np.uint64(columns)
    column = cells % np.uint64(columns)
    for i, key in enumerate(keys[:-1]):
        if i % 2:
            column = _shifted(column, columns, row + key ^ order)
        else:
            row = _shifted(row, rows, column + key ^ order)
    return row * np.uint64(columns) + column


def _shifted(places: Words, size: int, keyed: Words) -> Words:
    """Each place, 0 .. size - 1 with size < 2^32, shifted cyclically by a hash of its keyed
    value."""
    moved: Words = places + (
        (_mixed(keyed) >> np.uint64(32)) * np.uint64(size) >> np.uint64(32)
    )
    return moved - (moved >= size) * np.uint64(size)


def _mixed(values: Words) -> Words:
    """SplitMix64's finaliser: flipping one input bit flips about half of the output bits. Products
    wrap."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: Words = values ^ (values >> np.uint64(31))
    return mixed


@lru_cache(256)
def _keys(seed: int, stream: int) -> Words:
    """One key for each round, and one for the permutation's number."""
    return key_words(seed, stream, _ROUNDS + 1)
