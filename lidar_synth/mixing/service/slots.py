"""Shared memory with encoded scans, which the generator process writes and the readers copy.

It is one block without a file. On Linux and Windows it has no name either, so that the kernel frees
it when the last process that maps it ends in any way; elsewhere torch's own manager frees it.
Besides the scans it holds the counters and the last words of the process that fills it.
"""

import math
import zlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import RangeImage
from lidar_synth.mixing.service.ledger import COUNTERS

_WORDS = 4096  # bytes for the last words


class Slots:
    """Memory for a number of scans, shared with every process to which this object is passed.

    Args:
        encoding: the encoding of the scans.
        count: number of slots.

    Raises:
        ConfigError: if there is not enough shared memory.
    """

    def __init__(self, encoding: Encoding, count: int) -> None:
        self.encoding = encoding
        self.count = count
        self._layout = encoding.arrays()
        self._size = sum(
            math.prod(shape) * dtype.itemsize for shape, dtype in self._layout.values()
        )
        head = 8 * len(COUNTERS) + _WORDS
        try:
            size = head + count * self._size
            memory = torch.zeros(size, dtype=torch.uint8, device="cpu")
            self._memory = memory.share_memory_()  # type: ignore[no-untyped-call]
        except RuntimeError as error:
            raise ConfigError(
                f"a rolling bank of {count} slots, {count * self._size / 1e6:.0f} MB of shared "
                f"memory ({error})",
                "no more than is free",
                "Use fewer slots, or a container with more shared memory: docker run "
                "--shm-size=1g.",
            ) from error

    @property
    def counters(self) -> NDArray[np.int64]:
        """(4,) a view of the values of ``COUNTERS``; only the generator process writes them."""
        return self._part(0, 8 * len(COUNTERS)).view(np.int64)

    @property
    def last_words(self) -> str:
        """The reason why the generator process ended, if it could write one."""
        return bytes(self._words()).rstrip(b"\0").decode(errors="replace")

    @last_words.setter
    def last_words(self, text: str) -> None:
        content = text.encode()[:_WORDS]
        self._words()[: len(content)] = np.frombuffer(content, np.uint8)

    def write(self, slot: int, number: int, image: RangeImage) -> int:
        """Write scan ``number`` into a slot without readers, and return its checksum."""
        place = self._slot(slot)
        self.encoding.encode(image, out=self._arrays(place))
        return _checksum(place, number)

    def read(self, slot: int, number: int, checksum: int) -> dict[str, NDArray[Any]]:
        """A copy of the encoded arrays of scan ``number`` in a slot.

        Raises:
            DataError: if the bytes are not those that were written.
        """
        copy = self._slot(slot).copy()
        if _checksum(copy, number) != checksum:
            raise DataError(
                f"scan {number} in slot {slot} of the rolling bank is damaged",
                f"checksum {checksum:08x}",
            )
        return self._arrays(copy)

    def _part(self, start: int, size: int) -> NDArray[np.uint8]:
        part: NDArray[np.uint8] = self._memory.numpy()[start : start + size]
        return part

    def _words(self) -> NDArray[np.uint8]:
        return self._part(8 * len(COUNTERS), _WORDS)

    def _slot(self, slot: int) -> NDArray[np.uint8]:
        return self._part(8 * len(COUNTERS) + _WORDS + slot * self._size, self._size)

    def _arrays(self, place: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """The scan's arrays in the bytes of one slot."""
        arrays = {}
        start = 0
        for name, (shape, dtype) in self._layout.items():
            size = math.prod(shape) * dtype.itemsize
            arrays[name] = place[start : start + size].view(dtype).reshape(shape)
            start += size
        return arrays


def _checksum(content: NDArray[np.uint8], number: int) -> int:
    """CRC-32 of a slot's bytes and of the scan's number, so that a scan in a wrong slot is noticed
    as well."""
    return zlib.crc32(content.data, zlib.crc32(number.to_bytes(8, "little")))
