"""The processes of a run, and how they share the work before its first step.

They work in turns of a few seconds and tell each other what is done; what is left is divided anew.
So none of them waits for longer than one item takes, while NCCL ends a run whose processes wait for
each other for ten minutes.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

TURN = 2.0
"""Seconds of a turn."""


class Ranks(NamedTuple):
    """The processes of a run; by default the only one.

    Args:
        rank: number of this process.
        size: number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes what all of them share."""
        return self.rank == 0

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[Result]:
        """The results of all items in order, in every process; each item is computed by one."""
        if self.size == 1:
            yield from map(function, items)
            return
        left = list(range(len(items)))
        ready: dict[int, Result] = {}
        given = 0
        while left:
            numbers = left[self.rank :: self.size]
            found = dict(self._gather(_take_turn(function, items, numbers)))
            left = [number for number in left if number not in found]
            ready |= found
            while given in ready:
                yield ready.pop(given)
                given += 1

    def ask_first(self, function: Callable[[], Result]) -> Result:
        """What a function returns in the first process, in every process."""
        found: list[Result] = self._gather([function()] if self.first else [])
        return found[0]

    def _gather(self, mine: list[Any]) -> list[Any]:
        """The lists of all processes, joined."""
        if self.size == 1:
            return mine
        from accelerate.utils import gather_object

        joined: list[Any] = gather_object(mine)
        return joined


ALONE = Ranks()
"""A process that shares with no other."""


def _take_turn(
    function: Callable[[Item], Result], items: Sequence[Item], numbers: Sequence[int]
) -> list[tuple[int, Result]]:
    """The first of these items, as many as fit into a turn, with their results."""
    end = time.monotonic() + TURN
    done = []
    for number in numbers:
        done.append((number, function(items[number])))
        if time.monotonic() > end:
            break
    return done
