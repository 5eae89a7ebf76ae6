"""A bank whose scans are those of another one as another sensor would have recorded them.

Casting rays takes ten times as long as reading a scan: a bank that is used for more than one epoch
is turned once. Each cell of the target's grid keeps its nearest return; losses and noise are drawn
once for each scan.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bake.making import claim_bank
from lidar_synth.bake.verify import check_scans
from lidar_synth.bank import Bank, Entry, Facts, Index, ShardWriter
from lidar_synth.bank.folder import LocalFolder
from lidar_synth.geometry import RangeImage
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.noise import keyed_rng


def turn_bank(
    bank: Bank, out: Path, transfer: Transfer, progress: bool = True
) -> Index:
    """Write a bank with the scans of another one as the target sensor would have recorded them.

    An interrupted run resumes after its last complete shard when it is run again. Run on a complete
    bank, it makes damaged and missing shards again.

    Args:
        bank: the bank.
        out: the new bank's folder.
        transfer: to the target sensor, whose grid the new bank has.
        progress: show a bar.

    Raises:
        ConfigError: on a folder that holds something else, or in which another process works.
        DataError, FileError: if a scan cannot be read, cast or written.
    """
    with claim_bank(out, {"bank": bank.identity, "as_sensor": transfer.identity}):
        sources = tuple(
            replace(
                facts,
                sensor=transfer.target,
                settings=facts.settings | {"as_sensor": transfer.identity},
            )
            for facts in bank.index.sources
        )
        entries = []
        with tqdm(total=len(bank), unit="scan", disable=not progress) as bar:
            for number, entry in enumerate(bank.index.shards):
                entries.append(
                    _shard(bank, number, sources[entry.source], transfer, out)
                )
                bar.update(entry.kept)
        return write_bank_files(
            out, Index(sources, tuple(entries), curation=bank.index.curation)
        )


def _shard(
    bank: Bank, number: int, facts: Facts, transfer: Transfer, out: Path
) -> Entry:
    """Turn one shard, unless its file is there and intact."""
    entry = bank.index.shards[number]
    path = out / entry.file
    if not path.is_file() or next(check_scans(path, facts, entry), None) is not None:
        names = bank.shard(number).conditions(range(entry.scans))
        folder = LocalFolder(out)
        with folder.making(entry.file) as part:
            with ShardWriter(part, facts, entry, conditions=names) as writer:
                for image in _images(bank, number, transfer):
                    writer.append(image)
            folder.put(part, entry.file)
    return entry.measure(path)


def _images(bank: Bank, number: int, transfer: Transfer) -> Iterator[RangeImage]:
    """The scans of a shard on the target's grid, dropped ones too."""
    entry = bank.index.shards[number]
    shard = bank.shard(number)
    for position in range(entry.scans):
        scan = unproject(shard.encoding.decode(shard.read(position)))
        turned = transfer(
            replace(scan, id=f"{position} of {entry.file}"),
            keyed_rng(entry.seed, entry.first + position),
        )
        image = project(turned)
        image.boxes = turned.boxes
        yield image
