"""Weight files of PyTorch (``torch.save``), read without running any of their code and without
``torch.load``.

A file is a ZIP archive (``data.pkl`` and one file for each storage), or, before PyTorch 1.6, a row
of pickles followed by the storages. Either pickle is read as data: tensors are made of the
storages, numbers of numpy become numbers, and the objects of other classes become the plain values
that they hold, or text with the name of the class.
"""

import os
import zipfile
from collections.abc import Callable, Iterable
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.files.disk import open_file
from lidar_synth.files.parsing import DAMAGED_ZIP, DEEPEST, zip_fault
from lidar_synth.files.pickles import (
    PERSISTENT,
    Call,
    Name,
    bytes_of,
    dtype_of,
    parse_pickle,
)

MOST_PICKLE = 64 << 20
"""Maximum size of the pickle in bytes, without the tensors' values."""

MOST_STEPS = 3_000_000
"""Maximum number of opcodes, and of plain values with those that occur several times counted again:
a tensor takes about 20, and the optimizer of a network of 2,000 tensors holds 4,000 more."""

MOST_ELEMENTS = 1 << 28
"""Maximum number of elements of a tensor; a stride of 0 repeats one element without memory."""

MAGIC = 0x1950A86A20F9469CFC6C
PROTOCOL = 1001
"""The first two pickles of a file that PyTorch before 1.6 wrote."""

_TYPES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
_NUMBERS = {f"numpy.{core}.multiarray.scalar" for core in ("core", "_core")}
_FAULTS = (*DAMAGED_ZIP, LookupError, TypeError, AttributeError, MemoryError)
"""What a damaged file causes: values of other kinds, and storages that are missing or short."""


def load_pickle(path: Path, peer: str) -> Any:
    """The content of a ``.pth`` or ``.ckpt`` file.

    Args:
        path: the file.
        peer: name of the project that released it, for errors.

    Returns:
        Tensors, None, truth values, numbers, text, bytes, tuples, lists and dictionaries. Objects
        become the items, values or attributes that they hold, and text with the name of their class
        where they hold none.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a truncated file, or one of another format.
    """
    kind = path.suffix or "weight"
    with open_file(path, f"a {kind} file of {peer}") as file:
        return unpickle(file, path, peer)


def unpickle(file: BinaryIO, path: Path, peer: str) -> Any:
    """The content of an open file; ``path`` names it in errors. See ``load_pickle``.

    Raises:
        DataError: on a truncated file, or one of another format.
    """
    try:
        is_zip = file.read(2) == b"PK"
        file.seek(0)
        return (_read_zip if is_zip else _read_pickles)(file, str(path))
    except _FAULTS as error:
        reason = f" ({error})" if isinstance(error, DataError) else ""
        raise DataError(
            f"{path} is truncated, damaged or no {path.suffix or 'weight'} file{reason}",
            f"an intact file of {peer}'s release",
        ) from error


def state_of(content: Any, key: str, path: Path) -> dict[str, Tensor]:
    """The state dictionary under a key of a file's content, or the content itself if it is one.

    The prefixes that ``DistributedDataParallel`` and ``torch.compile`` give to names are removed.

    Raises:
        DataError: if the value is not a dictionary of tensors.
    """
    weights = content.get(key, content)
    if not isinstance(weights, dict) or not all(
        isinstance(value, Tensor) for value in weights.values()
    ):
        raise DataError(
            f"{path}: its weights are not tensors by name",
            "the state dictionary of a network",
        )
    names = [str(name).replace("_orig_mod.", "") for name in weights]
    if all(name.startswith("module.") for name in names):
        names = [name.removeprefix("module.") for name in names]
    if len(set(names)) < len(names):
        raise DataError(
            f"{path}: several of its weights have one name",
            "the state dictionary of a network",
        )
    return dict(zip(names, weights.values(), strict=True))


def _read_zip(file: BinaryIO, where: str) -> Any:
    with zipfile.ZipFile(file) as archive:
        infos = {info.filename: info for info in archive.infolist()}
        # PyTorch does not compress
        if fault := zip_fault(archive.infolist(), file.seek(0, os.SEEK_END), 0):
            raise DataError(f"it {fault}")
        [main] = [
            name
            for name in infos
            if name.endswith("/data.pkl") and name.count("/") == 1
        ]
        folder = main.removesuffix("data.pkl")
        order = (
            archive.read(f"{folder}byteorder")
            if f"{folder}byteorder" in infos
            else b"little"
        )
        if order != b"little" or infos[main].file_size > MOST_PICKLE:
            raise DataError(
                f"byte order {order[:10]!r}, or a pickle of more than {MOST_PICKLE} bytes"
            )
        content = parse_pickle(archive.read(main), None, where, "", MOST_STEPS)
        return _Plain(lambda key, *_: archive.read(f"{folder}data/{key}")).value(
            content
        )


