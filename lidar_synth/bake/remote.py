"""A bake into a URL.

A shard is made in a temporary folder and uploaded; then an object is written whose name is its
record: ``.lidar_synth/<file>-<bytes>-<sha256>``. So one listing tells which shards are finished.
When all are, the card and last the index are written, and the records removed.

Several bakes may fill one URL at the same time: the same settings give the same bytes. Where they
do not (on another kind of processor), a shard has two records and counts as missing.
"""

import re
from dataclasses import replace
from pathlib import Path

from lidar_synth.bake.job import BakePlan
from lidar_synth.bank import INDEX, Entry
from lidar_synth.bank.card import CARD, CROISSANT
from lidar_synth.bank.folder import RemoteFolder, open_folder
from lidar_synth.bank.reader import read_index
from lidar_synth.errors import ConfigError
from lidar_synth.formats.writer import NOTES

SHARD = re.compile(r"[^/]+\.h5")
"""The name of a shard; those of banks in folders below have a slash."""

_RECORD = re.compile(re.escape(NOTES) + r"/(.+\.h5)-(\d+)-([0-9a-f]{64})")


def refuse_others(root: str | Path) -> None:
    """Refuse a place with a bank, or with files of the names that a bank has.

    Raises:
        ConfigError: naming the file.
    """
    names = open_folder(root).sizes()
    if INDEX in names or any(map(SHARD.fullmatch, names)):
        raise ConfigError(
            f"{root} holds another bank", "an empty folder for the new one"
        )
    for name in (CARD, CROISSANT):
        if name in names:
            raise ConfigError(
                f"{root} holds a {name}, which the bank's own would replace",
                "a new or an empty folder",
            )


def list_finished(plan: BakePlan, url: str) -> dict[str, Entry]:
    """The finished shards by file name, from one listing, and from the index if there is one."""
    return _finished(plan, url, open_folder(url).sizes())


def publish(plan: BakePlan, url: str, number: int, part: Path) -> Entry:
    """Upload a shard and record it, unless another bake has; raises as ``folder.publish``."""
    folder = RemoteFolder(url)
    entry = plan.shards[number]
    sizes = folder.sizes()
    there = _finished(plan, url, sizes).get(entry.file)
    if there is not None:
        return there
    made = entry.measure(part)
    folder.remove([name for name in sizes if _shard_of(name) == entry.file])
    folder.put(part, entry.file)
    folder.write(f"{NOTES}/{made.file}-{made.bytes}-{made.sha256}", b"")
    return made


def remove_records(url: str) -> None:
    """Remove the records of a complete bank."""
    folder = RemoteFolder(url)
    folder.remove([name for name in folder.sizes() if _shard_of(name)])


def _finished(plan: BakePlan, url: str, sizes: dict[str, int]) -> dict[str, Entry]:
    found = dict(read_index(url).by_file) if INDEX in sizes else {}
    records: dict[str, list[tuple[int, str]]] = {}
    for match in filter(None, map(_RECORD.fullmatch, sizes)):
        records.setdefault(match[1], []).append((int(match[2]), match[3]))
    finished = {}
    for wanted in plan.shards:
        entry = found.get(wanted.file)
        named = records.get(wanted.file, [])
        if named:
            entry = replace(wanted, bytes=named[0][0], sha256=named[0][1])
        if entry is None or len(named) > 1:
            continue
        if sizes.get(wanted.file) == entry.bytes:
            finished[wanted.file] = entry
    return finished


def _shard_of(name: str) -> str:
    """The shard that an object records; "" if it is no record."""
    match = _RECORD.fullmatch(name)
    return match[1] if match else ""
