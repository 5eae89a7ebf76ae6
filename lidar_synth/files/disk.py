"""Reading and writing of files and of numbers in text files, with clear errors.

A file is written under a temporary name and then renamed, so that a reader never sees a partial
file.
"""

import errno
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, FileError, LidarSynthError, shorten

LARGEST_IMAGE = 65535
"""Maximum width and height of an image in pixels."""

_BLOCK = 1 << 20  # number of bytes read at a time
STRAY = "allow_pickle"
"""Name of a spurious array: numpy before 2.2 stores the option of that name as an array."""

SKIP_HINT = "Copy the file again, or skip it with on_bad='skip'."

LONGEST_NAME = 200
"""Maximum length of a file's name in bytes. File systems allow 255, but the temporary name while
writing is longer."""

_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")

_NOT_ON_WINDOWS = re.compile(r'[<>:"|?*]|[. ]$|^(?i:con|prn|aux|nul|com\d|lpt\d)(\.|$)')


def part_of(path: Path) -> Path:
    """A unique temporary name beside ``path``, for a file that is being written."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


def write_file(
    path: Path,
    content: bytes | Callable[[BinaryIO], object],
    *,
    durable: bool = False,
    overwrite: bool = True,
) -> None:
    """Write a temporary file beside ``path``, then rename it; a failure leaves an existing file
    unchanged.

    Args:
        path: the output file; its folder is created.
        content: the bytes, or a function that writes them to an open binary file.
        durable: whether to flush the bytes to disk before the rename, so that the file is complete
            after a power cut.
        overwrite: whether to replace an existing file; otherwise the first of several processes
            wins.

    Raises:
        FileError: if the target cannot be written or the disk is full.
    """
    part = part_of(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            # always a new file, never the target of a link with this name
            with part.open("xb") as file:
                if callable(content):
                    content(file)
                else:
                    file.write(content)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            if overwrite or not _linked(part, path):
                part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _linked(part: Path, path: Path) -> bool:
    """Link a file to its final path unless that exists; False if the file system has no hard
    links."""
    try:
        os.link(part, path)
    except OSError:
        # Also where the process that won has removed this one's temporary file.
        return path.exists()
    return True


def refuse_special(path: str | Path) -> None:
    """Refuse what is no file before it is opened: opening a named pipe would wait for ever, and a
    device may never end.

    Raises:
        OSError: on a pipe, a socket or a device, or if there is nothing.
    """
    mode = Path(path).stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "it is a pipe or a device, not a file")


@contextmanager
def open_file(
    path: Path, expected: str = "a file of the dataset"
) -> Iterator[BinaryIO]:
    """Open a file for reading.

    Args:
        path: the file.
        expected: description of the expected file, for the error.

    Raises:
        FileError: if it cannot be opened or read, or is special.
    """
    with reading(path, expected):
        refuse_special(path)
        with path.open("rb") as file:
            yield file


def read_file(
    path: Path, expected: str = "a file of the dataset", at_most: int | None = None
) -> bytes:
    """Read the bytes of a file.

    Args:
        path: the file.
        expected: description of the expected file, for the error.
        at_most: maximum size in bytes; a longer file is refused.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is longer.
    """
    with open_file(path, expected) as file:
        # read(n) takes n bytes of memory before it reads: no more than the file has.
        size = os.fstat(file.fileno()).st_size
        content = file.read(-1 if at_most is None else min(at_most, size) + 1)
    if at_most is not None and len(content) > at_most:
        raise DataError(f"{path} is longer than {at_most} bytes", expected)
    return content


def read_start(path: Path, size: int) -> str:
    """The first ``size`` bytes of a file, as Latin-1 text.

    Raises:
        FileError: if it cannot be read.
    """
    with open_file(path) as file:
        return file.read(size).decode("latin-1")


def write_arrays(
    path: Path, arrays: Mapping[str, Any], *, compressed: bool = False
) -> None:
    """Write an ``.npz`` file that is the same with every version of numpy; nothing is pickled.

    Raises:
        FileError: if it cannot be written.
        DataError: on an array of Python objects.
    """
    values = {name: np.asanyarray(array) for name, array in arrays.items()}
    if objects := [name for name, array in values.items() if array.dtype.hasobject]:
        raise DataError(
            f"arrays {objects} of Python objects for {path}",
            "numbers, truth values or text",
        )
    save = np.savez_compressed if compressed else np.savez
    write_file(path, lambda file: save(file, **values))


def hash_of_names(names: Iterable[str]) -> str:
    """SHA-256 of several names, in their order; of any names, such as those of files that are no
    UTF-8."""
    return hashlib.sha256("\n".join(names).encode(errors="surrogatepass")).hexdigest()


def sha256(path: Path) -> str:
    """The SHA-256 of a file's bytes, as hexadecimal digits.

    Raises:
        OSError: if it cannot be read.
    """
    digest = hashlib.sha256()
    refuse_special(path)
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def sync_folder(path: Path) -> None:
    """Sync a folder's entries to the disk, where the system supports it."""
    with suppress(OSError):  # Windows cannot open folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_file(path: Path) -> None:
    """Remove a file, if it is there.

    Raises:
        FileError: if it cannot be removed.
    """
    with writing(path):
        path.unlink(missing_ok=True)


