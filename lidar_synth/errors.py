"""The errors of the package: one base, and a message that helps.

Every error says what was given, what was expected and what to type, in that order::

    raise DataError("scan.bin is 1001 bytes long",
                    "a multiple of 16: float32 x, y, z, reflectance for each point",
                    "copy the file again, or skip it with on_bad='skip'")
"""


class LidarSynthError(Exception):
    """Base class of every error that the package raises on purpose.

    Args:
        given: what was found, with the path, shape or value.
        expected: what would have been right.
        hint: what the reader of the message can type or change.

    Example:
        >>> from lidar_synth import LidarSynthError, open_scans
        >>> try:
        ...     open_scans("no/such/folder")
        ... except LidarSynthError as error:
        ...     print(error)
        no/such/folder does not exist; expected ...
    """

    def __init__(self, given: str, expected: str = "", hint: str = "") -> None:
        # One string in args, so that the error survives pickling between worker processes.
        super().__init__(given + (f"; expected {expected}" if expected else "") + (f". {hint}" if hint else ""))


def shorten(text: str, most: int) -> str:
    """A text for a message: at most so many characters of it."""
    return text if len(text) <= most else f"{text[:most]} ..."


class DataError(LidarSynthError, ValueError):
    """A file, array or scan whose content is not what it has to be."""


class ConfigError(LidarSynthError, ValueError):
    """An option, argument or configuration key that cannot be served."""


class FileError(LidarSynthError, OSError):
    """A path that is missing, unreadable, unwritable or on a full disk."""


class LibraryError(LidarSynthError, OSError):
    """An optional library, or a system library behind it, that is not installed."""


class ProcessError(LidarSynthError, OSError):
    """A process of the package that died, or that does not answer in time."""
