"""The exceptions of the package.

Every message states what was given, what was expected and what to type, in that order::

    raise DataError("scan.bin is 1001 bytes long",
                    "a multiple of 16: float32 x, y, z, reflectance for each point",
                    "copy the file again, or skip it with on_bad='skip'")
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from numbers import Integral
from typing import Any, TypeVar

Choice = TypeVar("Choice")
MISFITS = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    RuntimeError,
    ArithmeticError,
    SyntaxError,
)
"""What values of other kinds than expected cause."""


class LidarSynthError(Exception):
    """Base class of the exceptions that the package raises on purpose.

    Args:
        given: the input that caused the error, with its path, shape or value.
        expected: what a valid input is.
        hint: what the user can type or change.

    Example:
        >>> from lidar_synth import LidarSynthError, open_scans
        >>> try:
        ...     open_scans("no/such/folder")
        ... except LidarSynthError as error:
        ...     print(error)
        no/such/folder does not exist; expected ...
    """

    def __init__(self, given: str, expected: str = "", hint: str = "") -> None:
        # A single string in args, so that the exception can be pickled between worker processes.
        super().__init__(
            given
            + (f"; expected {expected}" if expected else "")
            + (f". {hint}" if hint else "")
        )


def shorten(text: str, most: int) -> str:
    """The first ``most`` characters of a text, with "..." if it is longer."""
    return text if len(text) <= most else f"{text[:most]} ..."


def suggest(name: object, known: Iterable[str]) -> str:
    """A hint for a misspelt name: "Did you mean 'kitti'?", or "" if no known name is near.

    Args:
        name: what was given.
        known: the names that exist.

    Example:
        >>> suggest("kiti", ["kitti", "pcd"])
        "Did you mean 'kitti'?"
    """
    near = get_close_matches(str(name), list(known))
    return f"Did you mean {' or '.join(map(repr, near))}?" if near else ""


def import_name(package: str, homes: Mapping[str, str], name: str) -> Any:
    """Import a name of a package when it is first used.

    Args:
        package: the name of the package.
        homes: {name: the module below the package that has it}.
        name: the one that is used.

    Raises:
        AttributeError: on a name that is not in ``homes``.
    """
    if name not in homes:
        hint = f". {suggest(name, homes)}".rstrip(". ")
        raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")
    return getattr(import_module(f"{package}.{homes[name]}"), name)


class DataError(LidarSynthError, ValueError):
    """A file, array or scan with invalid content."""


class ConfigError(LidarSynthError, ValueError):
    """An invalid option, argument or configuration key."""


class FileError(LidarSynthError, OSError):
    """A path that is missing or cannot be read or written, or a full disk."""


class LibraryError(LidarSynthError, OSError):
    """An optional library, or a system library that it needs, is not installed."""


class ProcessError(LidarSynthError, OSError):
    """A process of the package that died or did not answer in time."""


def choose(kind: str, name: str, table: Mapping[str, Choice], hint: str = "") -> Choice:
    """``table[name]``, or an error that lists the names.

    Raises:
        ConfigError: on a name that is not in the table.
    """
    if name not in table:
        hint = f"{hint} {suggest(name, table)}".strip()
        raise ConfigError(
            f"{kind} {name!r}", f"one of {', '.join(map(repr, table))}", hint
        )
    return table[name]


def check_count(name: str, value: int, least: int) -> None:
    """Check that ``value`` is a whole number of at least ``least``.

    Raises:
        ConfigError: on any other value.
    """
    if not (isinstance(value, Integral) and value >= least):
        given = f"{name} {shorten(repr(value), 40)}"
        raise ConfigError(given, f"a whole number, {least} or more")


@contextmanager
def needs(extra: str, what: str, otherwise: str = "") -> Iterator[None]:
    """Say what to install if an import fails.

    Args:
        extra: of this package, which has the library.
        what: the subject of "cannot be imported", such as ``"engine 'ray', but ray"``.
        otherwise: what else the user can do.

    Raises:
        LibraryError: if a library cannot be imported.
    """
    try:
        yield
    except ImportError as error:
        raise LibraryError(
            f"{what} cannot be imported ({error})",
            f"the extra {extra}",
            f"pip install 'lidar_synth[{extra}]'{otherwise}",
        ) from error


@contextmanager
def parsing(what: object, expected: str = "", hint: str = "") -> Iterator[None]:
    """Say what was read if its values are not as expected; errors that say so already pass.

    Args:
        what: the path, or a description.
        expected: what a valid one holds.
        hint: what the user can type or change.

    Raises:
        DataError: if a key is missing, or a value is of another kind or outside its interval.
    """
    try:
        yield
    except MISFITS as error:
        if isinstance(error, DataError) and str(what) in str(error):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        cause = str(error).removesuffix(".")
        raise DataError(f"{what}: {kind}{cause}", expected, hint) from error
