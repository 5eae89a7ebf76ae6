"""Safe parsers with limits for untrusted files: JSON, YAML, numpy arrays, archives and images.

A hostile file may declare huge sizes, depths or nested aliases. What it declares is compared with
its actual size and with a limit before memory is allocated, and every fault becomes an error of
this package.
"""

import hashlib
import json
import re
import struct
import tarfile
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from io import BytesIO
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, parsing, shorten
from lidar_synth.files.disk import SKIP_HINT, STRAY, open_file, read_file, read_text

if TYPE_CHECKING:
    from PIL.Image import Image

MOST_BYTES = 128 << 20
"""Maximum size of all decompressed arrays of a file in bytes: 8 million points with reflectance."""

PICTURES = ("PNG", "JPEG")
"""Formats of images; Pillow's other readers start programs (PostScript) or are little tested."""

MOST_PIXELS = 1 << 25
"""Maximum number of pixels of an image."""

LONGEST_YAML = 1 << 18
"""Maximum number of characters of a YAML text."""

LONGEST_PLAIN = 3000
"""Maximum number of characters of an unquoted YAML value."""

MOST_NODES = 20_000
DEEPEST = 64
"""Maximum number of values in a YAML text, with all aliases expanded, and maximum number of
levels."""

LONGEST_TAR_HEADER = 1 << 20
"""Maximum size of the attributes or of the name of a tar member in bytes."""

_TAR_HEADERS = (
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
)

DAMAGED_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    OverflowError,
    RuntimeError,
)
"""Exceptions of ``zipfile`` on a damaged file; encrypted members and unknown methods are a
RuntimeError."""

ARRAYS = "arrays of numbers written by numpy, none of them pickled"


def parse_json(
    text: str | bytes, where: str, expected: str = "JSON", hint: str = SKIP_HINT
) -> Any:
    """Parse a JSON text.

    Raises:
        DataError: if it is not JSON, or nested too deeply.
    """
    with parsing(f"{where} is not JSON", expected, hint):
        return json.loads(text)


def read_facts(path: Path, expected: str) -> dict[str, Any]:
    """Read a JSON file with values by name.

    Args:
        path: the file.
        expected: description of the expected file, for the error.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not JSON, or no mapping.
    """
    facts = parse_json(read_text(path, expected), str(path), expected)
    if not isinstance(facts, dict):
        raise DataError(
            f"{path} is damaged (it holds {type(facts).__name__})", expected
        )
    return facts


def seal(values: Mapping[str, Any]) -> bytes:
    """Values as JSON with a checksum; the inverse of ``read_sealed``."""
    return json.dumps({**values, "checksum": json_checksum(values)}).encode()


def read_sealed(path: Path, expected: str) -> dict[str, Any]:
    """Read the values that ``seal`` wrote.

    Raises:
        FileError: if the file cannot be read.
        DataError: if it is damaged, or its checksum differs.
    """
    values = read_facts(path, expected)
    if values.pop("checksum", None) != json_checksum(values):
        raise DataError(f"{path} is damaged (its checksum differs)", expected)
    return values


