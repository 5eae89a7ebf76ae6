"""Mutators: functions from the bytes of a file to other bytes, listed by the suffix of the files
they know."""

import struct
from collections import defaultdict
from collections.abc import Callable
from pathlib import PurePath
from random import Random

Mutator = Callable[[bytes, Random], bytes]

BY_SUFFIX: dict[str, list[Mutator]] = defaultdict(list)
"""Mutators of the files with a suffix; those under ``""`` apply to every file."""

INTEGERS = (
    0,
    1,
    -1,
    2,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
)
"""Whole numbers at the limits of types."""

FLOATS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    64.5,
    1e-30,
    1e5,
    1e30,
    3.4e38,
    -1e30,
    float("nan"),
    float("inf"),
    float("-inf"),
)
"""Numbers at which arithmetic goes wrong."""

LIMIT = 4_000_000
"""Bytes: a mutated file is never longer, so that it costs the reader and not the harness."""


def mutates(*suffixes: str) -> Callable[[Mutator], Mutator]:
    """Enter a function into ``BY_SUFFIX``."""

    def enter(function: Mutator) -> Mutator:
        for suffix in suffixes:
            BY_SUFFIX[suffix].append(function)
        return function

    return enter


def mutate(name: str, content: bytes, rng: Random) -> bytes:
    """The content of a file after one to three mutations.

    Those that know the format come first: what follows may leave nothing that they could read.

    Args:
        name: of the file; its last suffix selects the mutators.
        content: its bytes.
        rng: decides everything.
    """
    suffix = PurePath(name).suffix
    known = BY_SUFFIX.get(suffix, [])
    count = rng.choice((1, 1, 1, 2, 3))
    structured = sum(rng.random() < 0.75 for _ in range(count)) if known else 0
    if suffix == ".h5":
        # HDF5 itself crashes when it is to write into a file with such contents.
        structured = min(structured, 1)
    for i in range(count):
        content = (
            apply(rng.choice(known), content, rng)
            if i < structured
            else rng.choice(BY_SUFFIX[""])(content, rng)
        )
    return content[:LIMIT]


def apply(mutator: Mutator, content: bytes, rng: Random) -> bytes:
    """What a mutator makes of bytes; a flipped bit where an earlier mutation left nothing that it
    can read."""
    try:
        return mutator(content, rng)
    except Exception:
        return flip_bits(content, rng)


def span(content: bytes, rng: Random) -> tuple[int, int]:
    """Begin and end of a piece of the bytes, short as a rule."""
    begin = rng.randrange(len(content) + 1)
    length = rng.choice((1, 2, 4, 8, 16, 64, 1024, len(content)))
    return begin, min(begin + rng.randint(1, max(length, 1)), len(content))


@mutates("")
def flip_bits(content: bytes, rng: Random) -> bytes:
    """One to eight bits flipped."""
    values = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8)) if values else 0):
        values[rng.randrange(len(values))] ^= 1 << rng.randrange(8)
    return bytes(values)


@mutates("")
def cut_off(content: bytes, rng: Random) -> bytes:
    """The end is missing."""
    return content[
        : rng.choice(
            (0, 1, len(content) // 2, len(content) - 1, rng.randrange(len(content) + 1))
        )
    ]


@mutates("")
def cut_out(content: bytes, rng: Random) -> bytes:
    """A piece is missing."""
    begin, end = span(content, rng)
    return content[:begin] + content[end:]


@mutates("")
def repeat(content: bytes, rng: Random) -> bytes:
    """A piece stands there twice or more often."""
    begin, end = span(content, rng)
    return (
        content[:end] + content[begin:end] * rng.choice((1, 1, 2, 100)) + content[end:]
    )


@mutates("")
def splice(content: bytes, rng: Random) -> bytes:
    """A piece is overwritten by another."""
    begin, end = span(content, rng)
    other = rng.randrange(len(content) + 1)
    return content[:begin] + content[other : other + end - begin] + content[end:]


@mutates("")
def overwrite(content: bytes, rng: Random) -> bytes:
    """A piece becomes zeros, ones or noise."""
    begin, end = span(content, rng)
    filled = rng.choice(
        (bytes(end - begin), b"\xff" * (end - begin), rng.randbytes(end - begin))
    )
    return content[:begin] + filled + content[end:]


@mutates("")
def insert(content: bytes, rng: Random) -> bytes:
    """Something foreign stands in between."""
    at = rng.choice((0, len(content), rng.randrange(len(content) + 1)))
    foreign = rng.choice(
        (
            b"\x00",
            b"\xff\xfe",
            b"\xef\xbb\xbf",
            b"\r\n",
            b"\n",
            rng.randbytes(rng.choice((1, 7, 4096))),
        )
    )
    return content[:at] + foreign + content[at:]


@mutates("")
def set_number(content: bytes, rng: Random) -> bytes:
    """Two, four or eight bytes become a number at the limit of a type."""
    code = rng.choice(("<h", ">h", "<i", ">i", "<q", ">q", "<f", "<d"))
    size = struct.calcsize(code)
    if len(content) < size:
        return content + bytes(size)
    at = rng.choice(
        (
            rng.randrange(len(content) - size + 1),
            rng.randrange(min(64, len(content) - size + 1)),
        )
    )
    if code in ("<f", "<d"):
        number = struct.pack(code, rng.choice(FLOATS))
    else:
        number = (rng.choice(INTEGERS) % 256**size).to_bytes(
            size, "little" if code[0] == "<" else "big"
        )
    return content[:at] + number + content[at + size :]
