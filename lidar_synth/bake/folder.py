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
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from lidar_synth.bake import remote
from lidar_synth.bake.job import BakePlan, settings_of
from lidar_synth.bake.remote import refuse_others
from lidar_synth.bank import INDEX, Entry, Index
from lidar_synth.bank.card import card_files
from lidar_synth.bank.folder import BankFolder, open_folder
from lidar_synth.bank.index import SETTINGS
from lidar_synth.bank.reader import read_index
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.claims import compare
from lidar_synth.files.disk import read_file, sha256, sync_folder, write_file
from lidar_synth.files.lock import lock_shared, try_lock
from lidar_synth.formats.writer import NOTES

LOGS = ".slurm"
"""Folder with the logs of Slurm's jobs, in the bank's folder until the bank is finished."""


def prepare(plan: BakePlan) -> BakePlan:
    """Claim the folder for the plan's settings, and remove temporary files of killed runs.

    Returns:
        The plan as ``check_settings`` gives it.

    Raises:
        ConfigError: as ``check_settings``.
        FileError: if it cannot be written.
    """
    if not is_claimed(plan.out):
        refuse_others(plan.out)
        content = json.dumps(plan.settings, indent=1).encode()
        # Another process may write it at the same time.
        open_folder(plan.out).write(SETTINGS, content, overwrite=False)
    plan = check_settings(plan)
    if isinstance(plan.out, Path):
        _clear_up(plan.out, finished=False)
    return plan


def check_settings(plan: BakePlan) -> BakePlan:
    """Check, without writing, that the plan may fill its folder.

    Returns:
        The plan. If its conditions are those of the folder's bank, but have moved, it states the
        old place, which stands in every shard: the bytes stay the same.

    Raises:
        ConfigError: if the folder holds a bank with other settings, and the message shows the
            difference; or files that the bake would replace.
        DataError, FileError: if its settings are damaged or cannot be read.
    """
    if not is_claimed(plan.out):
        refuse_others(plan.out)
        return plan
    text = open_folder(plan.out).read(SETTINGS).decode(errors="replace")
    hint = ""
    with suppress(ValueError, LookupError, TypeError, RecursionError):
        recorded = json.loads(text)
        more = plan.job.count - recorded["count"]
        grown = {name: plan.settings[name] for name in ("count", "shard_size")}
        wanted = json.loads(json.dumps(plan.settings))
        if more > 0 and recorded | grown == wanted:
            hint = (
                " To add scans, bake another bank with --first "
                f"{plan.job.first + recorded['count']} --count {more}, then lidar-synth bank merge."
            )
        if plan.settings["condition_content"] == recorded["condition_content"]:
            plan = _with_conditions_at(plan, recorded["condition"])
    compare(text, json.loads(json.dumps(plan.settings)), plan.out, SETTINGS, hint)
    return plan


def is_claimed(root: str | Path) -> bool:
    """Whether a bake has claimed a folder or a URL."""
    if isinstance(root, str):
        return SETTINGS in open_folder(root).sizes()
    return (root / SETTINGS).is_file()


def _with_conditions_at(plan: BakePlan, path: str) -> BakePlan:
    """The plan of a bank that states another path of its conditions."""
    facts = replace(
        plan.facts,
        settings=plan.facts.settings | {"condition": path},
        condition={**(plan.facts.condition or {}), "source": path},
    )
    return replace(plan, facts=facts)


def release(plan: BakePlan) -> None:
    """Take back the claim of a folder that holds no shard and in which no other process is at
    work, so that the corrected call may use it."""
    if isinstance(plan.out, str):
        return
    # a ConfigError: there is a shard
    with try_lock(plan.out / SETTINGS) as alone, suppress(ConfigError, OSError):
        if alone:
            refuse_others(plan.out)
            (plan.out / SETTINGS).unlink()


@contextmanager
def at_work(plan: BakePlan) -> Iterator[None]:
    """Prevent all processes from removing temporary files in the plan's folder until the block
    ends.

    Raises:
        FileError: if the folder is not, or is no longer, the one that ``prepare`` claimed.
    """
    if isinstance(plan.out, str):
        yield
        return
    check_folder(plan.out)
    with lock_shared(plan.out / SETTINGS):
        yield


def find_missing(plan: BakePlan, numbers: Iterable[int]) -> list[int]:
    """The numbers of the shards that are not finished. At a URL a shard is finished that has a
    record and the size in it; ``verify`` reads it."""
    if isinstance(plan.out, str):
        there = remote.list_finished(plan, plan.out)
        return [number for number in numbers if plan.shards[number].file not in there]
    return [number for number in numbers if find_finished(plan, number) is None]


