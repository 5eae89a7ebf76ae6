"""Which scans will be asked for, and when: what a rolling bank makes ahead, and which scans it can let go.

An outlook gives every scan a *use*: how far along it is needed next, ``NEVER`` where it is not. The scan with the
nearest use is made first, and the one with the farthest gives way to it (Belady's rule, which no other beats).
"""

import math
from collections import defaultdict, deque
from collections.abc import Container, Sequence
from typing import Protocol

NEVER = math.inf


class Outlook(Protocol):
    """What the ledger needs to know of the future."""

    def answer(self, number: int) -> int:
        """Which scan a request for ``number`` gets; it is noted that the request came."""
        ...

    def upcoming(self, held: Container[int]) -> tuple[float, int] | None:
        """Use and number of the nearest scan that is not held; None where no more is known."""
        ...

    def next_use(self, number: int, served: int) -> float:
        """The next use of a scan that was served so many times already."""
        ...


class SequentialPrefetch:
    """Nobody said anything: 0, 1, 2, ... or on from wherever requests are.

    Args:
        window: how far requests come out of order at most; what is left behind farther will not be asked for.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._past = self._next = 0

    def answer(self, number: int) -> int:
        if not self._past <= number < self._next + self._window:
            self._past = self._next = number  # not out of order, but training that goes on somewhere else
        self._past = max(self._past, number - self._window)
        return number

    def upcoming(self, held: Container[int]) -> tuple[float, int]:
        while self._next in held:
            self._next += 1
        return self._next, self._next

    def next_use(self, number: int, served: int) -> float:
        return NEVER if served or number < self._past else number


class KnownOrder:
    """The numbers are known, in order; a number may stand there more than once.

    Args:
        numbers: of the scans.
        window: as for ``SequentialPrefetch``.
    """

    def __init__(self, numbers: Sequence[int], window: int) -> None:
        self._numbers, self._window = numbers, window
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


class RotatingPool:
    """Some scans that serve for an epoch; with the next one, the oldest of them are replaced.

    Args:
        size: scans in the pool.
        replaced: how many an epoch replaces.
    """

    def __init__(self, size: int, replaced: int) -> None:
        self._size, self._replaced = size, replaced
        self.set_epoch(0)

    def set_epoch(self, epoch: int) -> None:
        """Move on to this epoch's scans."""
        self._first = self._next = epoch * self._replaced

    def answer(self, number: int) -> int:
        return self._first + (number - self._first) % self._size

    def upcoming(self, held: Container[int]) -> tuple[float, int]:
        while self._next in held:
            self._next += 1
        return self._next, self._next

    def next_use(self, number: int, served: int) -> float:
        return number if number >= self._first else NEVER
