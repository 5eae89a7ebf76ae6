"""Mutators of HDF5 files, through h5py, so that HDF5's own checksums fit."""

import json
from collections.abc import Callable
from io import BytesIO
from random import Random
from typing import Any

import h5py
import numpy as np

from fuzzing.mutators import INTEGERS, mutates
from fuzzing.text import WORDS, edit_json_text
from lidar_synth.bank.chunks import checksum

LIBVER = "v110"


def edited(content: bytes, edit: Callable[[h5py.File], object]) -> bytes:
    """The file after an edit."""
    file = BytesIO(content)
    with h5py.File(file, "r+", libver=(LIBVER, LIBVER)) as opened:
        edit(opened)
    return file.getvalue()


def fixed(text: str) -> Any:
    """Text as the package's attributes hold it."""
    value = text.encode("utf-8", "replace")
    return np.array(value, h5py.string_dtype("utf-8", max(len(value), 1)))


@mutates(".h5")
def edit_attributes(content: bytes, rng: Random) -> bytes:
    """An attribute is missing, foreign, or has another value or type."""

    def edit(file: h5py.File) -> None:
        name = rng.choice(sorted(file.attrs))
        values: tuple[Any, ...] = (
            *(np.array(i % 2**63) for i in INTEGERS),
            np.float64("nan"),
            np.float64(1e30),
            np.float64(-1),
            np.uint8(3),
            fixed(rng.choice(WORDS[:-1])),
            "variable length",
            b"bytes",
            np.zeros(0),
            np.zeros((3, 3)),
            np.arange(5000),
            h5py.Empty("f4"),
            np.array([b"a", b"b"]),
            np.array(True),
            file.ref,
            np.array(1 + 1j),
            np.array((1, 2.0), [("a", "i4"), ("b", "f8")]),
        )
        if rng.random() < 0.15:
            del file.attrs[name]
        elif rng.random() < 0.1:
            file.attrs["x"] = rng.choice(values)
        else:
            file.attrs[name] = rng.choice(values)

    return edited(content, edit)


@mutates(".h5")
def edit_json_attributes(content: bytes, rng: Random) -> bytes:
    """The JSON in an attribute says something else."""

    def edit(file: h5py.File) -> None:
        texts = {
            name: bytes(value)
            for name, value in file.attrs.items()
            if isinstance(value, np.bytes_ | bytes)
        }
        texts = {
            name: text
            for name, text in texts.items()
            if text[:1] in (b"{", b"[") and len(text) > 2
        }
        name = rng.choice(sorted(texts))
        text = edit_json_text(texts[name].decode(), rng)
        file.attrs[name] = fixed(
            text if len(text) < 60_000 else json.dumps("a" * 50_000)
        )

    return edited(content, edit)


@mutates(".h5")
def replace_dataset(content: bytes, rng: Random) -> bytes:
    """A dataset is missing, or of another shape, type or layout; a huge one takes no room in the
    file."""

    def edit(file: h5py.File) -> None:
        name = rng.choice(sorted(file))
        old = file[name]
        shape = old.shape
        dtype = old.dtype
        data = old[()]
        del file[name]
        others: tuple[Callable[[], object], ...] = (
            lambda: None,
            lambda: file.create_group(name),
            lambda: file.create_dataset(name, (shape[0] + 1, *shape[1:]), dtype),
            lambda: file.create_dataset(
                name,
                (shape[0] * 3, *shape[1:]),
                dtype,
                maxshape=(None, *shape[1:]),
                chunks=True,
            ),
            lambda: file.create_dataset(
                name, (600_000_000, *shape[1:]), dtype, chunks=(2**16, *shape[1:])
            ),
            lambda: file.create_dataset(name, (2**40,), dtype, chunks=(2**16,)),
            lambda: file.create_dataset(name, (), dtype),
            lambda: file.create_dataset(name, (0,), dtype),
            lambda: file.create_dataset(
                name, shape, rng.choice(("f4", "c8", "S8", "u8", "i2", "u1", "?", "V3"))
            ),
            lambda: file.create_dataset(name, shape, h5py.string_dtype()),
            lambda: file.create_dataset(
                name, shape, "S100000000", chunks=(1,) * len(shape)
            ),
            lambda: file.create_dataset(
                name, data=data, chunks=shape, compression="gzip"
            ),
            lambda: (
                file.create_dataset(
                    name, data=data, chunks=(1, *shape[1:]), scaleoffset=0
                )
                if dtype.kind in "ui"
                else None
            ),
            lambda: file.create_dataset(name, data=data),
            lambda: file.create_dataset(name, data=h5py.Empty("f4")),
            lambda: file.create_dataset(name, shape, [("a", "u4"), ("b", "u4", 1000)]),
        )
        rng.choice(others)()

    return edited(content, edit)


@mutates(".h5")
def link_elsewhere(content: bytes, rng: Random) -> bytes:
    """A dataset lies in another file, or nowhere, or in itself."""

    def edit(file: h5py.File) -> None:
        name = rng.choice(sorted(file))
        shape = file[name].shape
        dtype = file[name].dtype
        del file[name]
        virtual = h5py.VirtualLayout(shape, dtype)
        virtual[...] = h5py.VirtualSource("elsewhere.h5", name, shape)
        others: tuple[Callable[[], object], ...] = (
            lambda: file.__setitem__(name, h5py.ExternalLink("elsewhere.h5", "/x")),
            lambda: file.__setitem__(
                name, h5py.ExternalLink("shard-00000.h5", f"/{name}")
            ),
            lambda: file.__setitem__(name, h5py.ExternalLink("/dev/zero", "/x")),
            lambda: file.__setitem__(name, h5py.SoftLink(f"/{name}")),
            lambda: file.__setitem__(name, h5py.SoftLink("/nowhere")),
            lambda: file.__setitem__(name, file[rng.choice(sorted(file))]),
            lambda: file.create_dataset(
                name, shape, dtype, external=[("/etc/hostname", 0, h5py.h5f.UNLIMITED)]
            ),
            lambda: file.create_dataset(
                name, shape, dtype, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)]
            ),
            lambda: file.create_virtual_dataset(name, virtual),
        )
        rng.choice(others)()

    return edited(content, edit)


@mutates(".h5")
def change_scan(content: bytes, rng: Random) -> bytes:
    """A scan has other values, or another seed or index, as a rule with a checksum that fits."""

    def edit(file: h5py.File) -> None:
        position = rng.randrange(file["crc"].shape[0])
        names = [
            name
            for name in ("range", "reflectance", "label", "confidence")
            if name in file
        ]
        name = rng.choice((*names, "seed", "index"))
        values = file[name][position]
        if name in names:
            for _ in range(rng.choice((1, 10))):
                row = rng.randrange(values.shape[0])
                column = rng.randrange(values.shape[1])
                values[row, column] = rng.choice(INTEGERS) % (
                    int(np.iinfo(values.dtype).max) + 1
                )
            file[name][position] = values
        else:
            file[name][position] = rng.choice(INTEGERS) % 2**64
        if rng.random() < 0.8:
            condition = (
                bytes(file["condition"][position]) if "condition" in file else b""
            )
            arrays = {
                name: np.ascontiguousarray(file[name][position]) for name in names
            }
            seed = int(file["seed"][position])
            index = int(file["index"][position])
            file["crc"][position] = checksum(seed, index, arrays, condition)

    return edited(content, edit)
