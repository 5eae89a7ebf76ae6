"""Whether a bank is whole, and whether its scans are what they say they are."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lidar_synth.bake.folder import SETTINGS
from lidar_synth.bake.options import BakeJob
from lidar_synth.bake.shard import generate, load_checked, one_computer
from lidar_synth.bank import INDEX, Bank, Entry, Facts, Index, ShardReader
from lidar_synth.bank.card import CARD, CROISSANT
from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import read_file, sha256
from lidar_synth.geometry.scan import RangeImage

AGREE = 0.9
"""Share of cells in which a scan that is generated again has to agree. On the machine that made it all do; elsewhere
rounding moves a few ranges and flips a label here and there; a scan of another seed agrees in few."""

SIDE_FILES = CARD, CROISSANT, SETTINGS
"""What stands beside the shards and the index, and can be written again from the index."""

_CLOSE = 2e-3  # relative difference of two ranges that agree


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a bank.

    Args:
        file: its name.
        what: what is wrong with it, in words.
    """

    file: str
    what: str


def verify(root: Path, progress: bool = True) -> list[Problem]:
    """Check every shard's presence, size and hash, its attributes against the index, and the CRC of every scan; then
    the hashes of the card and the other files that the index names (older versions named none).

    Args:
        root: the bank's folder.
        progress: show a bar.

    Returns:
        What is wrong; empty for a bank that is whole.

    Raises:
        FileError: where there is no index.
        DataError: where the index is damaged or of another version.
    """
    index = read_index(root)
    problems = []
    total = sum(entry.scans for entry in index.shards)
    with tqdm(total=total, desc="verify", unit="scan", disable=not progress) as bar:
        for entry in index.shards:
            problems += [Problem(entry.file, what) for what in check_shard(root, index.sources[entry.source], entry)]
            bar.update(entry.scans)
    known = {entry.file for entry in index.shards}
    foreign = sorted(path.name for path in root.glob("*.h5") if path.name not in known)
    return problems + [Problem(name, "is not in the index") for name in foreign] + check_side_files(root, index)


def check_side_files(root: Path, index: Index) -> list[Problem]:
    """What is wrong with the files beside the shards."""
    problems = []
    for name in filter(index.files.get, SIDE_FILES):
        try:
            found = sha256(root / name)
        except OSError as error:
            problems.append(Problem(name, f"cannot be read ({error.strerror or error})"))
            continue
        if found != index.files[name]:
            what = f"has sha256 {found[:12]}, by the index {index.files[name][:12]}: it is damaged, or was edited"
            problems.append(Problem(name, what))
    return problems


def check_shard(root: Path, facts: Facts, entry: Entry) -> Iterator[str]:
    """What is wrong with a shard, in words."""
    path = root / entry.file
    try:
        size, found = path.stat().st_size, sha256(path)
    except OSError as error:
        yield f"cannot be read ({error.strerror or error})"
        return
    if (size, found) != (entry.bytes, entry.sha256):
        yield f"has {size} bytes and sha256 {found[:12]}, by the index {entry.bytes} and {entry.sha256[:12]}"
    yield from check_scans(path, facts, entry)


def check_scans(path: Path, facts: Facts | None, entry: Entry | None) -> Iterator[str]:
    """What is wrong with a shard's attributes and scans, in words."""
    try:
        with ShardReader(path, str(path), facts, entry) as shard:
            for position in range(shard.entry.scans):
                try:
                    shard.read(position)
                except DataError as error:
                    yield str(error)
    except (DataError, FileError) as error:
        yield str(error)


def regenerate(
    root: Path, model: str | None = None, sample: int = 16, progress: bool = True, *, seed: int | None = None
) -> dict[str, float]:
    """Generate some scans again, from their seeds, and compare.

    Args:
        root: the bank's folder.
        model: the checkpoint, where it is not a shipped one.
        sample: how many scans, drawn from the bank.
        progress: show a bar.
        seed: of the draw, >= 0; by default every call draws others.

    Returns:
        {id: share of cells that agree}; less than ``AGREE`` means that the scan is not what its id says.

    Raises:
        ConfigError: where the checkpoint is not the one that made the scans.
        FileError, DataError: where bank or checkpoint cannot be read.
    """
    bank = Bank(root)
    chosen = sorted(np.random.default_rng(seed).choice(len(bank), min(sample, len(bank)), replace=False).tolist())
    shares = {}
    for number in tqdm(chosen, desc="generate again", unit="scan", disable=not progress):
        name = bank.ids[number]
        facts = bank.facts_of(number)
        job = job_of(facts, model)
        generator = load_checked(job, facts)
        with one_computer(job.threads):
            index = int(name.rpartition("/")[2])
            [again] = generate(generator, job, [index])
        shares[name] = agreement(bank.image(number), again)
    return shares


def agreement(one: RangeImage, other: RangeImage) -> float:
    """Share of cells in which two images have the same range, to 0.2 %, and the same label."""
    step = one.sensor.range_max / 65535
    same = np.abs(one.range - other.range) <= np.maximum(one.range * _CLOSE, 2 * step)
    same &= one.mask == other.mask
    if one.label is not None and other.label is not None:
        same &= one.label == other.label
    return float(same.mean())


def job_of(facts: Facts, model: str | None = None) -> BakeJob:
    """The settings with which a bank's scans can be made again.

    Args:
        facts: of the bank.
        model: the checkpoint, where it is not a shipped one.

    Raises:
        DataError: where the facts do not tell them.
    """
    told = {"compression": facts.compression, "layout": facts.layout, "fields": facts.fields}
    try:
        return BakeJob(**facts.settings | told, model=model or facts.model)
    except (ValueError, TypeError) as error:
        raise DataError(f"settings {facts.settings} of a bank", "those of a bake") from error


def read_index(root: Path) -> Index:
    """The index of a bank on disk.

    Raises:
        FileError: where there is none.
        DataError: where it is damaged or of another version.
    """
    return Index.from_json(read_file(root / INDEX), str(root / INDEX))
