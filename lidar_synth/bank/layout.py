"""The positions of a shard's values in its file. All declarations are validated before memory is
allocated for them.

A shard may come from an untrusted source. HDF5 would follow links and external or virtual storage
into other files, run arbitrary filters, and allocate memory for any declared shape. Here a shard
has exactly the named datasets, each stored in the file itself, with the shapes and types that its
facts imply.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from lidar_synth.bank.chunks import FILTERS
from lidar_synth.bank.facts import Facts
from lidar_synth.bank.index import SCAN_NUMBERS
from lidar_synth.bank.storage import RangedFile, Storage

T = TypeVar("T")

Arrays = Mapping[str, tuple[tuple[int, int], np.dtype[Any]]]
"""Shape and type of each array of one scan, as ``Encoding.arrays`` gives them."""

NUMBERS: dict[str, np.dtype[Any]] = {
    "seed": np.dtype("<u8"),
    "index": np.dtype("<u8"),
    "crc": np.dtype("<u4"),
}
"""Datasets with one number per scan."""

CONDITION = "condition"

_ATTRIBUTES = 64
_ATTRIBUTE_SIZE = 1 << 20
# Bytes of a shard's metadata, without facts of more than 4 kB and without the chunks' addresses.
_BASE = 12 << 10
_PLACE = 16  # bytes of a chunk's address in the metadata
_PASSES = 32  # most reads to collect the metadata
# Most bytes of one Blosc2 array: unlike deflate, Blosc2 has no highest compression ratio.
_BLOSC2_ARRAY = 32 << 20


@dataclass(frozen=True)
class Chunks:
    """The addresses of one array's chunks, by position of the scan.

    Args:
        offset: (N,) uint64, from the beginning of the file.
        size: (N,) uint64 bytes; 0 where there is no chunk.
        skipped: (N,) uint32, a bit mask of the filters that were not applied.
    """

    offset: NDArray[np.uint64]
    size: NDArray[np.uint64]
    skipped: NDArray[np.uint32]


@dataclass(frozen=True)
class ShardLayout:
    """The numbers of a shard and the addresses of its chunks.

    Args:
        numbers: {name: (N,)} for the names in ``NUMBERS``.
        conditions: (N,) text, or None.
        chunks: {name: addresses} for each array.
    """

    numbers: dict[str, NDArray[Any]]
    conditions: NDArray[np.bytes_] | None
    chunks: dict[str, Chunks]


def metadata_size(facts: Facts, scans: int) -> int:
    """Upper bound of a shard's metadata in bytes. The writer reserves this block at the beginning
    of the file; facts of more than 4 kB follow it, and then the numbers.
    """
    return _BASE + scans * _PLACE * len(facts.encoding.names)


def head_size(facts: Facts, scans: int) -> int:
    """Bytes of all that a shard holds beside its chunks, rounded up."""
    return metadata_size(facts, scans) + facts.text_size + scans * SCAN_NUMBERS


def with_hdf5(
    storage: Storage, facts: Facts | None, scans: int, work: Callable[[h5py.File], T]
) -> T:
    """Call ``work`` on the metadata and numbers of a stored file; one read is enough where they are
    contiguous.

    Args:
        storage: the file.
        facts, scans: the expected content.
        work: called with the open file; several times if the metadata is scattered.

    Raises:
        OSError, RuntimeError: from HDF5, if it is not a valid file.
        FileError, DataError: as ``LocalFile.read``.
    """
    view = RangedFile(
        storage, max(storage.window, 0 if facts is None else head_size(facts, scans))
    )
    for _ in range(_PASSES):
        view.fetch_missing()
        try:
            with h5py.File(view, "r") as file:
                result = work(file)
        except Exception:
            if view.missing is None:
                raise
        if view.missing is None:
            return result
    raise OSError("its metadata is scattered over the file")


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes: numbers, and text of fixed length.

    Raises:
        ValueError: on attributes of other types, or too many or too large ones.
        OSError, RuntimeError, KeyError: from HDF5, if they are damaged.
    """
    if len(file.attrs) > _ATTRIBUTES:
        raise ValueError(f"there are {len(file.attrs)} of them")
    return {name: _attribute(file, name) for name in file.attrs}


def read_layout(
    file: h5py.File, storage: Storage, scans: int, arrays: Arrays, compression: str
) -> ShardLayout:
    """Validate the datasets of a shard and locate their values.

    Raises:
        ValueError: if a dataset is missing, unknown, or of another shape, type or storage.
        OSError, RuntimeError, KeyError: from HDF5, if they are damaged.
    """
    expected = {*NUMBERS, *arrays}
    if len(file) > len(expected) + 1 or not expected <= (given := set(file)) <= {
        *expected,
        CONDITION,
    }:
        raise ValueError(
            f"it does not hold {', '.join(sorted(expected))} and nothing else"
        )
    # The numbers come first: they are stored uncompressed, so the size of the file bounds the
    # number of scans.
    numbers = {
        name: _one_a_scan(_stored(file, name), scans, storage, _is(dtype))
        for name, dtype in NUMBERS.items()
    }
    conditions = (
        _one_a_scan(_stored(file, CONDITION), scans, storage, _is_text)
        if CONDITION in given
        else None
    )
    chunks = {
        name: _chunks(_stored(file, name), scans, *kind, compression)
        for name, kind in arrays.items()
    }
    return ShardLayout(numbers, conditions, chunks)


