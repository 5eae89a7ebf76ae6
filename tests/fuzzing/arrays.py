"""Mutators of arrays on disk: raw ``.bin`` and ``.label`` files, and numpy's ``.npy``."""

import struct
import warnings
from random import Random

import numpy as np
from numpy.lib import format as npy

from fuzzing.mutators import FLOATS, INTEGERS, mutates
from fuzzing.text import encoded, replace_number, replace_word

TYPES = (
    "<f4",
    ">f4",
    "<f2",
    "<f8",
    "<c8",
    "<c16",
    "|O",
    "<U4",
    "|S4",
    "|V4",
    "<M8[s]",
    "<m8[D]",
    "|b1",
    "|u1",
    "<i2",
    "<u4",
    "<i8",
    "<u8",
)
"""What an array may be of."""


@mutates(".bin")
def set_floats(content: bytes, rng: Random) -> bytes:
    """Some numbers become impossible, or unlikely, ones."""
    values = np.frombuffer(content[: len(content) // 4 * 4], "<f4").copy()
    for _ in range(rng.choice((1, 1, 2, 20))):
        values[rng.randrange(len(values))] = rng.choice(
            (*FLOATS, 0.5, 31.0, 1.0000001, 99_999.0, rng.uniform(-90, 90))
        )
    return values.tobytes()


@mutates(".label", ".bin")
def set_integers(content: bytes, rng: Random) -> bytes:
    """Some labels become other ones, or none."""
    values = np.frombuffer(content[: len(content) // 4 * 4], "<u4").copy()
    for _ in range(rng.choice((1, 1, 2, 20))):
        values[rng.randrange(len(values))] = (
            rng.choice((*INTEGERS, 10, 252 | 7 << 16, 39, 44, 45)) % 2**32
        )
    return values.tobytes()


@mutates(".bin", ".label")
def change_count(content: bytes, rng: Random) -> bytes:
    """More or fewer values, whole ones."""
    count = 4 * rng.choice((1, 2, 4, 5, 20, len(content) // 8))
    return rng.choice(
        (content[:-count], content[count:], content + content[:count], content * 2, b"")
    )


@mutates(".npy")
def change_values(content: bytes, rng: Random) -> bytes:
    """The array holds other values, of the same type."""
    array = load(content)
    flat = array.reshape(-1)
    for _ in range(rng.choice((1, 1, 3, 50))):
        value = rng.choice(FLOATS if flat.dtype.kind in "fc" else INTEGERS)
        with np.errstate(all="ignore"):
            flat[rng.randrange(len(flat))] = np.array(value).astype(flat.dtype)
    return dump(array)


@mutates(".npy")
def change_type(content: bytes, rng: Random) -> bytes:
    """The values are stored as another type."""
    with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
        return dump(
            load(content).astype(
                rng.choice([t for t in TYPES if t not in ("|O", "<M8[s]", "<m8[D]")])
            )
        )


@mutates(".npy")
def change_shape(content: bytes, rng: Random) -> bytes:
    """The array has another shape: rows dropped, turned, flat, empty, one more axis."""
    array = load(content)
    flat = array.reshape(-1)
    shapes = (
        array[:-1] if array.ndim else flat,
        array[..., :-1] if array.ndim else flat,
        array[:0] if array.ndim else flat,
        array.T,
        flat,
        array[None],
        array[..., None],
        np.asfortranarray(array),
        flat[:1].reshape(()),
        array.repeat(2),
        np.zeros((0, 4), array.dtype),
        np.zeros((3, 0), array.dtype),
        np.zeros((1,) * 40, array.dtype)[..., 0],
    )
    return dump(
        np.ascontiguousarray(shapes[i])
        if (i := rng.randrange(len(shapes))) != 7
        else shapes[7]
    )


@mutates(".npy")
def lie_in_header(content: bytes, rng: Random) -> bytes:
    """The header says another type, shape, order or length than the file holds."""
    version, header, body = parts(content)
    array = load(content)
    kinds = ("{}", "{}", "[('a', {}), ('b', '<i4')]", "({}, (2,))", "{}" * 2)
    shape = rng.choice(
        (
            array.shape,
            (2**31, 4),
            (2**62,),
            (2**63, 2**63),
            (200_000, 200_000),
            (10_000_000, 4),
            (-1, 4),
            (64.5, 4),
            (0,),
            (),
            (1,) * 33,
            (True, 2),
            "4",
            None,
        )
    )
    told = array.dtype.str if rng.random() < 0.5 else rng.choice(TYPES)
    kind = (
        rng.choice(kinds).format(*[repr(told)] * 2)
        if rng.random() < 0.3
        else repr(told)
    )
    fortran = rng.choice((False, False, True, 2))
    header = (
        f"{{'descr': {kind}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    )
    return join(version, header, body)


@mutates(".npy")
def edit_header_text(content: bytes, rng: Random) -> bytes:
    """The header's text is changed in a word or a number, or is nested or endless."""
    version, header, body = parts(content)
    header = rng.choice(
        (
            lambda: replace_number(header, rng),
            lambda: replace_word(header, rng),
            lambda: b"(" * 5000 + header,
            lambda: b"[" * 50 + b"]" * 50,
            lambda: header.replace(b"}", b"'x': 1}"),
            lambda: header.replace(b"'", b'"""', 1),
            lambda: header + b"\x00\\\n\\",
            lambda: encoded("\x1f" * 10 + header.decode()),
            lambda: b"__import__('os')",
            lambda: header[: rng.randrange(len(header))],
        )
    )()
    return join(rng.choice((version, (1, 0), (2, 0), (3, 0), (9, 9))), header, body)


def load(content: bytes) -> np.ndarray:
    """The array of a whole ``.npy``."""
    from io import BytesIO

    return np.load(BytesIO(content), allow_pickle=False)


def dump(array: np.ndarray) -> bytes:
    """The bytes of a ``.npy``."""
    from io import BytesIO

    file = BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def parts(content: bytes) -> tuple[tuple[int, int], bytes, bytes]:
    """Version, header and body of a ``.npy``."""
    assert content.startswith(npy.MAGIC_PREFIX)
    start = 10 if content[6] == 1 else 12
    size = int.from_bytes(content[8:start], "little")
    return (
        (content[6], content[7]),
        content[start : start + size],
        content[start + size :],
    )


def join(version: tuple[int, int], header: bytes, body: bytes) -> bytes:
    """The inverse of ``parts``; the header's length fits."""
    length = struct.pack(
        "<H" if version[0] == 1 else "<I",
        min(len(header), 65535 if version[0] == 1 else 2**32 - 1),
    )
    return npy.MAGIC_PREFIX + bytes(version) + length + header + body