def read_record(plan: BakePlan, number: int) -> Entry | None:
    """The recorded size and hash of a shard, from its own record or from the index."""
    wanted = plan.shards[number]
    assert isinstance(plan.out, Path)
    found: list[Entry | None] = []
    with suppress(FileError, ValueError, TypeError):
        found.append(Entry(**json.loads(read_file(_note(plan.out, wanted)))))
    # afterwards: notes are removed when there is an index
    if index := find_index(plan.out):
        found.append(index.by_file.get(wanted.file))
    return next(
        (e for e in found if e and replace(e, bytes=0, sha256="") == wanted), None
    )


def find_finished(plan: BakePlan, number: int) -> Entry | None:
    """The shard, if its file exists and has the recorded hash."""
    if isinstance(plan.out, str):
        return remote.list_finished(plan, plan.out).get(plan.shards[number].file)
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
    if isinstance(plan.out, str):
        return remote.publish(plan, plan.out, number, part)
    # First, because writing the record would create a vanished folder again.
    check_folder(plan.out)
    path = plan.out / plan.shards[number].file
    try:
        entry = plan.shards[number].measure(part)
        write_file(
            _note(plan.out, entry), json.dumps(entry.to_dict()).encode(), durable=True
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
        entries = _recorded(plan)
        if len(entries) < len(plan.shards):
            return None
        index = Index((plan.facts,), tuple(entries))
        there = find_index(plan.out)
        if there is not None and there.shards == index.shards:
            index = there  # it may list repairs
        index = write_bank_files(plan.out, index, baked=True)
    if isinstance(plan.out, str):
        remote.remove_records(plan.out)
    else:
        _clear_up(plan.out, finished=True)
    return index


def _recorded(plan: BakePlan) -> list[Entry]:
    """The shards that are recorded and exist, in order."""
    if isinstance(plan.out, str):
        return list(remote.list_finished(plan, plan.out).values())
    entries = (read_record(plan, number) for number in range(len(plan.shards)))
    return [e for e in entries if e is not None and (plan.out / e.file).is_file()]


def write_bank_files(root: str | Path, index: Index, baked: bool = False) -> Index:
    """Write the card, the settings of a bake, and last the index, which completes the bank.

    Args:
        root: the bank's folder or URL.
        index: index of its shards.
        baked: whether a bake filled the folder and may resume there.

    Returns:
        The index with the hashes of the other files.

    Raises:
        FileError: if they cannot be written.
    """
    folder = open_folder(root)
    title = root.resolve().name if isinstance(root, Path) else root.rpartition("/")[2]
    files = card_files(title, index)
    if baked:
        files[SETTINGS] = _settings_file(folder, index)
    hashes = {name: hashlib.sha256(held).hexdigest() for name, held in files.items()}
    index = replace(index, files=hashes)
    for name, content in [*files.items(), (INDEX, index.to_json())]:
        # others may hold a lock on it, or the disk may be read-only
        if not _holds(folder, name, content):
            folder.write(name, content)
    return index


def _settings_file(folder: BankFolder, index: Index) -> bytes:
    """The settings file of a bake, as ``claim`` writes it; an older file with another order of keys
    is kept."""
    wanted = json.dumps(settings_of(index.sources[0]), indent=1).encode()
    with suppress(FileError, ValueError, RecursionError):
        there = folder.read(SETTINGS)
        values = json.loads(there)
        if (
            values == json.loads(wanted)
            and json.dumps(values, indent=1).encode() == there
        ):
            return there
    return wanted


def _holds(folder: BankFolder, name: str, content: bytes) -> bool:
    try:
        return folder.read(name) == content
    except FileError:
        return False


def check_folder(root: Path) -> None:
    """Refuse a folder that is not, or is no longer, the one that ``prepare`` claimed.

    Raises:
        FileError: if it has vanished.
    """
    with suppress(OSError):  # a network folder that has vanished, or without permission
        if (root / SETTINGS).is_file():
            return
    raise FileError(
        f"{root} has vanished or lost its {SETTINGS}",
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


def find_index(root: str | Path) -> Index | None:
    """The existing index, if it can be read; parsed again only after its file has changed."""
    if isinstance(root, str):
        with suppress(FileError, DataError):
            return read_index(root)
        return None
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


def _note(root: Path, entry: Entry) -> Path:
    return root / NOTES / f"{entry.file}.json"
