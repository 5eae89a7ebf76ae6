"""Mutators of pickles: opcodes, and the tree of values and calls. A ``.gz`` is a table
that gzip compressed; a ``.pkl`` a pickle inside an archive of PyTorch; a ``.pt`` a row of pickles
and the storages, as PyTorch before 1.6 wrote it."""

import gzip
import pickletools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from io import BytesIO
from random import Random
from typing import Any

import numpy as np
from pandaset_files import dump

from fuzzing.mutators import FLOATS, INTEGERS, LIMIT, mutates
from lidar_synth.files.pickles import Call, Name, parse_pickle
from lidar_synth.formats.pandas_table import KNOWN

Put = Callable[[Any], Any]

WORDS = (
    "",
    "x",
    "f8",
    "O8",
    "U4",
    ">",
    "M8",
    "Car",
    "label",
    "a" * 5000,
    "0.14.1",
    "os.system",
)

SHORT = (
    b"N",
    b"}",
    b"]",
    b")",
    b"(",
    b"0",
    b"2",
    b"t",
    b"R",
    b"b",
    b"\x81",
    b"Q",
    b"1",
)
"""Opcodes without an argument."""

HOSTILE = (
    b"cos\nsystem\n",
    b"r\xff\xff\xff\xff",
    b"B\xff\xff\xff\x7f",
    b"\x8b\xff\xff\xff\x7f",
    b"\x82\x01",
)
"""A name that is not known, places and lengths beyond memory, an extension."""


def unpacked(content: bytes) -> bytes:
    return zlib.decompressobj(wbits=31).decompress(content, LIMIT)


def packed(content: bytes) -> bytes:
    return gzip.compress(content, 1, mtime=0)


@mutates(".gz")
def edit_packed_opcodes(content: bytes, rng: Random) -> bytes:
    """Opcodes of a compressed pickle change."""
    return packed(edit_opcodes(unpacked(content), rng))


@mutates(".pkl", ".pt")
def edit_opcodes(content: bytes, rng: Random) -> bytes:
    """Opcodes are dropped, repeated, swapped, or others."""
    parts, rest = opcodes(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        i = rng.randrange(len(parts))
        change = rng.randrange(6)
        if change == 0:
            del parts[i]
        elif change < 3:
            parts.insert(i, parts[rng.choice((i, rng.randrange(len(parts))))])
        elif change == 3:
            parts[i] = rng.choice(SHORT)
        elif change == 4:
            parts[i] = parts[i][:1] + rng.randbytes(len(parts[i]) - 1)
        else:
            parts.insert(i, rng.choice(HOSTILE))
    return b"".join(parts) + rest


@mutates(".pkl", ".pt")
def set_argument(content: bytes, rng: Random) -> bytes:
    """A number of a pickle (a size, a stride, a length) becomes one at the limit of a type."""
    parts, rest = opcodes(content)
    i = rng.choice(
        [i for i, part in enumerate(parts) if part[:1] in (b"K", b"M", b"J", b"\x8a")]
    )
    number = rng.choice((*INTEGERS, 2**40, -(2**31), 2**62))
    packed_number = number.to_bytes(9, "little", signed=True)
    parts[i] = b"\x8a\x09" + packed_number
    return b"".join(parts) + rest


def opcodes(content: bytes) -> tuple[list[bytes], bytes]:
    """The opcodes of all pickles that stand one behind the other at the beginning, and what
    follows them."""
    parts: list[bytes] = []
    stream = BytesIO(content)
    end = 0
    try:
        while end < len(content):
            starts = [
                end + position for _, _, position in pickletools.genops(stream.read())
            ]
            end = starts[-1] + 1
            parts += [
                content[a:b] for a, b in zip(starts, [*starts[1:], end], strict=True)
            ]
            stream.seek(end)
    except (ValueError, IndexError):  # the storages, which are no pickle
        pass
    return parts, content[end:]


@mutates(".gz")
def edit_tree(content: bytes, rng: Random) -> bytes:
    """A value of the table is another one."""
    _, put = rng.choice(list(places(parse_pickle(unpacked(content), KNOWN, "", ""))))
    return packed(dump(put(another(rng)), rng.choice((2, 3, 4))))


@mutates(".gz")
def edit_array(content: bytes, rng: Random) -> bytes:
    """Numbers of an array are impossible or unlikely ones."""
    found = places(parse_pickle(unpacked(content), KNOWN, "", ""))
    value, put = rng.choice(
        [
            (value, put)
            for value, put in found
            if type(value) is bytes and len(value) > 8
        ]
    )
    array = np.frombuffer(
        value[: len(value) // 8 * 8], rng.choice(("<f8", "<i8"))
    ).copy()
    for _ in range(rng.choice((1, 1, 5, 50))):
        number = rng.choice(
            FLOATS
            if array.dtype.kind == "f"
            else [n for n in INTEGERS if abs(n) < 2**63]
        )
        array[rng.randrange(len(array))] = number
    return packed(dump(put(array.tobytes())))


@mutates(".gz")
def lie_about_gzip(content: bytes, rng: Random) -> bytes:
    """The stream is cut, followed by more, longer than memory, or not compressed."""
    plain = unpacked(content)
    return rng.choice(
        (
            content[: rng.randrange(len(content))],
            content + content,
            plain,
            packed(packed(plain)),
            packed(plain + bytes(1000)),
            packed(plain[: rng.randrange(len(plain))]),
            bomb(),
        )
    )


@cache
def bomb() -> bytes:
    """700 MB of zeros, in 700 KB."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return (
        b"".join(packer.compress(bytes(1_000_000)) for _ in range(700)) + packer.flush()
    )


def places(value: Any, put: Put = lambda whole: whole) -> Iterator[tuple[Any, Put]]:
    """Every value below, and a function that gives the whole tree with another value in its
    place."""
    children: list[tuple[Any, Put]] = []
    if isinstance(value, dict):
        children = [
            (child, lambda new, key=key: value | {key: new})
            for key, child in value.items()
        ]
    elif isinstance(value, list | tuple):
        kind = type(value)
        children = [
            (child, lambda new, i=i: kind([*value[:i], new, *value[i + 1 :]]))
            for i, child in enumerate(value)
        ]
    elif isinstance(value, Call):
        children = [
            (
                value.name,
                lambda new: replace(
                    value,
                    name=new if isinstance(new, str) and "." in new else "numpy.dtype",
                ),
            ),
            (
                value.args,
                lambda new: replace(
                    value, args=new if isinstance(new, tuple) else (new,)
                ),
            ),
            (value.state, lambda new: replace(value, state=new)),
        ]
    for child, rebuild in children:

        def place(new: Any, rebuild: Put = rebuild) -> Any:
            return put(rebuild(new))

        yield child, place
        yield from places(child, place)


def another(rng: Random) -> Any:
    """A value that may stand anywhere in a pickle."""
    names = sorted(KNOWN)
    return rng.choice(
        (
            None,
            True,
            rng.choice(INTEGERS),
            rng.choice(INTEGERS),
            rng.choice(FLOATS),
            rng.choice(WORDS),
            b"",
            rng.randbytes(8),
            (),
            [],
            {},
            (1, 2),
            (2**40, 3),
            [1.0, "a", None],
            {"a": 1},
            Name(rng.choice(names)),
            Call(rng.choice(names), (1,)),
            Call(rng.choice(names), (), (1, (2,), 3)),
        )
    )