@contextmanager
def reading(path: Path, expected: str = "a file of the dataset") -> Iterator[None]:
    """Name a path in errors of the system.

    Raises:
        FileError: if it cannot be read.
    """
    try:
        yield
    except OSError as error:
        raise FileError(
            f"{path} cannot be read ({error.strerror or error})", expected
        ) from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name a path in errors of the system; those of the package pass.

    Raises:
        FileError: if it cannot be written.
    """
    try:
        yield
    except LidarSynthError:
        raise
    except OSError as error:
        raise FileError(
            f"{path} cannot be written ({error.strerror or error})",
            "a writable folder on a disk with free space",
            "Choose another output folder or free some space, then run the same again: complete "
            "files are kept.",
        ) from error


def join_inside(folder: Path, name: str) -> Path:
    """The path under a folder of an untrusted name, such as one from a bank, an archive or a table.

    Args:
        folder: the folder in which the path must be.
        name: relative path with / as separator.

    Raises:
        DataError: on a name that leads out of the folder, that could denote the same file as
            another name, or that is not a valid file name on every system.
    """
    if fault := _name_fault(name):
        raise DataError(
            f"the name {shorten(repr(name), 100)} for a file under {folder}: {fault}",
            "a relative path such as town/7/12",
        )
    return folder / name


def _name_fault(name: str) -> str:
    """Why a name cannot be the path of a file; "" if it can."""
    parts = name.split("/")
    if _UNPRINTABLE.search(name):
        return "it has a control character or half a character"
    if "\\" in name or re.match("[A-Za-z]:", name) or name.startswith("/"):
        return "it is an absolute path, or has a backslash"
    if any(part.startswith(".") or not part for part in parts):
        return "a part of it is empty, or begins with a dot"
    if (
        len(name.encode()) > 1000
        or max(len(part.encode()) for part in parts) > LONGEST_NAME
    ):
        return f"it is longer than 1000 bytes, or one of its parts than {LONGEST_NAME}"
    if os.name == "nt" and any(_NOT_ON_WINDOWS.search(part) for part in parts):
        return "Windows has another meaning for it"
    return ""


def refuse_links(folder: Path) -> None:
    """Refuse an output folder with a link that leads out of it, because files would be written
    elsewhere.

    Raises:
        FileError: if there is such a link; the message names it.
    """
    home = folder.resolve()
    for parent, names, _ in os.walk(folder):
        for path in (Path(parent, name) for name in names):
            if path.is_symlink() and not path.resolve().is_relative_to(home):
                raise FileError(
                    f"{path} is a link to {path.resolve()}",
                    f"folders that lie in {folder}",
                    "Remove the link, or choose another output folder.",
                )


def list_files(folder: Path, *suffixes: str) -> list[Path]:
    """The files of a folder with one of the suffixes, sorted by name; hidden (partial) files are
    skipped.

    Raises:
        FileError: if the folder cannot be read.
    """
    try:
        names = sorted(
            e.name
            for e in os.scandir(folder)
            if e.name.endswith(suffixes) and e.name[0] != "."
        )
    except OSError as error:
        raise FileError(
            f"{folder} cannot be read ({error.strerror})", "a folder with scans"
        ) from error
    return [folder / name for name in names]


def files_below(folder: Path) -> Iterator[Path]:
    """All files in a folder and its subfolders, in any order.

    Links to folders are followed, except to a folder above the link, which would never end.
    """
    for parent, folders, names in os.walk(folder, followlinks=True):
        here = Path(parent)
        links = [name for name in folders if (here / name).is_symlink()]
        above = {path.resolve() for path in (here, *here.parents) if links}
        for name in links:
            if (here / name).resolve() in above:
                folders.remove(name)
        yield from (here / name for name in names)


def read_values(path: Path, dtype: str) -> NDArray[Any]:
    """Read (N,) values of one type from a raw file.

    Raises:
        FileError: if the file cannot be read.
        DataError: if its size is not a whole number of values.
    """
    content = read_file(path)
    width = np.dtype(dtype).itemsize
    if len(content) % width:
        raise DataError(
            f"{path} is {len(content)} bytes long",
            f"a multiple of {width} ({dtype})",
            SKIP_HINT,
        )
    return np.frombuffer(content, dtype)


def read_text(
    path: Path, expected: str = "a file of the dataset", at_most: int | None = None
) -> str:
    """Read the text of a file, without a byte-order mark; the arguments are those of
    ``read_file``.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not UTF-8 text, or too long.
    """
    try:
        return read_file(path, expected, at_most).decode().removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path} is not a text file ({error.reason})", "UTF-8 text"
        ) from error


def read_matrix(path: Path, columns: int) -> NDArray[np.float64]:
    """Read (N, columns) numbers of a text file, one row per line.

    Raises:
        FileError: if it cannot be read.
        DataError: on a line that does not consist of ``columns`` numbers.
    """
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    try:
        if any(len(row) != columns for row in rows):
            raise ValueError("a line of another length")
        return np.array(rows, np.float64).reshape(-1, columns)
    except ValueError as error:
        raise DataError(
            f"{path} does not hold rows of {columns} numbers",
            f"{columns} numbers per line",
        ) from error


@contextmanager
def name_errors(where: str | Path) -> Iterator[None]:
    """Prefix errors raised in this context with the name of a file."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def read_named_matrices(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read {name: (N,) values} from KITTI's calibration files: ``name: number number ...`` per
    line.

    Lines whose values are not all numbers (dates) are skipped.

    Raises:
        FileError: if it cannot be read.
    """
    matrices = {}
    for line in read_text(path).splitlines():
        name, colon, values = line.partition(":")
        if not colon:
            continue
        with suppress(ValueError):
            matrices[name.strip()] = np.array(values.split(), np.float64)
    return matrices


def write_named_matrices(
    path: Path, matrices: Mapping[str, NDArray[np.float64]]
) -> None:
    """The inverse of ``read_named_matrices``, with KITTI's 12 decimals.

    Raises:
        FileError: if it cannot be written.
    """
    lines = [
        f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(m))}\n"
        for name, m in matrices.items()
    ]
    write_file(path, "".join(lines).encode())


def numbers(values: Iterable[float]) -> str:
    """Format numbers for a text file, such that reading them gives the same float64 values."""
    return " ".join(repr(float(v)) for v in values)
