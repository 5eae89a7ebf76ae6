"""The folder of a new bank that one process writes: claimed, locked, and resumed by the same
call."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lidar_synth.bake.remote import refuse_others
from lidar_synth.files.claims import hold_claim

NOTE = ".made.json"
"""File in the bank's folder with the settings of the call that makes it; a run holds a lock on
it."""


@contextmanager
def claim_bank(out: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Claim a folder for a new bank, and keep other processes out of it until the block ends.

    The claim stays, so that the same call resumes after a kill; that of a call that wrote nothing
    is taken back. Temporary files of killed calls are removed.

    Args:
        out: the new bank's folder.
        settings: plain values that determine its content.

    Raises:
        ConfigError: on a folder that holds something else, or in which another process works.
        FileError: if it cannot be written.
    """
    if not (out / NOTE).is_file():
        refuse_others(out)
    with hold_claim(out / NOTE, settings):
        yield
