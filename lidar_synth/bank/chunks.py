"""Compression of scans to the chunks of an HDF5 dataset, in the format of HDF5's own filters.

HDF5 does not compress the chunks itself because it holds one global lock. libdeflate compresses and
decompresses in half of zlib's time (docs/research/benchmarks.md).
"""

import math
from collections.abc import Mapping
from typing import Any

import deflate as libdeflate
import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import needs

_GZIP_LEVEL = 1
_DEFLATE_RATIO = 1032  # highest compression ratio that deflate can reach

FILTERS = {
    "gzip": (
        h5py.h5z.FILTER_SHUFFLE,
        h5py.h5z.FILTER_DEFLATE,
        h5py.h5z.FILTER_FLETCHER32,
    ),
    "blosc2": (32026, h5py.h5z.FILTER_FLETCHER32),
}
"""HDF5 numbers of the filters of a chunk, in order, by ``compression``."""


def checksum(
    seed: int, index: int, arrays: Mapping[str, NDArray[Any]], condition: bytes = b""
) -> int:
    """CRC-32 of a scan: seed and index (8 bytes each, little-endian), the condition's name, then
    the arrays."""
    crc = libdeflate.crc32(
        seed.to_bytes(8, "little") + index.to_bytes(8, "little") + condition
    )
    for values in arrays.values():
        crc = libdeflate.crc32(values.data, crc)
    return crc


def deflate(values: NDArray[Any]) -> bytes:
    """Compress an array to a chunk, like HDF5's filters shuffle, deflate and fletcher32."""
    size = values.itemsize
    planes = np.empty((size, values.size), np.uint8)
    for k, plane in enumerate(planes):
        np.right_shift(values.reshape(-1), 8 * k, out=plane, casting="unsafe")
    packed = libdeflate.zlib_compress(planes.data, _GZIP_LEVEL)
    return bytes(packed + fletcher32(packed).to_bytes(4, "little"))


def inflate(chunk: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The inverse of ``deflate``.

    Raises:
        ValueError: if the chunk is damaged, or holds something else.
    """
    packed = memoryview(chunk)[:-4]
    if fletcher32(packed) != int.from_bytes(chunk[-4:], "little"):
        raise ValueError("its Fletcher-32 does not match")
    plain = _decompress(packed, math.prod(shape) * dtype.itemsize)
    first, *others = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
    values = first.astype(dtype, copy=False)
    for k, plane in enumerate(others, 1):
        values |= np.left_shift(plane, 8 * k, dtype=dtype)
    return values.reshape(shape)


def _decompress(packed: memoryview, size: int) -> bytearray:
    if size > _DEFLATE_RATIO * len(packed):
        raise ValueError(f"{len(packed)} bytes cannot hold {size}")
    try:
        plain = libdeflate.zlib_decompress(packed, size)
    except libdeflate.DeflateError as error:
        raise ValueError(f"it is damaged or does not hold {size} bytes") from error
    if len(plain) != size:
        raise ValueError(f"it holds {len(plain)} bytes instead of {size}")
    return plain


def unpack(
    chunk: bytes, shape: tuple[int, ...], dtype: np.dtype[Any], compression: str
) -> NDArray[Any]:
    """Decompress a chunk of a file to its array.

    Raises:
        ValueError, OSError, RuntimeError: if the chunk is damaged, or holds something else.
        LibraryError: on Blosc2 without hdf5plugin.
    """
    if compression == "gzip":
        return inflate(chunk, shape, dtype)
    # hdf5plugin's filters work only within HDF5: a file in memory with this one chunk decompresses
    # it.
    options = {"chunks": (1, *shape), "fletcher32": True, **filters(compression)}
    with h5py.File("chunk", "w", driver="core", backing_store=False) as file:
        dataset = file.create_dataset("values", (1, *shape), dtype, **options)
        dataset.id.write_direct_chunk((0,) * dataset.ndim, chunk)
        values: NDArray[Any] = dataset[0]
    return values


def fletcher32(data: bytes | bytearray | memoryview) -> int:
    """The checksum of HDF5's fletcher32 filter, over big-endian 16-bit words; an odd last byte is a
    high byte."""
    first, second = _fletcher_sums(np.frombuffer(data, np.uint8))
    if len(data) % 2:
        first += data[-1] << 8
        second += first
    # Sums are folded with end-around carry, so that a multiple of 65535 becomes 65535 and not 0.
    low, high = ((total - 1) % 0xFFFF + 1 if total else 0 for total in (first, second))
    return high << 16 | low


@numba.njit(nogil=True, cache=True)
def _fletcher_sums(data):  # type: ignore[no-untyped-def]  # (N,) uint8, compiled
    """The sum of the complete 16-bit words, and the sum of the partial sums after each word."""
    count = len(data) // 2
    first = second = np.int64(0)
    for i in range(count):
        word = np.int64(data[2 * i]) << 8 | np.int64(data[2 * i + 1])
        first += word
        second += word * (count - i)
    return first, second


def filters(compression: str) -> Mapping[str, Any]:
    """Arguments of ``h5py.create_dataset`` for gzip, which every HDF5 reads, or for Blosc2 (zstd 3,
    bits shuffled).

    Blosc2 needs hdf5plugin; importing it also registers the filter with HDF5.

    Raises:
        LibraryError: on Blosc2 without hdf5plugin.
    """
    if compression == "gzip":
        return {"shuffle": True, "compression": "gzip", "compression_opts": _GZIP_LEVEL}
    instead = ", or bake with compression gzip."
    with needs("blosc2", "a bank with Blosc2, but hdf5plugin", instead):
        import hdf5plugin
    return dict(
        hdf5plugin.Blosc2(cname="zstd", clevel=3, filters=hdf5plugin.Blosc2.BITSHUFFLE)
    )
