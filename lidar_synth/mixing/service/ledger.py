"""The rolling bank's books: which scan stands in which slot, who copies it, and which is made next.

The generator process keeps them; nothing here knows of processes or models. A scan that somebody waits for is made
first, then those of the outlook.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from threading import Condition, Lock
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidar_synth.mixing.service.outlook import NEVER, KnownOrder, Outlook, RotatingPool, SequentialPrefetch

Starved = Literal["wait", "reuse"]
"""What a request does whose scan is not there: wait for it, or take the held one that was served least."""

COUNTERS = ("made", "served", "waited", "reused")
"""Scans made, requests answered, those that had to wait, and those that got another scan than theirs instead."""
_MADE, _SERVED, _WAITED, _REUSED = range(4)


@dataclass
class Slot:
    """One slot's page.

    Args:
        place: its index.
        number: of the scan in it; negative = none.
        checksum: of its bytes.
        served: how often the scan was served.
        lent: readers that copy it now.
        ready: False while it is written.
    """

    place: int
    number: int
    checksum: int = 0
    served: int = 0
    lent: int = 0
    ready: bool = True


class Ledger:
    """The books, for one thread that makes scans and one for each reader.

    Args:
        slots: how many.
        counters: (4,) int64, the values of ``COUNTERS``, in place.
        starved: see ``Starved``.
        replaced: scans that an epoch replaces in a pool of the other slots; 0 = no pool.
    """

    def __init__(self, slots: int, counters: NDArray[np.int64], starved: Starved = "wait", replaced: int = 0) -> None:
        empty = [Slot(place, -1 - place) for place in range(slots)]
        self._held = {slot.number: slot for slot in empty}  # by number, in the order in which they were claimed
        self._counters = counters
        self._starved = starved
        self._asked: list[int] = []  # numbers that readers wait for
        self._outlook: Outlook = RotatingPool(slots - replaced, replaced) if replaced else SequentialPrefetch(slots)
        lock = Lock()
        self._work = Condition(lock)  # something may have to be made
        self._made = Condition(lock)  # something can be read

    def expect(self, numbers: Sequence[int]) -> None:
        """Make these ahead, in this order, and no others; a pool knows better."""
        with self._work:
            if not isinstance(self._outlook, RotatingPool):
                self._outlook = KnownOrder(numbers, len(self._held))
            self._work.notify_all()

    def set_epoch(self, epoch: int) -> None:
        """Let a pool replace its scans."""
        with self._work:
            if isinstance(self._outlook, RotatingPool):
                self._outlook.set_epoch(epoch)
            self._work.notify_all()

    def lend(self, number: int) -> Slot:
        """The slot with the scan for this request; it has to be given back."""
        with self._work:
            number = self._outlook.answer(number)
            slot = self._ready(number) or self._substitute() or self._wait(number)
            self._counters[_SERVED] += 1
            slot.served += 1
            slot.lent += 1
            return slot

    def give_back(self, slot: Slot) -> None:
        """The reader has copied it, or is dead."""
        with self._work:
            slot.lent -= 1
            self._work.notify_all()

    def claim(self, most: int) -> list[Slot]:
        """Slots that are to be written, with the numbers of their scans; waits until there is one.

        At most half of all slots, so that there is something to serve in the meantime.
        """
        with self._work:
            most = min(most, max(1, len(self._held) // 2))
            while not (claimed := list(self._claim(most))):
                self._work.wait()
            return claimed

    def publish(self, slot: Slot, checksum: int) -> None:
        """The slot is written."""
        with self._work:
            slot.checksum, slot.ready = checksum, True
            self._counters[_MADE] += 1
            self._made.notify_all()

    def _ready(self, number: int) -> Slot | None:
        slot = self._held.get(number)
        return slot if slot and slot.ready else None

    def _substitute(self) -> Slot | None:
        """The scan that was served least, where ``starved`` says so and there is one."""
        held = [slot for slot in self._held.values() if slot.ready and slot.number >= 0]
        if self._starved == "wait" or not held:
            return None
        self._counters[_REUSED] += 1
        return min(held, key=lambda slot: slot.served)

    def _wait(self, number: int) -> Slot:
        """Have the scan made next, and wait for it."""
        self._counters[_WAITED] += 1
        self._asked.append(number)
        self._work.notify_all()
        try:
            while not (slot := self._ready(number)):
                self._made.wait()
        finally:
            self._asked.remove(number)
        return slot

    def _claim(self, most: int) -> Iterator[Slot]:
        for _ in range(most):
            asked = next((n for n in self._asked if n not in self._held), None)
            wanted = self._outlook.upcoming(self._held) if asked is None else (-1.0, asked)
            slot = None if wanted is None else self._room(wanted[0])
            if wanted is None or slot is None:
                return
            del self._held[slot.number]
            slot.number, slot.served, slot.ready = wanted[1], 0, False
            self._held[slot.number] = slot
            yield slot

    def _use(self, slot: Slot) -> float:
        return self._outlook.next_use(slot.number, slot.served) if slot.number >= 0 else NEVER

    def _room(self, use: float) -> Slot | None:
        """The slot whose scan gives way to one with this use: the oldest that is not needed, or that needed last."""
        idle = [s for s in self._held.values() if s.ready and not s.lent and s.number not in self._asked]
        last = next((s for s in idle if self._use(s) == NEVER), None) or max(idle, key=self._use, default=None)
        return last if last and self._use(last) > use else None
