"""Outlooks predict which scans will be requested next, and which slots of a rolling bank may be
overwritten.

An outlook assigns every scan a *use*: the position of its next request, or ``NEVER``. The scan with
the nearest use is made first, and the scan with the farthest use is overwritten (Belady's rule,
which is optimal).
"""

import math
from collections import defaultdict, deque
from collections.abc import Container, Sequence
from typing import Protocol

NEVER = math.inf


class Outlook(Protocol):
    """A prediction of requests for the ledger."""

    def answer(self, number: int) -> int:
        """The number of the scan that serves a request for ``number``; the request is recorded."""
        ...

    def upcoming(self, held: Container[int]) -> tuple[float, int] | None:
        """The use and number of the next scan that is not held in memory; None if no further
        request is known."""
        ...

    def next_use(self, number: int, served: int) -> float:
        """The next use of a scan that was already served ``served`` times."""
        ...


class _InTurn:
    """Numbers that follow one another."""

    _next: int

    def upcoming(self, held: Container[int]) -> tuple[float, int]:
        while self._next in held:
            self._next += 1
        return self._next, self._next


class SequentialPrefetch(_InTurn):
    """Predicts 0, 1, 2, ..., or consecutive numbers from the latest request on, when no order was
    announced.

    Args:
        window: maximum distance of requests that come out of order; older scans are not expected to
            be requested.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._past = self._next = 0

    def answer(self, number: int) -> int:
        if not self._past <= number < self._next + self._window:
            self._past = self._next = (
                number  # a jump: training has resumed at another position
            )
        self._past = max(self._past, number - self._window)
        return number

    def next_use(self, number: int, served: int) -> float:
        return NEVER if served or number < self._past else number


class KnownOrder:
    """Predicts an announced order of numbers, which may contain a number several times.

    Args:
        numbers: numbers of the scans, in the order of their requests.
        window: as for ``SequentialPrefetch``.
    """

    def __init__(self, numbers: Sequence[int], window: int) -> None:
        self._numbers = numbers
        self._window = window
        self._uses: dict[int, deque[int]] = defaultdict(deque)
        for place, number in enumerate(numbers):
            self._uses[number].append(place)
        self._past = self._next = 0

    def answer(self, number: int) -> int:
        if self._due(number) < NEVER:
            self._past = max(self._past, self._uses[number].popleft() - self._window)
        return number

    def upcoming(self, held: Container[int]) -> tuple[float, int] | None:
        while self._next < len(self._numbers):
            number = self._numbers[self._next]
            if number not in held and self._due(number) <= self._next:
                return self._next, number
            self._next += 1
        return None

    def next_use(self, number: int, served: int) -> float:
        return self._due(number)

    def _due(self, number: int) -> float:
        uses = self._uses.get(number)
        while uses and uses[0] < self._past:
            uses.popleft()
        return uses[0] if uses else NEVER


class RotatingPool(_InTurn):
    """A pool of scans that serves all requests of an epoch; each new epoch replaces the oldest
    scans.

    Args:
        size: number of scans in the pool.
        replaced: number of scans that an epoch replaces.
    """

    def __init__(self, size: int, replaced: int) -> None:
        self._size = size
        self._replaced = replaced
        self.set_epoch(0)

    def set_epoch(self, epoch: int) -> None:
        """Switch to this epoch's scans."""
        self._first = self._next = epoch * self._replaced

    def answer(self, number: int) -> int:
        return self._first + (number - self._first) % self._size

    def next_use(self, number: int, served: int) -> float:
        return number if number >= self._first else NEVER
