"""Mutators of PNG files, with checksums that fit."""

import zlib
from functools import cache
from random import Random

from fuzzing.mutators import INTEGERS, mutates
from fuzzing.text import edit_json_text, encoded

SIGNATURE = b"\x89PNG\r\n\x1a\n"

Chunk = tuple[bytes, bytes]


def chunks(content: bytes) -> list[Chunk]:
    """(kind, data) of each chunk."""
    assert content.startswith(SIGNATURE)
    found = []
    at = len(SIGNATURE)
    while at + 12 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        found.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def join(parts: list[Chunk]) -> bytes:
    """The inverse of ``chunks``."""
    return SIGNATURE + b"".join(
        len(data).to_bytes(4, "big")
        + kind
        + data
        + zlib.crc32(kind + data).to_bytes(4, "big")
        for kind, data in parts
    )


def changed(content: bytes, kind: bytes, data: bytes) -> bytes:
    """The file with other data in the chunks of a kind."""
    return join([(k, data if k == kind else d) for k, d in chunks(content)])


@mutates(".png")
def edit_size(content: bytes, rng: Random) -> bytes:
    """The header says another size, depth, colour or interlacing."""
    header = bytearray(dict(chunks(content))[b"IHDR"])
    field = rng.randrange(7)
    if field < 4:
        width = rng.choice(
            (0, 1, 31, 33, 64, 5000, 9000, 13_000, 30_000, 60_000, 2**31 - 1, 2**32 - 1)
        )
        start = 4 * (field % 2)
        header[start : start + 4] = width.to_bytes(4, "big")
        if field == 3:
            header[:8] = width.to_bytes(4, "big") * 2
    else:
        at = {4: 8, 5: 9, 6: 12}[field]
        header[at] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    return changed(content, b"IHDR", bytes(header))


@mutates(".png")
def grow_picture(content: bytes, rng: Random) -> bytes:
    """A picture of another size, whole: perhaps a huge one of zeros, which packs into little."""
    header = bytearray(dict(chunks(content))[b"IHDR"])
    width, height = rng.choice(
        ((8, 31), (1, 1), (33, 8), (32, 9), (1000, 1), (9000, 9000), (13_000, 12_000))
    )
    header[:8] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    pixel = header[8] // 8 or 1
    rows = height if rng.random() < 0.3 else min(height, 100)
    return changed(
        changed(content, b"IHDR", bytes(header)),
        b"IDAT",
        zeros(1 + width * pixel, rows),
    )


@cache
def zeros(row: int, rows: int) -> bytes:
    """Rows of so many zeros, packed."""
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(row)) for _ in range(rows)) + packer.flush()


@mutates(".png")
def edit_pixels(content: bytes, rng: Random) -> bytes:
    """Rows hold other values, or an unknown filter, or there are too few or too many."""
    data = zlib.decompress(
        b"".join(data for kind, data in chunks(content) if kind == b"IDAT")
    )
    values = bytearray(data)
    for _ in range(rng.choice((1, 2, 100))):
        values[rng.randrange(len(values))] = rng.choice((0, 1, 5, 19, 128, 254, 255))
    values = rng.choice(
        (values, values, values, values[: len(values) // 2], values * 2)
    )
    return changed(content, b"IDAT", zlib.compress(bytes(values)))


@mutates(".png")
def edit_chunks(content: bytes, rng: Random) -> bytes:
    """Chunks are dropped, repeated, reordered, renamed or foreign."""
    parts = chunks(content)
    i = rng.randrange(len(parts))
    change = rng.randrange(6)
    if change == 0:
        del parts[i]
    elif change == 1:
        parts.insert(rng.randrange(len(parts) + 1), parts[i])
    elif change == 2:
        rng.shuffle(parts)
    elif change == 3:
        parts[i] = (
            rng.choice(
                (b"tEXt", b"zTXt", b"iTXt", b"PLTE", b"tRNS", b"acTL", b"xxxx", b"IEND")
            ),
            parts[i][1],
        )
    elif change == 4:
        bomb = zlib.compress(bytes(rng.choice((1000, 1000, 1000, 70_000_000))), 1)
        parts.insert(1, (b"zTXt", b"lidar_synth\x00\x00" + bomb))
    else:
        number = rng.choice(INTEGERS) % 2**32
        parts.insert(
            1,
            (
                rng.choice((b"gAMA", b"pHYs", b"iCCP", b"eXIf", b"fcTL")),
                number.to_bytes(4, "big") * 4,
            ),
        )
    return join(parts)


@mutates(".png")
def edit_text(content: bytes, rng: Random) -> bytes:
    """The JSON of the text chunk says something else."""
    parts = chunks(content)
    texts = [i for i, (kind, _) in enumerate(parts) if kind == b"tEXt"]
    if not texts:
        return edit_size(content, rng)
    i = rng.choice(texts)
    key, _, text = parts[i][1].partition(b"\x00")
    parts[i] = (b"tEXt", key + b"\x00" + encoded(edit_json_text(text.decode(), rng)))
    return join(parts)
