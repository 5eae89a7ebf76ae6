"""The order in which the generator process makes scans, and which slots it may reuse."""

import threading

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings

from lidar_synth.mixing.service.ledger import COUNTERS, Ledger
from lidar_synth.mixing.service.outlook import (
    NEVER,
    KnownOrder,
    RotatingPool,
    SequentialPrefetch,
)


def test_sequential_prefetch_follows_the_requests() -> None:
    outlook = SequentialPrefetch(window=4)
    assert outlook.upcoming({0, 1, 3}) == (2, 2)
    outlook.answer(5)
    assert outlook.upcoming({2}) == (3, 3)
    # Farther behind than the window.
    assert [outlook.next_use(n, 0) for n in (0, 1, 2)] == [
        NEVER,
        1,
        2,
    ]
    assert outlook.next_use(2, served=1) == NEVER
    outlook.answer(70)  # training goes on at another place
    assert outlook.upcoming(()) == (70, 70)
    assert outlook.next_use(5, 0) == NEVER
    outlook.answer(0)  # and begins again
    assert outlook.upcoming({0}) == (1, 1)


def test_a_known_order_predicts_every_use() -> None:
    outlook = KnownOrder([7, 9, 7, 8], window=4)
    assert outlook.upcoming(()) == (0, 7)
    assert outlook.upcoming({7}) == (1, 9)
    outlook.answer(7)
    assert [outlook.next_use(n, 0) for n in (7, 8, 9, 6)] == [2, 3, 1, NEVER]
    assert outlook.upcoming({7, 9}) == (3, 8)
    assert outlook.upcoming({7, 8, 9}) is None
    outlook = KnownOrder([7, 9, 7, 8], window=4)
    assert [outlook.answer(n) for n in (7, 9)] == [7, 9]
    assert outlook.upcoming(()) == (
        2,
        7,
    )  # what was asked for already is not made for that
    for number in (7, 8, 5):
        assert outlook.answer(number) == number
    assert outlook.next_use(7, 0) == NEVER


def test_a_pool_replaces_its_oldest_scans() -> None:
    outlook = RotatingPool(size=4, replaced=1)
    assert [outlook.answer(n) for n in range(6)] == [0, 1, 2, 3, 0, 1]
    outlook.set_epoch(2)
    assert [outlook.answer(n) for n in range(6)] == [4, 5, 2, 3, 4, 5]
    assert [outlook.next_use(n, 9) for n in (1, 2)] == [NEVER, 2]
    assert outlook.upcoming({2, 3}) == (4, 4)


def make_in_thread(ledger: Ledger, size: int) -> None:
    """A maker whose scans are their numbers."""

    def work() -> None:
        while True:
            for slot in ledger.claim(size):
                ledger.publish(slot, slot.number)

    threading.Thread(target=work, daemon=True).start()


@settings(max_examples=40)
@given(
    slots=st.integers(1, 6),
    size=st.integers(1, 4),
    told=st.none() | st.lists(st.integers(0, 12), max_size=12),
    requests=st.lists(st.integers(0, 12) | st.integers(0, 2**62), max_size=20),
)
def test_every_request_gets_its_scan_for_any_announced_order(
    slots: int, size: int, told: list[int] | None, requests: list[int]
) -> None:
    counters = np.zeros(len(COUNTERS), np.int64)
    ledger = Ledger(slots, counters)
    if told is not None:
        ledger.expect(told)
    make_in_thread(ledger, size)
    for number in requests:
        slot = ledger.lend(number)
        assert (slot.number, slot.checksum, slot.ready) == (number, number, True)
        ledger.give_back(slot)
    assert counters[1] == len(requests)


def claimed(ledger: Ledger, most: int = 9) -> list[int]:
    """The numbers of the next scans, as if they were made."""
    slots = ledger.claim(most)
    for slot in slots:
        ledger.publish(slot, 0)
    return [slot.number for slot in slots]


def test_scans_are_made_in_the_order_of_their_use() -> None:
    ledger = Ledger(4, np.zeros(4, np.int64))
    assert claimed(ledger) == [0, 1]  # half of the slots at a time
    ledger.expect([5, 1, 5, 6, 7, 8])
    assert claimed(ledger) == [
        5,
        6,
    ]  # in the place of what is not there and of 0; 1 is kept
    ledger.give_back(ledger.lend(5))
    assert claimed(ledger) == [7]
    lent = [ledger.lend(1), ledger.lend(5)]
    assert ledger._to_overwrite(99) is None  # two are read, two are still to be used
    ledger.give_back(lent[1])
    assert claimed(ledger) == [8]


def test_a_scan_that_is_read_stays_until_it_is_given_back() -> None:
    ledger = Ledger(1, np.zeros(4, np.int64))
    assert claimed(ledger) == [0]
    lent = ledger.lend(0)
    thread = threading.Thread(
        target=lambda: ledger.give_back(ledger.lend(1)), daemon=True
    )
    thread.start()
    maker = threading.Thread(target=claimed, args=(ledger,), daemon=True)
    maker.start()
    maker.join(0.2)
    assert (maker.is_alive(), lent.number, lent.ready) == (True, 0, True)
    ledger.give_back(lent)
    maker.join(10)
    thread.join(10)
    assert (maker.is_alive(), thread.is_alive(), lent.number) == (False, False, 1)


def test_a_scan_for_which_a_reader_waits_is_not_overwritten() -> None:
    ledger = Ledger(1, np.zeros(4, np.int64))
    ledger._awaited += [5, 6]  # as two readers leave it that have not woken up yet
    assert claimed(ledger) == [5]
    assert ledger._to_overwrite(-1) is None
    ledger._awaited.remove(5)
    assert claimed(ledger) == [6]


def test_starved_requests_are_counted_and_get_the_scan_served_least() -> None:
    counters = np.zeros(4, np.int64)
    ledger = Ledger(4, counters, "reuse")
    assert claimed(ledger) == [0, 1]
    assert [ledger.lend(n).number for n in (0, 9, 9, 9)] == [0, 1, 0, 1]
    assert dict(zip(COUNTERS, counters.tolist(), strict=True)) == {
        "made": 2,
        "served": 4,
        "waited": 0,
        "reused": 3,
    }
