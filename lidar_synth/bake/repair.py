"""Repair of banks: regenerates exactly what is damaged or missing."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from lidar_synth.bake.folder import is_claimed, write_bank_files
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.making import NOTE
from lidar_synth.bake.options import BakeJob
from lidar_synth.bake.remote import SHARD
from lidar_synth.bake.shard import load_checked, write_shard
from lidar_synth.bake.verify import (
    check_scans,
    check_shard,
    check_side_files,
    job_of,
)
from lidar_synth.bank import INDEX, Entry, Facts, Index, ShardReader
from lidar_synth.bank.folder import BankFolder, open_folder
from lidar_synth.bank.index import SETTINGS
from lidar_synth.bank.reader import read_index
from lidar_synth.bank.storage import bank_root, open_storage
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import remove_file
from lidar_synth.files.lock import one_writer


def repair(
    root: str | Path,
    model: str | None = None,
    progress: bool = True,
    *,
    condition: str | None = None,
) -> dict[str, str]:
    """Regenerate damaged and missing shards, and rewrite a damaged or missing index, card or
    settings file.

    On the machine and with the versions that made the bank, the bytes are the same. Elsewhere the
    scans are equal up to rounding; the index then gets the new hashes and an entry in ``repairs``.

    Args:
        root: the bank's folder or URL.
        model: the checkpoint, if it is not a shipped model.
        progress: show a bar.
        condition: the dataset of the conditions, if it has moved.

    Returns:
        {file: what was done}; empty if the bank is intact.

    Raises:
        ConfigError: if the checkpoint or the conditions are not those that made the scans, or
            another process fills the folder.
        DataError: if too little is left to determine what the bank held.
        FileError: if a file cannot be read or written.
    """
    place = bank_root(root)
    with _working_alone(place):
        done, index, baked = _mend(place, model, condition, progress)
    # now that its settings are not open: Windows replaces no open file
    if done:
        write_bank_files(place, index, baked)
    return done


@contextmanager
def _working_alone(place: str | Path) -> Iterator[None]:
    """Keep other processes from filling a folder until the block ends; raises as ``repair``."""
    claims = (
        [place / name for name in (SETTINGS, NOTE)] if isinstance(place, Path) else []
    )
    with ExitStack() as held:
        for claim in filter(Path.is_file, claims):
            with suppress(OSError):  # read-only: nobody fills it
                if not held.enter_context(one_writer(claim)):
                    raise ConfigError(
                        f"{place}, in which another process works",
                        "a bank that none is filling",
                        "Wait for it.",
                    )
        yield


def _mend(
    place: str | Path, model: str | None, condition: str | None, progress: bool
) -> tuple[dict[str, str], Index, bool]:
    """What was done to which file, the index of the mended shards, and whether a bake made them."""
    done: dict[str, str] = {}
    folder = open_folder(place)
    for part in place.glob(".*.part") if isinstance(place, Path) else ():
        remove_file(part)
        done[part.name] = "removed: a killed repair left it"
    try:
        index = read_index(place)
        baked = SETTINGS in index.files or is_claimed(place)
    except (DataError, FileError) as error:
        index = _index_from_shards(place, folder, error)
        baked = True
        done[INDEX] = "rebuilt from the shards"
    done |= {
        file: "rewritten from the index" for file, _ in check_side_files(folder, index)
    }
    shards = list(index.shards)
    with tqdm(
        total=sum(entry.scans for entry in shards),
        desc="repair",
        unit="scan",
        disable=not progress,
    ) as bar:
        for number, entry in enumerate(shards):
            facts = index.sources[entry.source]
            if entry.sha256 and next(check_shard(folder, facts, entry), None) is None:
                bar.update(entry.scans)
                continue
            shards[number] = new = _regenerate(
                folder, facts, entry, job_of(facts, model, condition), bar.update
            )
            index = replace(index, shards=tuple(shards))
            done[entry.file] = "regenerated"
            if entry.sha256 not in ("", new.sha256):
                done[entry.file] += ", with different bytes"
                note = (
                    f"{entry.file} was regenerated with torch {torch.__version__}, with different "
                    "bytes"
                )
                index = replace(index, repairs=(*index.repairs, note))
                # now, so that a killed repair has not made it in vain
                write_bank_files(place, index, baked)
    return done, index, baked


def _regenerate(
    folder: BankFolder,
    facts: Facts,
    entry: Entry,
    job: BakeJob,
    progress: Callable[[int], object],
) -> Entry:
    """Generate a shard and replace its file."""
    with folder.making(entry.file) as part:
        write_shard(load_checked(job, facts), part, job, facts, entry, progress)
        new = entry.measure(part)
        folder.put(part, entry.file)
    return new


def _index_from_shards(
    root: str | Path, folder: BankFolder, damage: Exception
) -> Index:
    """Rebuild the lost index of a bake from its shards; an entry without a hash marks a shard to
    regenerate.

    Raises:
        DataError: if no shard can be read, or the readable ones come from different bakes.
    """
    lost = str(damage).split("; expected")[0]
    sizes = {name: n for name, n in folder.sizes().items() if SHARD.fullmatch(name)}
    found = _read_shards(root, sizes)
    if not found:
        raise DataError(
            f"{lost}, and no shard of {root} can be read", "at least one intact shard"
        ) from damage
    facts, _ = found[0]
    shards = BakePlan(root, job_of(facts), facts).shards
    if any(other != facts for other, _ in found) or {e for _, e in found} - set(shards):
        raise DataError(
            f"{lost}, and the shards of {root} are of different bakes",
            "a copy of the index",
        ) from damage
    absent = [entry.file for entry in shards if entry.file not in sizes]
    if absent and not is_claimed(root):
        # The part of a split, too, has the first shards of a bake.
        raise DataError(
            f"{lost}, and {absent[0]} is not there, nor {SETTINGS}, which a bake leaves",
            "a copy of the index",
        ) from damage
    return Index((facts,), tuple(_measured(folder, facts, e, sizes) for e in shards))


def _read_shards(root: str | Path, sizes: dict[str, int]) -> list[tuple[Facts, Entry]]:
    """Facts and entries of the shards that can be read."""
    found = []
    for name, size in sorted(sizes.items()):
        with (
            suppress(DataError, FileError),
            ShardReader(open_storage(root, name, size), name) as shard,
        ):
            found.append((shard.facts, shard.entry))
    return found


def _measured(
    folder: BankFolder, facts: Facts, entry: Entry, sizes: dict[str, int]
) -> Entry:
    """An entry with its size and hash, if its file is there and intact."""
    if entry.file in sizes:
        with folder.local(entry.file, sizes[entry.file]) as path:
            if next(check_scans(path, facts, entry), None) is None:
                return entry.measure(path)
    return entry
