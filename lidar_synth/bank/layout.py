"""Where in a shard its values lie. Whatever the file declares is checked before any memory is taken for it.

A shard may come from anywhere. HDF5 would follow links and external or virtual storage into other files, run foreign
filters, and give memory to whatever shape is declared. Here a shard has the named datasets and no others, each stored
in the file itself, with the shapes and types of its facts.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from lidar_synth.bank.chunks import FILTERS
from lidar_synth.bank.index import SCAN_NUMBERS, Facts
from lidar_synth.bank.storage import Storage, View

T = TypeVar("T")

Arrays = Mapping[str, tuple[tuple[int, int], np.dtype[Any]]]
"""Shape and type of each array of one scan, as ``Encoding.arrays`` gives them."""

NUMBERS: dict[str, np.dtype[Any]] = {"seed": np.dtype("<u8"), "index": np.dtype("<u8"), "crc": np.dtype("<u4")}
"""Datasets with one number a scan."""

CONDITION = "condition"

_ATTRIBUTES, _ATTRIBUTE_SIZE = 64, 1 << 20
_BASE = 12 << 10  # bytes of a shard's metadata, without facts of more than 4 kB and without the places of its chunks
_PLACE = 16  # bytes of a chunk's place in the metadata
_PASSES = 32  # most reads until the metadata are there
_BLOSC2_ARRAY = 32 << 20  # most bytes of one array that Blosc2 packed: unlike deflate it packs zeros without bound


@dataclass(frozen=True)
class Chunks:
    """Where the chunks of one array lie, by position of the scan.

    Args:
        offset: (N,) uint64, from the beginning of the file.
        size: (N,) uint64 bytes; 0 where there is no chunk.
        skipped: (N,) uint32, the filters that were left out, as bits.
    """

    offset: NDArray[np.uint64]
    size: NDArray[np.uint64]
    skipped: NDArray[np.uint32]


@dataclass(frozen=True)
class Layout:
    """What stands where in a shard.

    Args:
        numbers: the values of ``NUMBERS``, (N,) each.
        conditions: (N,) text, or None.
        chunks: of each array.
    """

    numbers: dict[str, NDArray[Any]]
    conditions: NDArray[np.bytes_] | None
    chunks: dict[str, Chunks]


def metadata_size(facts: Facts, scans: int) -> int:
    """Bytes that a shard's metadata takes, rounded up. The writer keeps so much together at the beginning of the file;
    behind it stand facts of more than 4 kB, and then the numbers.
    """
    return _BASE + scans * _PLACE * len(facts.encoding.names)


def head_size(facts: Facts, scans: int) -> int:
    """Bytes of all that a shard holds beside its chunks, rounded up."""
    return metadata_size(facts, scans) + facts.text_size + scans * SCAN_NUMBERS


def with_hdf5(storage: Storage, facts: Facts | None, scans: int, work: Callable[[h5py.File], T]) -> T:
    """What ``work`` makes of the metadata and the numbers of a stored file, in one read where they stand together.

    Args:
        storage: the file.
        facts, scans: what it is expected to hold.
        work: is called with the open file, several times where the metadata are scattered.

    Raises:
        OSError, RuntimeError: from HDF5, where it is no such file.
        FileError, DataError: as ``Storage.read``.
    """
    view = View(storage, max(storage.window, 0 if facts is None else head_size(facts, scans)))
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
    raise OSError("its metadata are scattered all over the file")


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """The root attributes: numbers, and text of fixed length.

    Raises:
        ValueError: on attributes of another kind, or too many or too large ones.
        OSError, RuntimeError, KeyError: from HDF5, where they are damaged.
    """
    if len(file.attrs) > _ATTRIBUTES:
        raise ValueError(f"there are {len(file.attrs)}")
    return {name: _attribute(file, name) for name in file.attrs}


def read_layout(file: h5py.File, storage: Storage, scans: int, arrays: Arrays, compression: str) -> Layout:
    """Where the values of ``scans`` scans lie.

    Raises:
        ValueError: where datasets are missing, more than the known ones, or not as they have to be.
        OSError, RuntimeError, KeyError: from HDF5, where they are damaged.
    """
    expected = {*NUMBERS, *arrays}
    if len(file) > len(expected) + 1 or not expected <= (given := set(file)) <= {*expected, CONDITION}:
        raise ValueError(f"it does not hold {', '.join(sorted(expected))} and nothing else")
    # Numbers come first: they stand in the file one by one, so that the count of scans is bounded by its size.
    numbers = {name: _one_a_scan(_stored(file, name), scans, storage, _is(dtype)) for name, dtype in NUMBERS.items()}
    conditions = _one_a_scan(_stored(file, CONDITION), scans, storage, _is_text) if CONDITION in given else None
    chunks = {name: _chunks(_stored(file, name), scans, *kind, compression) for name, kind in arrays.items()}
    return Layout(numbers, conditions, chunks)


def _attribute(file: h5py.File, name: str) -> Any:
    attribute = file.attrs.get_id(name)
    kind, shape = attribute.get_type(), attribute.get_space().get_simple_extent_type()
    number = kind.get_class() in (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
    if shape != h5py.h5s.SCALAR or not (number or _is_text(kind)) or attribute.get_storage_size() > _ATTRIBUTE_SIZE:
        raise ValueError(f"{name} is not a number, or text of a fixed length")
    return file.attrs[name]


def _stored(file: h5py.File, name: str) -> h5py.Dataset:
    """A dataset whose values stand in this file."""
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{name} is a link to elsewhere")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{name} is no dataset")
    properties = found.id.get_create_plist()
    # First of all: HDF5 opens the files behind a virtual dataset as soon as it is asked for its shape.
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"{name} is stored elsewhere")
    return found


def _one_a_scan(
    dataset: h5py.Dataset, scans: int, storage: Storage, fits: Callable[[h5py.h5t.TypeID], bool]
) -> NDArray[Any]:
    """(N,) values of a dataset that stands in one piece."""
    found, kind = dataset.id, dataset.id.get_type()
    if not fits(kind) or dataset.shape != (scans,):
        raise ValueError(f"{dataset.name} is {dataset.shape} of {_type_name(kind)}, for {scans} scans")
    size, offset = scans * kind.get_size(), found.get_offset()
    piece = found.get_create_plist().get_layout() == h5py.h5d.CONTIGUOUS and found.get_storage_size() == size
    if not piece or offset is None or offset + size > storage.size:
        raise ValueError(f"{dataset.name} does not stand in one piece in the file")
    values: NDArray[Any] = dataset[:]
    return values


def _chunks(
    dataset: h5py.Dataset, scans: int, shape: tuple[int, int], dtype: np.dtype[Any], compression: str
) -> Chunks:
    """Where the chunks of an array lie."""
    properties, kind = dataset.id.get_create_plist(), dataset.id.get_type()
    if not _is(dtype.newbyteorder("<"))(kind) or dataset.shape != (scans, *shape):
        raise ValueError(
            f"{dataset.name} is {dataset.shape} of {_type_name(kind)}, not {(scans, *shape)} of {dtype.name}"
        )
    if properties.get_layout() != h5py.h5d.CHUNKED or properties.get_chunk() != (1, *shape):
        raise ValueError(f"{dataset.name} does not have one chunk for each scan")
    filters = tuple(properties.get_filter(i)[0] for i in range(properties.get_nfilters()))
    if filters != FILTERS[compression]:
        raise ValueError(f"{dataset.name} has the filters {filters}, not {FILTERS[compression]}")
    if compression == "blosc2" and shape[0] * shape[1] * dtype.itemsize > _BLOSC2_ARRAY:
        raise ValueError(f"{dataset.name} of one scan takes more than {_BLOSC2_ARRAY >> 20} MiB")
    found = Chunks(np.zeros(scans, np.uint64), np.zeros(scans, np.uint64), np.zeros(scans, np.uint32))

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        position = chunk.chunk_offset[0]
        found.offset[position] = chunk.byte_offset
        found.size[position], found.skipped[position] = chunk.size, chunk.filter_mask

    dataset.id.chunk_iter(note)
    return found


def _is(dtype: np.dtype[Any]) -> Callable[[h5py.h5t.TypeID], bool]:
    return lambda kind: bool(kind.equal(h5py.h5t.py_create(dtype)))


def _is_text(kind: h5py.h5t.TypeID) -> bool:
    return kind.get_class() == h5py.h5t.STRING and not kind.is_variable_str()


def _type_name(kind: h5py.h5t.TypeID) -> str:
    classes = {"INTEGER": "integers", "FLOAT": "floats", "STRING": "text"}
    names = {getattr(h5py.h5t, name): plain for name, plain in classes.items()}
    return f"{kind.get_size()}-byte {names.get(kind.get_class(), 'values of another kind')}"
