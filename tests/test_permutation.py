"""Orders that are computed entry by entry: bijections of any size that follow from their keys
alone."""

from collections import Counter
from itertools import pairwise

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from lidar_synth.mixing.permutation import permute, permute_blocks
from lidar_synth.noise import key_words

KEY = st.integers(0, 2**62)


@settings(max_examples=100)
@given(st.integers(0, 3000), st.integers(0, 2**64 - 1), KEY, KEY)
def test_an_order_is_a_bijection(
    size: int, seed: int, stream: int, number: int
) -> None:
    assert sorted(permute(np.arange(size), size, seed, stream, number)) == list(
        range(size)
    )


@settings(max_examples=30)
@given(st.integers(1, 60), st.integers(1, 60), KEY)
def test_entries_follow_from_themselves_alone(
    size: int, orders: int, seed: int
) -> None:
    """One entry, or one of another order in the same call, is what it is among all."""
    entries = np.tile(np.arange(size), orders)
    numbers = np.repeat(np.arange(orders), size)
    together = permute(entries, size, seed, 1, numbers).reshape(orders, size)
    for number in range(orders):
        assert (
            together[number].tolist()
            == permute(np.arange(size), size, seed, 1, number).tolist()
        )
    assert (
        permute(np.array([size - 1]), size, seed, 1, orders - 1)[0] == together[-1, -1]
    )


@pytest.mark.parametrize("size", [2, 3, 4])
def test_short_orders_are_all_as_frequent(size: int) -> None:
    """No order of a handful of entries is off by more than a tenth."""
    count = 24_000
    found = permute(
        np.tile(np.arange(size), count), size, 7, 1, np.repeat(np.arange(count), size)
    )
    orders = Counter(map(tuple, found.reshape(count, size).tolist()))
    expected = count / np.prod(range(1, size + 1))
    assert len(orders) * expected == count
    assert max(abs(n / expected - 1) for n in orders.values()) < 0.1


@pytest.mark.parametrize("size", [1000, 10**8])
def test_long_orders_leave_no_trace_of_the_entry(size: int) -> None:
    """Places are uniform, neighbours land anywhere, and two orders have nothing in common."""
    entries = np.linspace(0, size - 1, 1000).astype(np.int64)
    places = [permute(entries, size, 5, 1, number) for number in range(20)]
    joined = np.concatenate(places)
    assert np.allclose(np.bincount(joined * 10 // size, minlength=10), 2000, atol=250)
    for a, b in pairwise(places):
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.15
        assert abs(np.corrcoef(a[1:], a[:-1])[0, 1]) < 0.15
        assert (a == b).sum() < 10


def test_an_order_is_the_same_on_every_machine() -> None:
    assert permute(np.arange(10), 10, 3, 1, 2).tolist() == [
        6,
        8,
        5,
        1,
        7,
        9,
        4,
        0,
        2,
        3,
    ]
    places = [permute_blocks(np.arange(18), 18, 2, 3, 1, n).tolist() for n in (1, 2)]
    assert places == [
        [6, 9, 0, 7, 12, 1, 8, 13, 10, 14, 15, 11, 3, 2, 4, 5, 16, 17],
        [2, 14, 3, 0, 15, 1, 4, 5, 13, 9, 6, 11, 10, 7, 8, 12, 16, 17],
    ]
    assert key_words(1, 2, 2).tolist() == [14428589422588398592, 4881784966183016231]
