"""A bank's folder while it is being filled: with what, which shards are there, and the index at the end.

A shard is written beside its place and renamed when it is on the disk. Just before, its size and hash are noted in
``.lidar_synth/``; when all shards are there, ``finish`` gathers the notes in ``index.json``. A shard counts as
finished when its file has the noted hash, so that a run which is killed at any moment loses the shards it was making
and nothing else.
"""

import json
import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from lidar_synth.bake.job import Plan
from lidar_synth.bank import INDEX, Entry, Index
from lidar_synth.bank.card import write_card
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files import read_file, sha256, write_file
from lidar_synth.formats.writer import NOTES, claim

SETTINGS = ".bake.json"
"""File in the bank's folder that says what it is being filled with."""


def prepare(plan: Plan) -> None:
    """Claim the folder for the plan's settings.

    Raises:
        ConfigError: where it holds a bank of other settings; the message shows the difference.
        FileError: where it cannot be written.
    """
    if (plan.out / INDEX).exists() and not (plan.out / SETTINGS).exists():
        raise ConfigError(f"{plan.out} holds a bank that no bake made", "a folder of its own", "Choose another one.")
    claim(plan.out / SETTINGS, plan.settings)


def recorded(plan: Plan, number: int) -> Entry | None:
    """What was noted of a shard when it was made, in its own note or in the index."""
    wanted = plan.shards[number]
    with suppress(FileError, ValueError, TypeError):
        entry = Entry(**json.loads(read_file(_note(plan, number))))
        if replace(entry, bytes=0, sha256="") == wanted:
            return entry
    index = _index(plan)
    for entry in index.shards if index else ():
        if replace(entry, bytes=0, sha256="") == wanted:
            return entry
    return None


def finished(plan: Plan, number: int) -> Entry | None:
    """The shard, if its file is there and has the hash that was noted."""
    entry = recorded(plan, number)
    if entry is None:
        return None
    path = plan.out / entry.file
    with suppress(OSError):
        if path.stat().st_size == entry.bytes and sha256(path) == entry.sha256:
            return entry
    return None


def publish(plan: Plan, number: int, part: Path) -> Entry:
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


def finish(plan: Plan) -> Index | None:
    """Write index and card, if every shard is noted and there; None where some are still missing.

    Raises:
        FileError: where they cannot be written.
    """
    entries = []
    for number in range(len(plan.shards)):
        entry = recorded(plan, number)
        if entry is None or not (plan.out / entry.file).is_file():
            return None
        entries.append(entry)
    index, there = Index((plan.facts,), tuple(entries)), _index(plan)
    if there is not None and there.shards == index.shards:
        index = there  # it may know of repairs
    try:
        write_bank_files(plan.out, index)
    except FileError:
        # A process that ends at the same time clears this one's halves away, when it has written the same.
        if _index(plan) != index:
            raise
    for part in plan.out.glob(".*.part"):
        part.unlink(missing_ok=True)
    shutil.rmtree(plan.out / NOTES, ignore_errors=True)
    return index


def write_bank_files(root: Path, index: Index) -> None:
    """The card, and the index last: with it the bank is whole.

    Raises:
        FileError: where they cannot be written.
    """
    write_card(root, index)
    write_file(root / INDEX, index.to_json(), durable=True)
    sync_folder(root)


def sync_folder(path: Path) -> None:
    """Have a folder's names on the disk, where the system can."""
    with suppress(OSError):  # Windows opens no folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_folder(plan: Plan) -> None:
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


def _index(plan: Plan) -> Index | None:
    """The index that is there, if one can be read."""
    try:
        return Index.from_json(read_file(plan.out / INDEX), str(plan.out / INDEX))
    except (FileError, DataError):
        return None


def _note(plan: Plan, number: int) -> Path:
    return plan.out / NOTES / f"{plan.shards[number].file}.json"