def _read_pickles(file: BinaryIO, where: str) -> Any:
    left = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = BytesIO(file.read(MOST_PICKLE))
    if parse_pickle(head, None, where, "", MOST_STEPS) != MAGIC:
        raise DataError("it begins with neither a ZIP archive nor PyTorch's number")
    rest = [parse_pickle(head, None, where, "", MOST_STEPS) for _ in range(4)]
    protocol, system, content, keys = rest
    if protocol != PROTOCOL or not system["little_endian"]:
        raise DataError("another protocol than 1001, or another byte order than little")
    file.seek(head.tell())
    left -= head.tell()
    sizes: dict[Any, int] = {}
    _Plain(lambda key, size: sizes.update({key: size})).value(content)
    stored: dict[Any, bytes] = {}
    for key in keys:
        left -= 8 + sizes[key]
        if left < 0:
            raise DataError("a storage is missing")
        file.seek(8, os.SEEK_CUR)  # the number of elements, which the pickle states too
        stored[key] = file.read(sizes[key])
    return _Plain(lambda key, _: stored[key]).value(content)


class _Plain:
    """Turns calls into tensors and plain values; what several places share is one object again.

    Args:
        read: (key of a storage, size in bytes) -> its bytes, or None to make tensors without
            values.
    """

    def __init__(self, read: Callable[[Any, int], bytes | None]) -> None:
        self.read = read
        self.storages: dict[tuple[Any, torch.dtype], Tensor] = {}
        self.made: dict[int, tuple[Any, int]] = {}
        self.count = 0  # of values, with shared ones counted wherever they occur

    def value(self, given: Any, level: int = 0) -> Any:
        """The plain value of a part of the pickle."""
        before = self.count
        self.count += 1
        if not isinstance(given, list | tuple | dict | Call):
            return str(given.text) if isinstance(given, Name) else given
        if id(given) in self.made:
            found, size = self.made[id(given)]
            self.count += size
        else:
            self.made[id(given)] = None, 1  # an object that holds itself
            found = self._make(given, level + 1) if level < DEEPEST else None
            self.made[id(given)] = found, self.count - before
        if self.count > MOST_STEPS:
            raise DataError(f"it holds more than {MOST_STEPS} values")
        return found

    def _make(self, given: Any, level: int) -> Any:
        if isinstance(given, Call):
            return self._object(given, level)
        if isinstance(given, dict):
            return {
                _text_of(key): self.value(value, level) for key, value in given.items()
            }
        return type(given)(self.value(value, level) for value in given)

    def _object(self, call: Call, level: int) -> Any:
        name = call.name.removeprefix("torch._utils.")
        if name in ("_rebuild_tensor", "_rebuild_tensor_v2", "_rebuild_tensor_v3"):
            return self._tensor(*call.args[:4])
        if name in ("_rebuild_parameter", "_rebuild_parameter_with_state"):
            return self.value(call.args[0], level)
        # a tensor with attributes of its own
        if name == "torch._tensor._rebuild_from_type_v2":
            return self.value(Call(_text_of(call.args[0]), call.args[2]), level)
        if name in _NUMBERS:
            content = bytes_of(call.args[1])
            return np.frombuffer(content, dtype_of(call.args[0]))[0].item()
        # its state is no part of its items; Python 2 lists the items
        if name == "collections.OrderedDict":
            pairs = dict(call.args[0]) if call.args else {}
            return self._make(pairs | call.items, level)
        for held in (call.items, call.values, call.state):
            if held and isinstance(held, dict | list):
                return self._make(held, level)
        return name

    def _tensor(self, reference: Call, offset: Any, size: Any, stride: Any) -> Tensor:
        kind, storage, key, _, count = reference.args[0][:5]
        dtype = _TYPES[_text_of(storage).rpartition(".")[2]]
        if (reference.name, kind) != (PERSISTENT, "storage") or not _are_counts(
            (count, offset, *size, *stride)
        ):
            raise DataError(
                "a tensor without a storage, or with a size that is no number"
            )
        flat = self._storage(key, dtype, count)
        last = offset + sum(
            (n - 1) * step for n, step in zip(size, stride, strict=True)
        )
        if prod(size) > MOST_ELEMENTS or (prod(size) and last >= count):
            raise DataError(
                f"a tensor of shape {size} in a storage of {count} elements"
            )
        return flat.as_strided(size, stride, offset)

    def _storage(self, key: Any, dtype: torch.dtype, count: int) -> Tensor:
        if (key, dtype) not in self.storages:
            size = count * dtype.itemsize
            content = self.read(key, size)
            if content is None or not size:
                flat = torch.empty(count, dtype=dtype, device="meta" if size else None)
            elif len(content) != size:
                raise DataError(f"a storage of {len(content)} instead of {size} bytes")
            else:
                flat = torch.frombuffer(bytearray(content), dtype=torch.uint8)
                flat = flat.ne(0) if dtype == torch.bool else flat.view(dtype)
            self.storages[key, dtype] = flat
        return self.storages[key, dtype]


def _text_of(value: Any) -> Any:
    return value.text if isinstance(value, Name) else value


def _are_counts(values: Iterable[Any]) -> bool:
    return all(type(value) is int and 0 <= value < 1 << 48 for value in values)