def json_checksum(values: Mapping[str, Any]) -> str:
    """SHA-256 of plain values, in hexadecimal; the same for every order of the keys."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()


def read_yaml(path: Path, expected: str) -> Any:
    """Read a YAML file.

    Args:
        path: the file.
        expected: description of the expected file, for the error.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is too long, or not UTF-8.
        ConfigError: as ``parse_yaml``.
    """
    return parse_yaml(read_text(path, expected, LONGEST_YAML), str(path))


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice, instead of taking the last one."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):  # others cannot be keys
                if (key.tag, key.value) in seen:
                    raise yaml.YAMLError(
                        f"line {key.start_mark.line + 1}: the key "
                        f"{shorten(key.value, 100)!r} stands twice"
                    )
                seen.add((key.tag, key.value))
        return node


def parse_yaml(text: str, where: str) -> Any:
    """Parse the plain values of a YAML text.

    Raises:
        ConfigError: if it is not YAML, has tags or a key twice, or exceeds the limits on values and
            levels.
    """
    try:
        fault = _yaml_fault(yaml.parse(text, Loader=yaml.SafeLoader))
        values = None if fault else _Loader(text).get_single_data()
    # a date such as 2001-99-99 is a ValueError
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"{where} is not YAML ({' '.join(str(error).split())})"
        ) from error
    if fault:
        raise ConfigError(f"{where} is not YAML of plain values: it has {fault}")
    return values


def _yaml_fault(events: Iterable[Any]) -> str:
    """Why a YAML text is refused, by its events; "" if it is accepted."""
    count = 0
    opened = []
    sizes: dict[str, int] = {}
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                return f"the alias *{event.anchor} of nothing before it"
            count += sizes[event.anchor]
        elif isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent):
            if event.tag is not None:
                return f"the tag {event.tag}"
            count += 1
            if isinstance(event, yaml.CollectionStartEvent):
                opened.append((event.anchor, count))
            elif event.anchor is not None:
                sizes[event.anchor] = 1
            # Python prints no number of 4300 digits.
            if (
                isinstance(event, yaml.ScalarEvent)
                and event.style is None
                and len(event.value) > LONGEST_PLAIN
            ):
                return f"a value of {len(event.value)} characters without quotes"
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, first = opened.pop()
            if anchor is not None:
                sizes[anchor] = count - first + 1
        if count > MOST_NODES or len(opened) > DEEPEST:
            return f"more than {MOST_NODES} values or {DEEPEST} levels"
    return ""


def read_arrays(
    path: Path, only: Collection[str] | None = None, most: int = MOST_BYTES
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an ``.npz`` file, or that of an ``.npy`` file under the name ``array``.

    Args:
        path: the file.
        only: names of the arrays to read; by default all.
        most: maximum size of all decompressed arrays in bytes.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not such a file, is damaged, declares more than it holds or than
            ``most``, or holds anything but numbers and text.
    """
    content = read_file(path, "an .npz or .npy file")
    if not content.startswith(b"PK"):
        return {"array": parse_npy(content, str(path))}
    members = _unzip(content, str(path), only, most)
    members.pop(STRAY, None)
    return {
        name: parse_npy(member, f"{path}, array {name!r}")
        for name, member in members.items()
    }


def _unzip(
    content: bytes, where: str, only: Collection[str] | None, most: int
) -> dict[str, bytes]:
    """{name without .npy: bytes} of a ZIP file's members."""
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            infos = archive.infolist()
            fault = zip_fault(infos, len(content), most)
            members: dict[str, bytes] = {}
            for info in [] if fault else infos:
                name = info.filename.removesuffix(".npy")
                if only is None or name in only:
                    with archive.open(info) as file:
                        # read() alone has no limit
                        members[name] = file.read(info.file_size)
    except DAMAGED_ZIP as error:
        raise DataError(
            f"{where}: {error or type(error).__name__}", ARRAYS, SKIP_HINT
        ) from error
    if fault:
        raise DataError(f"{where} {fault}", ARRAYS, SKIP_HINT)
    return members


def zip_fault(infos: list[zipfile.ZipInfo], size: int, most: int) -> str:
    """Why the members of a ZIP file of this size are refused; "" if they are accepted."""
    names = [info.filename for info in infos]
    if len(set(names)) < len(names):
        return "holds two arrays of one name"
    if any(
        info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        for info in infos
    ):
        return "is compressed by another method than deflate"
    # zipfile reads as many bytes as the archive says, and takes the memory before.
    if sum(info.compress_size for info in infos) > size:
        return "declares more bytes than it holds"
    deflated = sum(
        info.file_size for info in infos if info.compress_type == zipfile.ZIP_DEFLATED
    )
    stored = sum(info.file_size for info in infos) - deflated
    if deflated > most or stored > size:
        return (
            f"declares {deflated + stored} bytes of arrays in {size}, more than it can hold or "
            f"{most} bytes"
        )
    return ""


class TarMember(tarfile.TarInfo):
    """A tar member with checked sizes, for ``tarfile.open``.

    Older versions of tarfile loop for ever on a negative size (CVE-2025-8194), no version can seek
    beyond 2^63, and a header of a long name or of attributes is read at once, whatever its size.
    """

    def _block(self, count: int) -> int:
        if not 0 <= count < 1 << 62:
            raise tarfile.ReadError(f"a member of {count} bytes")
        if self.type in _TAR_HEADERS and count > LONGEST_TAR_HEADER:
            raise tarfile.ReadError(f"a header of {count} bytes")
        return super()._block(count)  # type: ignore[misc,no-any-return]


