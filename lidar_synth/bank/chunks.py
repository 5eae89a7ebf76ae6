"""Scans as the chunks of an HDF5 dataset, made in the same way as HDF5's own filters make them.

They are made here and not by HDF5, because HDF5 does one thing at a time and zlib leaves the other threads alone.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import LibraryError

_GZIP_LEVEL = 1


def checksum(seed: int, index: int, arrays: Mapping[str, NDArray[Any]], condition: bytes = b"") -> int:
    """CRC-32 of what a scan is: seed and index (8 bytes each, lowest first), the condition's name, then the arrays."""
    crc = zlib.crc32(seed.to_bytes(8, "little") + index.to_bytes(8, "little") + condition)
    for values in arrays.values():
        crc = zlib.crc32(values.data, crc)
    return crc


def deflate(values: NDArray[Any]) -> bytes:
    """A chunk as HDF5's filters shuffle, deflate and fletcher32 make it."""
    shuffled = values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    packed = zlib.compress(shuffled, _GZIP_LEVEL)
    return packed + fletcher32(packed).to_bytes(4, "little")


def fletcher32(data: bytes) -> int:
    """The checksum of HDF5's filter of that name: over big-endian 16-bit words, an odd last byte as the higher one."""
    words = np.frombuffer(data + b"\0" * (len(data) % 2), ">u2").astype(np.int64)
    first, second = int(words.sum()), int(words @ np.arange(len(words), 0, -1))
    # Sums are folded with end-around carry, so that a multiple of 65535 becomes 65535 and not 0.
    low, high = ((total - 1) % 0xFFFF + 1 if total else 0 for total in (first, second))
    return high << 16 | low


def filters(compression: str) -> Mapping[str, Any]:
    """What ``h5py.create_dataset`` takes for gzip, which every HDF5 reads, or for Blosc2 (zstd 3, bits shuffled), which
    reads twice as fast where hdf5plugin is installed; importing that is also what makes HDF5 know Blosc2.

    Raises:
        LibraryError: on Blosc2 without hdf5plugin.
    """
    if compression == "gzip":
        return {"shuffle": True, "compression": "gzip", "compression_opts": _GZIP_LEVEL}
    try:
        import hdf5plugin
    except ImportError as error:
        raise LibraryError(
            f"a bank with Blosc2, but hdf5plugin cannot be imported ({error})",
            "the extra blosc2",
            "pip install 'lidar_synth[blosc2]', or bake with compression gzip.",
        ) from error
    return dict(hdf5plugin.Blosc2(cname="zstd", clevel=3, filters=hdf5plugin.Blosc2.BITSHUFFLE))
