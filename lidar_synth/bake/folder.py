"""A bank's folder while it is being filled: with what, which shards are there, and the index at the end.

A shard is written beside its place and renamed when it is on the disk. Just before, its size and hash are noted in
``.lidar_synth/``; when all shards are there, ``finish`` gathers the notes in ``index.json``. A shard counts as
finished when its file has the noted hash, so that a run which is killed at any moment loses the shards it was making
and nothing else.

Several runs may fill one folder at the same time. Each is ``at_work`` there, and nothing is cleared away before the
last of them has ended.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from lidar_synth.bake.job import BakePlan, settings_of
from lidar_synth.bake.lock import alone, shared
from lidar_synth.bank import INDEX, Entry, Index
from lidar_synth.bank.card import card_files
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import read_file, sha256, write_file
from lidar_synth.formats.writer import NOTES, claim

SETTINGS = ".bake.json"
"""File in the bank's folder that says what it is being filled with; the runs that fill it hold a lock on it."""

LOGS = ".slurm"
"""Folder of the logs of Slurm's jobs, in the bank's folder until that is finished."""


def prepare(plan: BakePlan) -> None:
    """Claim the folder for the plan's settings, and clear away what killed runs left half-made.

    Raises:
        ConfigError: where it holds a bank of other settings; the message shows the difference.
        FileError: where it cannot be written.
    """
    if (plan.out / INDEX).exists() and not (plan.out / SETTINGS).exists():
        raise ConfigError(f"{plan.out} holds a bank that no bake made", "a folder of its own", "Choose another one.")
    claim(plan.out / SETTINGS, plan.settings)
    _clear_up(plan.out, finished=False)


@contextmanager
def at_work(plan: BakePlan) -> Iterator[None]:
    """While it lasts, no process clears anything away in the plan's folder.

    Raises:
        FileError: where the folder is not, or no more, the one that ``prepare`` claimed.
    """
    check_folder(plan)
    with shared(plan.out / SETTINGS):
        yield


def recorded(plan: BakePlan, number: int) -> Entry | None:
    """What was noted of a shard when it was made, in its own note or in the index."""
    wanted = plan.shards[number]
    with suppress(FileError, ValueError, TypeError):
        entry = Entry(**json.loads(read_file(_note(plan, number))))
        if replace(entry, bytes=0, sha256="") == wanted:
            return entry
    index = _index(plan.out)
    there = None if index is None else index.by_file.get(wanted.file)
    return there if there is not None and replace(there, bytes=0, sha256="") == wanted else None


def finished(plan: BakePlan, number: int) -> Entry | None:
    """The shard, if its file is there and has the hash that was noted."""
    entry = recorded(plan, number)
    if entry is None:
        return None
    path = plan.out / entry.file
    with suppress(OSError):
        if path.stat().st_size == entry.bytes and sha256(path) == entry.sha256:
            return entry
    return None


def publish(plan: BakePlan, number: int, part: Path) -> Entry:
    """Note a shard that was written beside its place, and put it there.

    Raises:
        FileError: where the folder has vanished or cannot be written.
    """
    check_folder(plan)  # before a note would make the folder again
    path = plan.out / plan.shards[number].file
    try:
        entry = replace(plan.shards[number], bytes=part.stat().st_size, sha256=sha256(part))
        write_file(_note(plan, number), json.dumps(entry.to_dict()).encode(), durable=True)
        part.replace(path)
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{path} cannot be written ({error.strerror or error})", "a folder that stays") from error
    sync_folder(plan.out)
    return entry


def finish(plan: BakePlan) -> Index | None:
    """Write index and card, if every shard is noted and there; None where some are still missing.

    Raises:
        FileError: where they cannot be written.
    """
    with at_work(plan):
        entries = []
        for number in range(len(plan.shards)):
            entry = recorded(plan, number)
            if entry is None or not (plan.out / entry.file).is_file():
                return None
            entries.append(entry)
        index, there = Index((plan.facts,), tuple(entries)), _index(plan.out)
        if there is not None and there.shards == index.shards:
            index = there  # it may know of repairs
        index = write_bank_files(plan.out, index, baked=True)
    _clear_up(plan.out, finished=True)
    return index


def write_bank_files(root: Path, index: Index, baked: bool = False) -> Index:
    """The card, for the folder of a bake its settings, and the index last: with it the bank is whole.

    Args:
        root: the bank's folder.
        index: of its shards.
        baked: whether a bake filled the folder, and may go on with it.

    Returns:
        The index, with the hashes of the other files.

    Raises:
        FileError: where they cannot be written.
    """
    files = card_files(root.resolve().name, index) | (_settings_file(root, index) if baked else {})
    for name, content in files.items():
        if not _holds(root / name, content):  # a file that is locked stays the same file
            write_file(root / name, content)
    index = replace(index, files={name: hashlib.sha256(content).hexdigest() for name, content in files.items()})
    write_file(root / INDEX, index.to_json(), durable=True)
    sync_folder(root)
    return index


def _settings_file(root: Path, index: Index) -> dict[str, bytes]:
    """The settings of the bake that fills a folder, as ``claim`` writes them. Older versions wrote another order."""
    wanted = json.dumps(settings_of(index.sources[0]), indent=1).encode()
    with suppress(FileError, ValueError, RecursionError):
        there = read_file(root / SETTINGS)
        values = json.loads(there)
        if values == json.loads(wanted) and json.dumps(values, indent=1).encode() == there:
            return {SETTINGS: there}
    return {SETTINGS: wanted}


def _holds(path: Path, content: bytes) -> bool:
    try:
        return read_file(path) == content
    except FileError:
        return False


def sync_folder(path: Path) -> None:
    """Have a folder's names on the disk, where the system can."""
    with suppress(OSError):  # Windows opens no folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_folder(plan: BakePlan) -> None:
    """Refuse a folder that is not, or no more, the one that ``prepare`` claimed.

    Raises:
        FileError: where it has vanished.
    """
    with suppress(OSError):  # a network's folder that is gone, or closed to us
        if (plan.out / SETTINGS).is_file():
            return
    raise FileError(
        f"{plan.out} has vanished or lost its {SETTINGS}",
        "the folder in which the bake began",
        "Bring it back, or run the same command to begin again.",
    )


def _clear_up(root: Path, finished: bool) -> None:
    """Remove what processes that ended left half-made, and what a finished bank does not need.

    While another process is at work there, it is left to that one.
    """
    with alone(root / SETTINGS) as nobody_else:
        if not nobody_else:
            return
        for part in root.glob(".*.part"):
            with suppress(OSError):
                part.unlink(missing_ok=True)
        for folder in (NOTES, LOGS) if finished else ():
            shutil.rmtree(root / folder, ignore_errors=True)


def _index(root: Path) -> Index | None:
    """The index that is there, if one can be read; parsed again only when its file is another one."""
    try:
        there = (root / INDEX).stat()
    except OSError:
        return None
    return _parsed(root / INDEX, there.st_ino, there.st_size, there.st_mtime_ns)


@lru_cache(maxsize=1)
def _parsed(path: Path, *version: int) -> Index | None:
    try:
        return Index.from_json(read_file(path), str(path))
    except (FileError, DataError):
        return None


def _note(plan: BakePlan, number: int) -> Path:
    return plan.out / NOTES / f"{plan.shards[number].file}.json"
