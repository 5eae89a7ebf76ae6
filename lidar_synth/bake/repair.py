"""Repair of banks: regenerates exactly what is damaged or missing."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from lidar_synth.bake.folder import SETTINGS, sync_folder, write_bank_files
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.shard import load_checked, write_shard
from lidar_synth.bake.verify import (
    check_scans,
    check_shard,
    check_side_files,
    job_of,
    read_index,
)
from lidar_synth.bank import INDEX, Entry, Facts, Index, ShardReader
from lidar_synth.errors import DataError, FileError, LidarSynthError
from lidar_synth.files.disk import part_of, sha256, unwritable


def repair(
    root: Path, model: str | None = None, progress: bool = True
) -> dict[str, str]:
    """Regenerate damaged and missing shards, and rewrite a damaged or missing index, card or
    settings file.

    On the machine and with the versions that made the bank, the bytes are the same. Elsewhere the
    scans are equal up to rounding; the index then gets the new hashes and an entry in ``repairs``.

    Args:
        root: the bank's folder.
        model: the checkpoint, if it is not a shipped model.
        progress: show a bar.

    Returns:
        {file: what was done}; empty if the bank is intact.

    Raises:
        ConfigError: if the checkpoint is not the one that made the scans.
        DataError: if too little is left to determine what the bank held.
        FileError: if a file cannot be read or written.
    """
    done: dict[str, str] = {}
    for part in root.glob(".*.part"):
        try:
            part.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(part, error) from error
        done[part.name] = "removed: a killed repair left it"
    try:
        index = read_index(root)
        baked = SETTINGS in index.files or (root / SETTINGS).is_file()
    except (DataError, FileError) as error:
        index = _index_from_shards(root, error)
        baked = True
        done[INDEX] = "rebuilt from the shards"
    done |= {
        problem.file: "rewritten from the index"
        for problem in check_side_files(root, index)
    }
    shards = list(index.shards)
    repairs = list(index.repairs)
    total = sum(entry.scans for entry in shards)
    with tqdm(total=total, desc="repair", unit="scan", disable=not progress) as bar:
        for number, entry in enumerate(shards):
            facts = index.sources[entry.source]
            if entry.sha256 and next(check_shard(root, facts, entry), None) is None:
                bar.update(entry.scans)
                continue
            shards[number] = new = _regenerate(root, facts, entry, model, bar.update)
            same = entry.sha256 in ("", new.sha256)
            done[entry.file] = "regenerated" + (
                "" if same else ", with different bytes"
            )
            if not same:
                repairs.append(
                    f"{entry.file} was regenerated with torch {torch.__version__}, with different "
                    "bytes"
                )
    if done:
        write_bank_files(
            root, replace(index, shards=tuple(shards), repairs=tuple(repairs)), baked
        )
    return done


def _regenerate(
    root: Path,
    facts: Facts,
    entry: Entry,
    model: str | None,
    progress: Callable[[int], object],
) -> Entry:
    """Generate a shard and replace its file."""
    job = job_of(facts, model)
    part = part_of(root / entry.file)
    try:
        write_shard(load_checked(job, facts), part, job, facts, entry, progress)
        new = replace(entry, bytes=part.stat().st_size, sha256=sha256(part))
        part.replace(root / entry.file)
    except OSError as error:
        if isinstance(error, LidarSynthError):
            raise
        raise FileError(
            f"{root / entry.file} cannot be written ({error.strerror})",
            "a writable folder",
        ) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    sync_folder(root)
    return new


def _index_from_shards(root: Path, damage: Exception) -> Index:
    """Rebuild the lost index of a bake from its shards; an entry without a hash marks a shard to
    regenerate.

    Raises:
        DataError: if no shard can be read, or the readable ones come from different bakes.
    """
    found: dict[str, tuple[Facts, Entry]] = {}
    for path in sorted(root.glob("*.h5")):
        with suppress(DataError, FileError), ShardReader(path, str(path)) as shard:
            found[path.name] = shard.facts, shard.entry
    if not found:
        raise DataError(
            f"{damage}, and no shard of {root} can be read", "at least one intact shard"
        ) from damage
    facts = next(iter(found.values()))[0]
    shards = BakePlan(root, job_of(facts), facts).shards
    if any(other != facts for other, _ in found.values()) or not {
        e for _, e in found.values()
    } <= set(shards):
        raise DataError(
            f"{damage}, and the shards of {root} are of different bakes",
            "a copy of the index",
        ) from damage
    absent = [entry.file for entry in shards if not (root / entry.file).exists()]
    if (
        absent and not (root / SETTINGS).is_file()
    ):  # the part of a split, too, has the first shards of a bake
        raise DataError(
            f"{damage}, and {absent[0]} is not there, nor {SETTINGS}, which a bake leaves",
            "a copy of the index",
        ) from damage
    entries = []
    for entry in shards:
        path = root / entry.file
        if entry.file in found and next(check_scans(path, facts, entry), None) is None:
            entry = replace(entry, bytes=path.stat().st_size, sha256=sha256(path))
        entries.append(entry)
    return Index((facts,), tuple(entries))
