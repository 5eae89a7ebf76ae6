"""Hostile inputs that several tests share: arrays in the .npy format, bodies of point clouds, a
sensor, names."""

import io
import re
import struct

import markdown
import numpy as np

MARKUP = """<img src=x onerror="alert(1)"> | [x](javascript:y) ![z](data:w) `<b>` <http://a.b>
# title

<script>s</script>"""
"""A name, licence or data set's description that Markdown would show as elements of a page."""

POINTS = np.random.default_rng(0).uniform(0, 1, (20, 4)).astype("<f4")


def literal_lzf(content: bytes) -> bytes:
    """LZF that holds everything as it is, with the two lengths before it."""
    parts = [content[i : i + 32] for i in range(0, len(content), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(content)) + packed


BODIES = {
    "binary": POINTS.tobytes(),
    "binary_compressed": literal_lzf(POINTS.T.tobytes()),
    "ascii": "".join(f"{' '.join(map(str, row))}\n" for row in POINTS).encode(),
}


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    content = header.encode("latin-1") + b"\n"
    width = {1: 2, 2: 4, 3: 4}[version]
    return (
        b"\x93NUMPY"
        + bytes([version, 0])
        + len(content).to_bytes(width, "little")
        + content
        + body
    )


def described(
    descr: str = "'<f4'", shape: str = "(20, 4)", order: str = "False"
) -> str:
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"


def saved(array: object, *, pickled: bool = False) -> bytes:
    content = io.BytesIO()
    np.save(content, np.asarray(array), allow_pickle=pickled)
    return content.getvalue()


HOSTILE_NPY = {
    "160 GB": npy(described(shape="(10000000000, 4)"), bytes(64)),
    "more than bits": npy(described(shape="(4611686018427387904, 8)"), b""),
    "nothing of much": npy(described(shape="(0, 99999999999, 99999999999)"), b""),
    "a token that does not end": npy(
        "{'descr': '<f4', 'fortran_order': False, 'shape': (3L"
    ),
    "deep": npy("(" * 5000),
    "minus": npy("-" * 9000 + "1"),
    "blanks": npy("{'descr': '<f4'," + " " * 9900),
    "digits": npy(described(shape=f"({'9' * 5000},)")),
    "a list": npy("[1, 2]"),
    "negative": npy(described(shape="(-20, -4)"), BODIES["binary"]),
    "fewer values": npy(described(shape="(19, 4)"), BODIES["binary"]),
    "more values": npy(described(shape="(21, 4)"), BODIES["binary"]),
    "complex": saved(POINTS.astype("c8")),
    "objects": saved([{"a": 1}], pickled=True),
    "records": saved(np.zeros(20, [("x", "<f4"), ("y", "<f4")])),
    "text": saved(POINTS.astype(str)),
    "dates": saved(np.zeros((20, 4), "M8[s]")),
    "no scan": saved(5.0),
    "empty": saved(np.zeros((0, 4), "f4")),
    "a long header": npy(" " * 60_000 + described(), BODIES["binary"]),
    "a header beyond the end": b"\x93NUMPY\x02\0\xff\xff\xff\xff{",
    "version 9": b"\x93NUMPY\x09" + npy(described(), BODIES["binary"])[7:],
}


LINEAR = {
    "columns": 64,
    "rows": 8,
    "fov_up": 3.0,
    "fov_down": -25.0,
    "range_min": 1.0,
    "range_max": 80.0,
}


def tags_of(card: str) -> set[str]:
    """The HTML elements that a card in Markdown is shown with, its header left out."""
    body = card.split("---\n", 2)[2] if card.startswith("---\n") else card
    return set(
        re.findall(
            r"<(\w+)", markdown.markdown(body, extensions=["tables", "fenced_code"])
        )
    )
