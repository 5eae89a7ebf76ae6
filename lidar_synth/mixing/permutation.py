"""A random order of any length whose entries are computed one by one, without the others.

``permute`` is a Feistel network over the cells of a grid that holds barely more cells than there are entries (Black and
Rogaway, "Ciphers with arbitrary finite domains", CT-RSA 2002): each round shifts a cell's row by a keyed hash of its
column, or its column by a hash of its row, so that every round is a bijection. An entry that leaves the range goes
through the network again until it is back ("cycle walking"), which is a bijection too. Memory does not depend on the
length.
"""

from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from lidar_synth.noise import key_words

_ROUNDS = 10  # with fewer, the orders of a handful of entries are not equally frequent


def permute(
    entries: NDArray[np.int64], size: int, seed: int, stream: int, number: int | NDArray[np.int64] = 0
) -> NDArray[np.int64]:
    """Where the entries of 0 .. size - 1 stand in an order of them all.

    Args:
        entries: (N,), 0 <= entry < size.
        size: length of the order, below 2^62.
        seed: 0 <= seed < 2^64.
        stream: keeps orders of different use apart, 0 <= stream < 2^63.
        number: of the order, such as an epoch; one, or (N,) for each entry its own. The orders are independent.

    Returns:
        (N,) 0 <= place < size; a bijection of the entries for each (size, seed, stream, number), the same on every
        machine.
    """
    if size <= 1 or not len(entries):
        return np.zeros(len(entries), np.int64)
    keys = _keys(seed, stream)
    order = _mixed(np.broadcast_to(np.asarray(number, np.int64), (len(entries),)).astype(np.uint64) + keys[-1])
    places = _once(entries.astype(np.uint64), size, keys, order)
    while len(outside := np.flatnonzero(places >= size)):
        places[outside] = _once(places[outside], size, keys, order[outside])
    return places.astype(np.int64)


def _once(
    cells: NDArray[np.uint64], size: int, keys: NDArray[np.uint64], order: NDArray[np.uint64]
) -> NDArray[np.uint64]:
    """All rounds of the network once, over a grid of at least ``size`` cells."""
    rows = isqrt(size - 1) + 1
    columns = -(-size // rows)
    row, column = cells // np.uint64(columns), cells % np.uint64(columns)
    for i, key in enumerate(keys[:-1]):
        if i % 2:
            column = _shifted(column, columns, row + key ^ order)
        else:
            row = _shifted(row, rows, column + key ^ order)
    return row * np.uint64(columns) + column


def _shifted(places: NDArray[np.uint64], size: int, keyed: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Each of 0 .. size - 1, size < 2^32, moved on by a hash of its keyed value, round about."""
    moved: NDArray[np.uint64] = places + ((_mixed(keyed) >> np.uint64(32)) * np.uint64(size) >> np.uint64(32))
    return moved - (moved >= size) * np.uint64(size)


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """SplitMix64's finaliser: every bit of a value changes about half of the result's. Products wrap."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed: NDArray[np.uint64] = values ^ (values >> np.uint64(31))
    return mixed


@lru_cache(256)
def _keys(seed: int, stream: int) -> NDArray[np.uint64]:
    """A key for each round and one for the order's number."""
    return key_words(seed, stream, _ROUNDS + 1)
