"""Claims: an output folder keeps the settings that it is filled with, and refuses a run with
others."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from reprlib import Repr
from typing import Any

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_text, write_file, writing
from lidar_synth.files.lock import one_writer
from lidar_synth.files.parsing import parse_json

_SHORT = Repr()  # a sensor's numbers would fill the screen
_SHORT.maxstring = 100
_SHORT.maxdict = 8


def require_outside(out: Path, root: Path) -> None:
    """Refuse to write into the folder that is read.

    Raises:
        ConfigError: if ``out`` is ``root`` or lies in it.
    """
    if out.resolve().is_relative_to(root.resolve()):
        raise ConfigError(f"output {out} inside of {root}", "a folder outside of it")


def claim(path: Path, settings: dict[str, Any]) -> None:
    """Record the settings of an output folder in a file, and refuse a folder with other settings.

    Otherwise a rerun with other settings would keep old scans and present them as new ones.

    Args:
        path: the file, in the output folder.
        settings: plain values that determine what is written.

    Raises:
        ConfigError: if the folder was filled with other settings.
        DataError: if the file is damaged.
        FileError: if it cannot be read or written.
    """
    wanted = json.loads(json.dumps(settings))
    if not path.is_file():
        # Another process may create it at the same time.
        write_file(path, json.dumps(wanted, indent=1).encode(), overwrite=False)
    compare(read_text(path), wanted, path.parent, path.name)


def compare(
    text: str, wanted: dict[str, Any], folder: str | Path, name: str, hint: str = ""
) -> None:
    """Refuse a folder, or a URL, whose file ``name`` records other settings; raises as
    ``claim``. A setting that it does not record, or that is not wanted, is None. The error ends
    with ``hint``."""
    existing = parse_json(
        text,
        f"{folder}/{name}, which is damaged,",
        "the settings that this package wrote",
    )
    if not isinstance(existing, dict):
        raise DataError(
            f"{folder}/{name} is damaged (it holds {type(existing).__name__})",
            hint="Choose another output folder.",
        )
    keys = {**wanted, **existing}
    other = [key for key in keys if existing.get(key) != wanted.get(key)]
    if other:
        before, now = ({k: each.get(k) for k in other} for each in (existing, wanted))
        raise ConfigError(
            f"{folder} was filled with {_SHORT.repr(before)}",
            _SHORT.repr(now),
            f"Use the same options to resume, or choose another folder.{hint}",
        )


@contextmanager
def hold_claim(path: Path, settings: dict[str, Any]) -> Iterator[None]:
    """``claim`` a folder, keep other processes out of it until the block ends, and take
    the claim back if the block has written nothing, so that the corrected call may use
    the folder.

    Raises:
        ConfigError, DataError, FileError: as ``claim`` and ``hold_writing``.
    """
    first = not path.is_file()
    claim(path, settings)
    with hold_writing(path):
        try:
            yield
        finally:
            if first and _alone(path):
                path.unlink(missing_ok=True)


@contextmanager
def hold_writing(path: Path) -> Iterator[None]:
    """Write into a claimed folder, which other processes may not do until the block ends:
    files of the whole folder are gathered from notes that the last one would remove.

    Temporary files that killed runs left are removed.

    Args:
        path: the file of the claim.

    Raises:
        ConfigError: if another process writes into the folder.
        FileError: if the claim cannot be opened for writing.
    """
    with ExitStack() as held:
        with writing(path):
            alone = held.enter_context(one_writer(path))
        if not alone:
            raise ConfigError(
                f"{path.parent}, in which another process works",
                "a folder for this process",
                "Wait for it, or choose another folder.",
            )
        for part in path.parent.rglob(".*.part"):
            part.unlink(missing_ok=True)
        yield


def _alone(path: Path) -> bool:
    """Whether there is no other file in the folder of a file, and below."""
    return not any(
        other.is_file() and other != path for other in path.parent.rglob("*")
    )
