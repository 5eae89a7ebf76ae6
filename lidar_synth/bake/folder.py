"""A bank's folder during a bake: its settings, its finished shards, and finally its index.

A shard is written to a temporary file, synced, and renamed. Just before, its size and hash are
recorded in ``.lidar_synth/``; when all shards exist, ``finish`` gathers the records in
``index.json``. A shard counts as finished when its file has the recorded hash. So a run that is
killed at any moment loses only the shards that it was writing.

Several runs may fill one folder at the same time. Each of them is ``at_work`` there, and temporary
files are removed only after the last one has ended.
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
from lidar_synth.bank import INDEX, Entry, Index
from lidar_synth.bank.card import CARD, CROISSANT, card_files
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import read_file, sha256, write_file
from lidar_synth.files.lock import lock_shared, try_lock
from lidar_synth.formats.writer import NOTES

SETTINGS = ".bake.json"
"""File in the bank's folder with the settings of the bake; runs that fill the folder hold a lock on
it."""

LOGS = ".slurm"
"""Folder with the logs of Slurm's jobs, in the bank's folder until the bank is finished."""


def prepare(plan: BakePlan) -> None:
    """Claim the folder for the plan's settings, and remove temporary files of killed runs.

    Raises:
        ConfigError: if it holds a bank with other settings, and the message shows the difference;
            or files that the bake would replace.
        FileError: if it cannot be written.
    """
    if not (plan.out / SETTINGS).exists():
        refuse_others(plan.out)
    claim(plan.out / SETTINGS, plan.settings)
    _clear_up(plan.out, finished=False)


def refuse_others(root: Path) -> None:
    """Refuse a folder with a bank, or with files of the names that a bank has.

    Raises:
        ConfigError: naming the file.
    """
    if (root / INDEX).exists() or any(root.glob("*.h5")):
        raise ConfigError(
            f"{root} holds another bank", "an empty folder for the new one"
        )
    for name in (CARD, CROISSANT):
        if (root / name).exists():
            raise ConfigError(
                f"{root} holds a {name}, which the bank's own would replace",
                "a new or an empty folder",
            )


@contextmanager
def at_work(plan: BakePlan) -> Iterator[None]:
    """Prevent all processes from removing temporary files in the plan's folder until the block
    ends.

    Raises:
        FileError: if the folder is not, or is no longer, the one that ``prepare`` claimed.
    """
    check_folder(plan)
    with lock_shared(plan.out / SETTINGS):
        yield


def read_record(plan: BakePlan, number: int) -> Entry | None:
    """The recorded size and hash of a shard, from its own record or from the index."""
    wanted = plan.shards[number]
    with suppress(FileError, ValueError, TypeError):
        entry = Entry(**json.loads(read_file(_note(plan, number))))
        if replace(entry, bytes=0, sha256="") == wanted:
            return entry
    index = _index(plan.out)
    there = None if index is None else index.by_file.get(wanted.file)
    return (
        there
        if there is not None and replace(there, bytes=0, sha256="") == wanted
        else None
    )


def find_finished(plan: BakePlan, number: int) -> Entry | None:
    """The shard, if its file exists and has the recorded hash."""
    entry = read_record(plan, number)
    if entry is None:
        return None
    path = plan.out / entry.file
    with suppress(OSError):
        if path.stat().st_size == entry.bytes and sha256(path) == entry.sha256:
            return entry
    return None


def publish(plan: BakePlan, number: int, part: Path) -> Entry:
    """Record a shard that was written to a temporary file, and rename the file to its final name.

    Raises:
        FileError: if the folder has vanished or cannot be written.
    """
    check_folder(
        plan
    )  # first, because writing the record would create a vanished folder again
    path = plan.out / plan.shards[number].file
    try:
        entry = replace(
            plan.shards[number], bytes=part.stat().st_size, sha256=sha256(part)
        )
        write_file(
            _note(plan, number), json.dumps(entry.to_dict()).encode(), durable=True
        )
        part.replace(path)
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(
            f"{path} cannot be written ({error.strerror or error})", "a mounted folder"
        ) from error
    sync_folder(plan.out)
    return entry


def finish(plan: BakePlan) -> Index | None:
    """Write index and card if every shard is recorded and exists; None if some are still missing.

    Raises:
        FileError: if they cannot be written.
    """
    with at_work(plan):
        entries = []
        for number in range(len(plan.shards)):
            entry = read_record(plan, number)
            if entry is None or not (plan.out / entry.file).is_file():
                return None
            entries.append(entry)
        index = Index((plan.facts,), tuple(entries))
        there = _index(plan.out)
        if there is not None and there.shards == index.shards:
            index = there  # it may list repairs
        index = write_bank_files(plan.out, index, baked=True)
    _clear_up(plan.out, finished=True)
    return index


def write_bank_files(root: Path, index: Index, baked: bool = False) -> Index:
    """Write the card, the settings of a bake, and last the index, which completes the bank.

    Args:
        root: the bank's folder.
        index: index of its shards.
        baked: whether a bake filled the folder and may resume there.

    Returns:
        The index with the hashes of the other files.

    Raises:
        FileError: if they cannot be written.
    """
    files = card_files(root.resolve().name, index) | (
        _settings_file(root, index) if baked else {}
    )
    for name, content in files.items():
        if not _holds(
            root / name, content
        ):  # do not replace a file that others hold a lock on
            write_file(root / name, content)
    index = replace(
        index,
        files={
            name: hashlib.sha256(content).hexdigest() for name, content in files.items()
        },
    )
    write_file(root / INDEX, index.to_json(), durable=True)
    sync_folder(root)
    return index


def _settings_file(root: Path, index: Index) -> dict[str, bytes]:
    """The settings file of a bake, as ``claim`` writes it; an older file with another order of keys
    is kept."""
    wanted = json.dumps(settings_of(index.sources[0]), indent=1).encode()
    with suppress(FileError, ValueError, RecursionError):
        there = read_file(root / SETTINGS)
        values = json.loads(there)
        if (
            values == json.loads(wanted)
            and json.dumps(values, indent=1).encode() == there
        ):
            return {SETTINGS: there}
    return {SETTINGS: wanted}


def _holds(path: Path, content: bytes) -> bool:
    try:
        return read_file(path) == content
    except FileError:
        return False


def sync_folder(path: Path) -> None:
    """Sync a folder's entries to the disk, where the system supports it."""
    with suppress(OSError):  # Windows cannot open folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_folder(plan: BakePlan) -> None:
    """Refuse a folder that is not, or is no longer, the one that ``prepare`` claimed.

    Raises:
        FileError: if it has vanished.
    """
    with suppress(OSError):  # a network folder that has vanished, or without permission
        if (plan.out / SETTINGS).is_file():
            return
    raise FileError(
        f"{plan.out} has vanished or lost its {SETTINGS}",
        "the folder in which the bake started",
        "Restore it, or run the same command to start over.",
    )


def _clear_up(root: Path, finished: bool) -> None:
    """Remove temporary files of processes that have ended, and everything that a finished bank does
    not need.

    While another process is at work in the folder, nothing is removed; that process does it later.
    """
    with try_lock(root / SETTINGS) as exclusive:
        if not exclusive:
            return
        for part in root.glob(".*.part"):
            with suppress(OSError):
                part.unlink(missing_ok=True)
        for folder in (NOTES, LOGS) if finished else ():
            shutil.rmtree(root / folder, ignore_errors=True)


def _index(root: Path) -> Index | None:
    """The existing index, if it can be read; parsed again only after its file has changed."""
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