def _attribute(file: h5py.File, name: str) -> Any:
    attribute = file.attrs.get_id(name)
    kind = attribute.get_type()
    shape = attribute.get_space().get_simple_extent_type()
    number = kind.get_class() in (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
    if (
        shape != h5py.h5s.SCALAR
        or not (number or _is_text(kind))
        or attribute.get_storage_size() > _ATTRIBUTE_SIZE
    ):
        raise ValueError(f"{name} is not a number, or text of a fixed length")
    return file.attrs[name]


def _stored(file: h5py.File, name: str) -> h5py.Dataset:
    """A dataset whose values are stored in this file."""
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{name} is a link to another object")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{name} is not a dataset")
    properties = found.id.get_create_plist()
    # This check comes first: reading the shape of a virtual dataset already opens the files behind
    # it.
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"{name} is stored in another file")
    return found


def _one_a_scan(
    dataset: h5py.Dataset,
    scans: int,
    storage: Storage,
    fits: Callable[[h5py.h5t.TypeID], bool],
) -> NDArray[Any]:
    """(N,) values of a contiguous dataset."""
    found = dataset.id
    kind = dataset.id.get_type()
    if not fits(kind) or dataset.shape != (scans,):
        raise ValueError(
            f"{dataset.name} is {dataset.shape} of {_type_name(kind)}, for {scans} scans"
        )
    size = scans * kind.get_size()
    offset = found.get_offset()
    contiguous = (
        found.get_create_plist().get_layout() == h5py.h5d.CONTIGUOUS
        and found.get_storage_size() == size
    )
    if not contiguous or offset is None or offset + size > storage.size:
        raise ValueError(f"{dataset.name} is not contiguous in the file")
    values: NDArray[Any] = dataset[:]
    return values


def _chunks(
    dataset: h5py.Dataset,
    scans: int,
    shape: tuple[int, int],
    dtype: np.dtype[Any],
    compression: str,
) -> Chunks:
    """The addresses of an array's chunks, after checking how it is stored."""
    properties = dataset.id.get_create_plist()
    kind = dataset.id.get_type()
    if not _is(dtype)(kind) or dataset.shape != (scans, *shape):
        raise ValueError(
            f"{dataset.name} is {dataset.shape} of {_type_name(kind)}, not {(scans, *shape)} of "
            f"{dtype.name}"
        )
    if properties.get_layout() != h5py.h5d.CHUNKED or properties.get_chunk() != (
        1,
        *shape,
    ):
        raise ValueError(f"{dataset.name} does not have one chunk for each scan")
    filters = tuple(
        properties.get_filter(i)[0] for i in range(properties.get_nfilters())
    )
    if filters != FILTERS[compression]:
        raise ValueError(
            f"{dataset.name} has the filters {filters}, not {FILTERS[compression]}"
        )
    if compression == "blosc2" and shape[0] * shape[1] * dtype.itemsize > _BLOSC2_ARRAY:
        raise ValueError(
            f"{dataset.name} of one scan takes more than {_BLOSC2_ARRAY >> 20} MiB"
        )
    return _locate_chunks(dataset, scans)


def _locate_chunks(dataset: h5py.Dataset, scans: int) -> Chunks:
    found = Chunks(
        np.zeros(scans, np.uint64),
        np.zeros(scans, np.uint64),
        np.zeros(scans, np.uint32),
    )

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        position = chunk.chunk_offset[0]
        found.offset[position] = chunk.byte_offset
        found.size[position] = chunk.size
        found.skipped[position] = chunk.filter_mask

    dataset.id.chunk_iter(note)
    return found


def _is(dtype: np.dtype[Any]) -> Callable[[h5py.h5t.TypeID], bool]:
    return lambda kind: bool(kind.equal(h5py.h5t.py_create(dtype)))


def _is_text(kind: h5py.h5t.TypeID) -> bool:
    return kind.get_class() == h5py.h5t.STRING and not kind.is_variable_str()


def _type_name(kind: h5py.h5t.TypeID) -> str:
    classes = {"INTEGER": "integers", "FLOAT": "floats", "STRING": "text"}
    names = {getattr(h5py.h5t, name): plain for name, plain in classes.items()}
    return f"{kind.get_size()}-byte {names.get(kind.get_class(), 'values of another type')}"
