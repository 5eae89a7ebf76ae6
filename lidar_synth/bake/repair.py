"""Making again exactly what is damaged or missing in a bank."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from lidar_synth.bake.folder import SETTINGS, sync_folder, write_bank_files
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.shard import load_checked, write_shard
from lidar_synth.bake.verify import check_scans, check_shard, check_side_files, job_of, read_index
from lidar_synth.bank import INDEX, Entry, Facts, Index, ShardReader
from lidar_synth.errors import DataError, FileError, LidarSynthError
from lidar_synth.files.disk import part_of, sha256


def repair(root: Path, model: str | None = None, progress: bool = True) -> dict[str, str]:
    """Generate damaged and missing shards again; write anew what is damaged or missing of the index and of the files
    that follow from it: the card, and the settings of the bake.

    On the machine and with the versions that made the bank, the bytes are the same. Elsewhere the scans are equal to
    rounding; the index then gets the new hashes, and the fact.

    Args:
        root: the bank's folder.
        model: the checkpoint, where it is not a shipped one.
        progress: show a bar.

    Returns:
        {file: what was done}; empty where all was whole.

    Raises:
        ConfigError: where the checkpoint is not the one that made the scans.
        DataError: where too little is left to tell what was there.
        FileError: where something cannot be read or written.
    """
    done: dict[str, str] = {}
    try:
        index = read_index(root)
        baked = SETTINGS in index.files or (root / SETTINGS).is_file()
    except (DataError, FileError) as error:
        index, baked = _index_from_shards(root, error), True
        done[INDEX] = "written again from the shards"
    done |= {problem.file: "written again from the index" for problem in check_side_files(root, index)}
    shards, repairs = list(index.shards), list(index.repairs)
    total = sum(entry.scans for entry in shards)
    with tqdm(total=total, desc="repair", unit="scan", disable=not progress) as bar:
        for number, entry in enumerate(shards):
            facts = index.sources[entry.source]
            if entry.sha256 and next(check_shard(root, facts, entry), None) is None:
                bar.update(entry.scans)
                continue
            shards[number] = made = _make_again(root, facts, entry, model, bar.update)
            same = entry.sha256 in ("", made.sha256)
            done[entry.file] = "made again" + ("" if same else ", with other bytes")
            if not same:
                repairs.append(f"{entry.file} was made again with torch {torch.__version__}, with other bytes")
    if done:
        write_bank_files(root, replace(index, shards=tuple(shards), repairs=tuple(repairs)), baked)
    return done


def _make_again(root: Path, facts: Facts, entry: Entry, model: str | None, progress: Callable[[int], object]) -> Entry:
    """Generate a shard and put it in its place."""
    job = job_of(facts, model)
    part = part_of(root / entry.file)
    try:
        write_shard(load_checked(job, facts), part, job, facts, entry, progress)
        made = replace(entry, bytes=part.stat().st_size, sha256=sha256(part))
        part.replace(root / entry.file)
    except OSError as error:
        if isinstance(error, LidarSynthError):
            raise
        raise FileError(f"{root / entry.file} cannot be written ({error.strerror})", "a folder to write to") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    sync_folder(root)
    return made


def _index_from_shards(root: Path, damage: Exception) -> Index:
    """The index of a bake whose own is lost, by what its shards say; a shard without a hash is to be made again.

    Raises:
        DataError: where no shard can be read, or those that can are not one bake's.
    """
    found: dict[str, tuple[Facts, Entry]] = {}
    for path in sorted(root.glob("*.h5")):
        with suppress(DataError, FileError), ShardReader(path, str(path)) as shard:
            found[path.name] = shard.facts, shard.entry
    if not found:
        raise DataError(f"{damage}, and no shard of {root} can be read", "at least one") from damage
    facts = next(iter(found.values()))[0]
    shards = BakePlan(root, job_of(facts), facts).shards
    if any(other != facts for other, _ in found.values()) or not {e for _, e in found.values()} <= set(shards):
        raise DataError(f"{damage}, and the shards of {root} are not one bake's", "a copy of the index") from damage
    entries = []
    for entry in shards:
        path = root / entry.file
        if entry.file in found and next(check_scans(path, facts, entry), None) is None:
            entry = replace(entry, bytes=path.stat().st_size, sha256=sha256(path))
        entries.append(entry)
    return Index((facts,), tuple(entries))
