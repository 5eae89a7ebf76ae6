"""The bookkeeping of a rolling bank: which scan is in which slot, how many readers copy it, and
which is made next.

The generator process keeps the ledger; this module does not depend on processes or models. Scans
for which a reader waits are made first, then those that the outlook predicts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from threading import Condition, Lock
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidar_synth.mixing.service.outlook import (
    NEVER,
    KnownOrder,
    Outlook,
    RotatingPool,
    SequentialPrefetch,
)

Starved = Literal["wait", "reuse"]
"""What happens to a request whose scan is not ready: it waits, or gets the scan in memory that was
served least."""

COUNTERS = ("made", "served", "waited", "reused")
"""Number of scans made, of requests answered, of requests that waited, and of requests that got
another scan."""
_MADE, _SERVED, _WAITED, _REUSED = range(4)


@dataclass
class Slot:
    """The state of one slot.

    Args:
        place: index of the slot.
        number: number of the scan in it; negative = none.
        checksum: checksum of its bytes.
        served: number of times the scan was served.
        lent: number of readers that are copying it.
        ready: False while it is being written.
    """

    place: int
    number: int
    checksum: int = 0
    served: int = 0
    lent: int = 0
    ready: bool = True


class Ledger:
    """The state of all slots, shared by one thread that makes scans and one thread for each reader.

    Args:
        slots: number of slots.
        counters: (4,) int64, the values of ``COUNTERS``, updated in place.
        starved: see ``Starved``.
        replaced: number of scans that an epoch replaces in a pool made of the other slots; 0 = no
            pool.
    """

    def __init__(
        self,
        slots: int,
        counters: NDArray[np.int64],
        starved: Starved = "wait",
        replaced: int = 0,
    ) -> None:
        empty = [Slot(place, -1 - place) for place in range(slots)]
        # By scan number, in the order in which they were claimed.
        self._slots = {slot.number: slot for slot in empty}
        self._counters = counters
        self._starved = starved
        self._awaited: list[int] = []  # numbers of scans for which readers wait
        self._outlook: Outlook = (
            RotatingPool(slots - replaced, replaced)
            if replaced
            else SequentialPrefetch(slots)
        )
        lock = Lock()
        self._work = Condition(lock)  # a scan may have to be made
        self._made = Condition(lock)  # a scan has become readable

    def expect(self, numbers: Sequence[int]) -> None:
        """Make only these scans ahead, in this order; a pool ignores this."""
        with self._work:
            if not isinstance(self._outlook, RotatingPool):
                self._outlook = KnownOrder(numbers, len(self._slots))
            self._work.notify_all()

    def set_epoch(self, epoch: int) -> None:
        """Let a pool replace its scans."""
        with self._work:
            if isinstance(self._outlook, RotatingPool):
                self._outlook.set_epoch(epoch)
            self._work.notify_all()

    def lend(self, number: int) -> Slot:
        """The slot with the scan for a request; the reader must give it back."""
        with self._work:
            number = self._outlook.answer(number)
            slot = self._ready(number) or self._substitute() or self._wait(number)
            self._counters[_SERVED] += 1
            slot.served += 1
            slot.lent += 1
            return slot

    def give_back(self, slot: Slot) -> None:
        """Return a slot after its reader has copied the scan, or has died."""
        with self._work:
            slot.lent -= 1
            self._work.notify_all()

    def claim(self, most: int) -> list[Slot]:
        """Slots to be written, with the numbers of their scans; waits until there is at least one.

        At most half of all slots are claimed, so that scans can be served in the meantime.
        """
        with self._work:
            most = min(most, max(1, len(self._slots) // 2))
            while not (claimed := list(self._claim(most))):
                self._work.wait()
            return claimed

    def publish(self, slot: Slot, checksum: int) -> None:
        """Mark a slot as written."""
        with self._work:
            slot.checksum = checksum
            slot.ready = True
            self._counters[_MADE] += 1
            self._made.notify_all()

    def _ready(self, number: int) -> Slot | None:
        slot = self._slots.get(number)
        return slot if slot and slot.ready else None

    def _substitute(self) -> Slot | None:
        """With ``starved="reuse"``, the scan that was served least, if there is any."""
        readable = [
            slot for slot in self._slots.values() if slot.ready and slot.number >= 0
        ]
        if self._starved == "wait" or not readable:
            return None
        self._counters[_REUSED] += 1
        return min(readable, key=lambda slot: slot.served)

    def _wait(self, number: int) -> Slot:
        """Request that the scan is made next, and wait for it."""
        self._counters[_WAITED] += 1
        self._awaited.append(number)
        self._work.notify_all()
        try:
            while not (slot := self._ready(number)):
                self._made.wait()
        finally:
            self._awaited.remove(number)
        return slot

    def _claim(self, most: int) -> Iterator[Slot]:
        for _ in range(most):
            awaited = next((n for n in self._awaited if n not in self._slots), None)
            # An awaited scan comes before all predicted ones.
            wanted = (
                self._outlook.upcoming(self._slots)
                if awaited is None
                else (-1.0, awaited)
            )
            slot = None if wanted is None else self._to_overwrite(wanted[0])
            if wanted is None or slot is None:
                return
            del self._slots[slot.number]
            slot.number = wanted[1]
            slot.served = 0
            slot.ready = False
            self._slots[slot.number] = slot
            yield slot

    def _next_use(self, slot: Slot) -> float:
        if slot.number >= 0:
            return self._outlook.next_use(slot.number, slot.served)
        return NEVER

    def _to_overwrite(self, use: float) -> Slot | None:
        """The slot to overwrite for a scan with this use: the oldest that is not needed, or the one
        needed last."""
        idle = [
            s
            for s in self._slots.values()
            if s.ready and not s.lent and s.number not in self._awaited
        ]
        last = next((s for s in idle if self._next_use(s) == NEVER), None) or max(
            idle, key=self._next_use, default=None
        )
        return last if last and self._next_use(last) > use else None
