"""The exceptions of the package.

Every message states what was given, what was expected and what to type, in that order::

    raise DataError("scan.bin is 1001 bytes long",
                    "a multiple of 16: float32 x, y, z, reflectance for each point",
                    "copy the file again, or skip it with on_bad='skip'")
"""


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
        super().__init__(given + (f"; expected {expected}" if expected else "") + (f". {hint}" if hint else ""))


def shorten(text: str, most: int) -> str:
    """The first ``most`` characters of a text, with "..." if it is longer."""
    return text if len(text) <= most else f"{text[:most]} ..."


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
