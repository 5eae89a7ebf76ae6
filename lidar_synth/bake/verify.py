"""Verification of banks: whether all files are intact, and whether the scans match their seeds."""

import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from lidar_synth.bake.options import BakeJob
from lidar_synth.bake.remote import SHARD
from lidar_synth.bank import Bank, Entry, Facts, Index, ShardReader
from lidar_synth.bank.card import CARD, CROISSANT
from lidar_synth.bank.folder import BankFolder, open_folder
from lidar_synth.bank.index import SETTINGS
from lidar_synth.bank.reader import read_index
from lidar_synth.bank.storage import bank_root
from lidar_synth.errors import DataError, FileError, parsing
from lidar_synth.files.disk import sha256
from lidar_synth.geometry import RangeImage

AGREE = 0.9
"""Lowest share of cells in which a regenerated scan must agree. On the machine that made the bank
all cells agree; on others rounding changes a few ranges and labels; a scan of another seed agrees
in few cells."""

UNLISTED = "is not in the index: remove it"
"""The problem of a shard that no repair can mend."""

SIDE_FILES = CARD, CROISSANT, SETTINGS
"""The other files of a bank, which can be rewritten from the index."""

_CLOSE = 2e-3  # highest relative difference of two ranges that agree


class Problem(NamedTuple):
    """A problem of a bank.

    Args:
        file: name of the file.
        what: description of the problem.
    """

    file: str
    what: str


def verify(root: str | Path, progress: bool = True) -> list[Problem]:
    """Check every shard's presence, size and hash, its attributes against the index, and the CRC of
    every scan; then the hashes of the card and the other files that the index lists (indices of
    older versions list none). A server that lists no files is warned about: there may be other
    shards.

    Args:
        root: the bank's folder or URL.
        progress: show a bar.

    Returns:
        The problems; empty for an intact bank.

    Raises:
        FileError: if the index is missing.
        DataError: if the index is damaged or of another version.
    """
    folder = open_folder(root)
    index = read_index(bank_root(root))
    problems: list[Problem] = []
    listed: set[str] = set()
    try:
        listed.update(filter(SHARD.fullmatch, folder.sizes()))
    except FileError as error:
        warnings.warn(
            f"{error}. Shards that are not in the index were not looked for.",
            stacklevel=2,
        )
    with tqdm(
        total=sum(entry.scans for entry in index.shards),
        desc="verify",
        unit="scan",
        disable=not progress,
    ) as bar:
        for entry in index.shards:
            problems += check_shard(folder, index.sources[entry.source], entry)
            bar.update(entry.scans)
    return [
        *problems,
        *(Problem(name, UNLISTED) for name in sorted(listed - index.by_file.keys())),
        *check_side_files(folder, index),
    ]


def check_side_files(folder: BankFolder, index: Index) -> Iterator[Problem]:
    """The problems of the files beside the shards."""
    for name in filter(index.files.get, SIDE_FILES):
        try:
            actual = hashlib.sha256(folder.read(name)).hexdigest()
        except (DataError, FileError) as error:
            yield Problem(name, str(error))
            continue
        if actual != index.files[name]:
            yield Problem(
                name,
                f"has sha256 {actual[:12]}, the index lists {index.files[name][:12]}: it was "
                "damaged or edited",
            )


def check_shard(folder: BankFolder, facts: Facts, entry: Entry) -> Iterator[Problem]:
    """The problems of a shard."""
    try:
        with folder.local(entry.file, entry.bytes) as path:
            size = path.stat().st_size
            digest = sha256(path)
            if (size, digest) != (entry.bytes, entry.sha256):
                yield Problem(
                    entry.file,
                    f"has {size} bytes and sha256 {digest[:12]}, the index lists "
                    f"{entry.bytes} and {entry.sha256[:12]}",
                )
            for what in check_scans(path, facts, entry):
                yield Problem(entry.file, what)
    except OSError as error:
        yield Problem(entry.file, f"cannot be read ({error.strerror or error})")


def check_scans(path: Path, facts: Facts, entry: Entry) -> Iterator[str]:
    """Descriptions of the problems of a shard's attributes and scans."""
    try:
        with ShardReader(path, entry.file, facts, entry) as shard:
            for position in range(shard.entry.scans):
                try:
                    shard.read(position)
                except DataError as error:
                    yield str(error)
    except (DataError, FileError) as error:
        yield str(error)


def regenerate(
    root: str | Path,
    model: str | None = None,
    sample: int = 16,
    progress: bool = True,
    *,
    seed: int | None = None,
    condition: str | None = None,
) -> dict[str, float]:
    """Regenerate some scans from their seeds and compare them with the bank.

    Args:
        root: the bank's folder or URL.
        model: the checkpoint, if it is not a shipped model.
        sample: number of scans, sampled from the bank.
        progress: show a bar.
        seed: seed of the sampling, >= 0; by default every call samples others.
        condition: the dataset of the conditions, if it has moved.

    Returns:
        {id: share of cells that agree}; less than ``AGREE`` means that the scan does not belong to
        its id.

    Raises:
        ConfigError: if the checkpoint or the conditions are not those that made the scans.
        FileError, DataError: if the bank or the checkpoint cannot be read.
    """
    from lidar_synth.bake.shard import generate, load_checked, torch_threads

    bank = Bank(root)
    chosen = sorted(
        np.random.default_rng(seed)
        .choice(len(bank), min(sample, len(bank)), replace=False)
        .tolist()
    )
    shares = {}
    for number in tqdm(chosen, desc="regenerate", unit="scan", disable=not progress):
        name = bank.ids[number]
        facts = bank.facts_of(number)
        job = job_of(facts, model, condition)
        generator = load_checked(job, facts)
        with torch_threads(job.threads):
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


def job_of(
    facts: Facts, model: str | None = None, condition: str | None = None
) -> BakeJob:
    """The settings that regenerate a bank's scans, on a CPU where there is no GPU.

    Args:
        facts: facts of the bank.
        model: the checkpoint, if it is not a shipped model.
        condition: the dataset of the conditions, if it has moved.

    Raises:
        DataError: if the facts hold no valid settings.
    """
    import torch

    if facts.recorded:
        raise DataError(
            "recorded scans, which no model makes again", "a copy of the bank"
        )
    if "as_sensor" in facts.settings:
        raise DataError(
            f"scans of {facts.model!r} that were turned into scans of {facts.sensor.name!r}",
            "scans as their model made them",
            "Run lidar-synth bank as-sensor again: it makes again what is damaged. --deep checks "
            "the original bank.",
        )
    stored = {
        "compression": facts.compression,
        "layout": facts.layout,
        "fields": facts.fields,
        "condition": condition or facts.settings.get("condition"),
    }
    if not torch.cuda.is_available():
        stored["device"] = "cpu"
    with parsing(f"settings {facts.settings} of a bank", "the settings of a bake"):
        return BakeJob(**facts.settings | stored, model=model or facts.model)