_DESCRIPTION = re.compile(
    r"""\{(?:(?:['"]descr['"]:(?:['"](?P<descr>[^'"]*)['"])"""
    r"""|['"]fortran_order['"]:(?P<fortran>True|False)"""
    r"""|['"]shape['"]:\((?P<shape>(?:[0-9]{1,12}L?(?:,|(?=\))))*)\)),?){3}\}"""
)
"""The header of numpy's format, without white space: a dictionary of these three, in any order."""

_TYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|U[1-9]\d{0,6})")
"""The supported types: booleans, integers, floating-point numbers, and text."""


def parse_npy(content: bytes, where: str) -> NDArray[Any]:
    """Parse the array of an ``.npy`` file
    (https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html).

    Raises:
        DataError: if it is not such a file, its size does not match its header, or it holds
            anything but numbers and text.
    """
    width = (
        {1: 2, 2: 4, 3: 4}.get(content[6], 0)
        if len(content) > 10 and content[:6] == b"\x93NUMPY"
        else 0
    )
    start = 8 + width + int.from_bytes(content[8 : 8 + width], "little")
    if not width or start > min(len(content), 10_000):
        raise DataError(f"{where} has no header of an .npy file", ARRAYS, SKIP_HINT)
    header = re.sub(r"\s", "", content[8 + width : start].decode("latin-1"))
    found = _DESCRIPTION.fullmatch(header)
    dtype = _TYPE.fullmatch(found["descr"] or "") if found else None
    if found is None or dtype is None or None in (found["fortran"], found["shape"]):
        raise DataError(f"{where} holds {header[:200]}", ARRAYS, SKIP_HINT)
    shape = tuple(
        int(length) for length in found["shape"].replace("L", "").split(",") if length
    )
    return _array(
        content, start, np.dtype(dtype[0]), shape, found["fortran"] == "True", where
    )


def _array(
    content: bytes,
    start: int,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    fortran: bool,
    where: str,
) -> NDArray[Any]:
    """The array whose values are stored in ``content`` from ``start`` on."""
    held = len(content) - start
    if (
        prod(shape) * dtype.itemsize != held
        or len(shape) > 8
        or prod(max(n, 1) for n in shape) >= 1 << 58
    ):
        raise DataError(
            f"{where} holds {held} bytes for {dtype} of shape {shape}",
            "as many as its shape requires",
            SKIP_HINT,
        )
    values = np.frombuffer(content, dtype, offset=start).copy()
    if dtype.kind == "U":
        codes = values.view(np.dtype("u4").newbyteorder(dtype.byteorder))
        if ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))).any():
            raise DataError(f"{where} holds invalid text", ARRAYS, SKIP_HINT)
    return values.reshape(shape, order="F" if fortran else "C")


def picture_size(path: Path) -> tuple[int, int] | None:
    """(width, height) of a PNG or JPEG, from its header; None if the file is missing or its header
    damaged."""
    from PIL import Image

    with (
        suppress(*DAMAGED_ZIP, Image.DecompressionBombError),
        open_file(path) as file,
        Image.open(file, formats=PICTURES) as opened,
    ):
        return opened.size
    return None


def read_picture(path: Path, expected: str = "a PNG or JPEG file") -> "Image":
    """Read and decode an image.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not an image, is damaged, or has more than ``MOST_PIXELS``.
    """
    from PIL import Image

    content = BytesIO(read_file(path))
    try:
        with warnings.catch_warnings(), Image.open(content, formats=PICTURES) as opened:
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            size = opened.size
            if prod(size) <= MOST_PIXELS:
                opened.load()
                return opened
    # The exceptions of Pillow's readers on damaged files.
    except (
        *DAMAGED_ZIP,
        LookupError,
        SyntaxError,
        TypeError,
        Image.DecompressionBombError,
    ) as error:
        raise DataError(
            f"{path} cannot be read ({error or type(error).__name__})",
            expected,
            SKIP_HINT,
        ) from error
    raise DataError(
        f"{path} has {size} columns and rows",
        f"at most {MOST_PIXELS} pixels",
        SKIP_HINT,
    )


def read_rgb(path: Path) -> "Image":
    """Read an image as 8-bit red, green and blue; 16-bit grey values keep their higher bytes, as
    Pillow keeps those of 16-bit colours. Raises as ``read_picture``."""
    from PIL import Image

    image = read_picture(path)
    # Pillow itself would clip them. It has two names for 16 bits, by its version.
    if image.mode.startswith("I"):
        image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    return image.convert("RGB")
