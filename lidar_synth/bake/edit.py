"""New banks from existing ones: ``merge``, ``split``, ``head`` and ``drop``. Complete shards are
hard-linked, or copied where the file system has no links.

The index of a curated bank leaves out some scans of its shards. The names of these shards end in
``.curated.h5``, because they still hold the dropped scans. Every bank that is made from a curated
one is curated too.

A call that was killed is completed by the same call.
"""

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bake.making import claim_bank
from lidar_synth.bank import INDEX, Bank, Entry, Facts, Index, ShardReader, ShardWriter
from lidar_synth.bank.folder import LocalFolder, copy_shard
from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import hash_of_names, writing


def merge(banks: Sequence[Bank], out: Path, progress: bool = True) -> Index:
    """Merge banks: one bank with the scans of several, in order.

    Args:
        banks: banks with the same sensor and fields.
        out: the new bank's folder.
        progress: show a bar.

    Raises:
        ConfigError: without a bank, on banks with different sensors or fields, banks that share
            scans, or a folder that holds something else.
        FileError: if it cannot be written.
    """
    if not banks:
        raise ConfigError("no bank to merge", "at least one")
    first = banks[0].facts
    for bank in banks[1:]:
        if (bank.facts.sensor, bank.facts.fields) != (first.sensor, first.fields):
            raise ConfigError(
                f"{bank.root} holds {bank.facts.fields} of sensor {bank.sensor.grid_text()}",
                f"{first.fields} of sensor {first.sensor.grid_text()}, as {banks[0].root}",
            )
    _check_disjoint(banks)
    with _making(out, "merge", banks) as complete:
        return _write(out, complete, [(bank, 0, len(bank)) for bank in banks], progress)


def split(
    bank: Bank, parts: Mapping[Path, float], progress: bool = True
) -> dict[Path, Index]:
    """Split a bank into several with consecutive scans.

    Args:
        bank: the bank to split.
        parts: {folder: share of the scans}, in order; the shares sum to 1.
        progress: show a bar.

    Raises:
        ConfigError: on shares that do not sum to 1 or leave a part empty, or a folder that holds
            something else.
        FileError: if it cannot be written.
    """
    ends = _cut(len(bank), list(parts.values()))
    with ExitStack() as claims:
        made = {
            out: (claims.enter_context(_making(out, "split", [bank], *span)), span)
            for out, span in zip(parts, pairwise(ends), strict=True)
        }
        return {
            out: _write(out, complete, [(bank, *span)], progress)
            for out, (complete, span) in made.items()
        }


def _cut(scans: int, shares: list[float]) -> list[int]:
    """The numbers of the scans at which parts of these shares begin and end."""
    if any(not share > 0 for share in shares) or abs(sum(shares) - 1) > 1e-9:
        raise ConfigError(f"shares {shares}", "positive numbers that sum to 1")
    ends = [round(total * scans) for total in accumulate(shares, initial=0.0)]
    if any(start == stop for start, stop in pairwise(ends)):
        raise ConfigError(
            f"{scans} scans in shares {shares}", "at least one scan for each"
        )
    return ends


def head(bank: Bank, scans: int, out: Path, progress: bool = True) -> Index:
    """A new bank with the first scans of a bank.

    Raises:
        ConfigError: on more scans than the bank holds, or a folder that holds something else.
        FileError: if it cannot be written.
    """
    if not 1 <= scans <= len(bank):
        raise ConfigError(
            f"the first {scans} scans of {bank.root}", f"1 to {len(bank)}"
        )
    with _making(out, "head", [bank], scans) as complete:
        return _write(out, complete, [(bank, 0, scans)], progress)


def drop(
    bank: Bank, numbers: Iterable[int], why: str, out: Path, progress: bool = True
) -> Index:
    """A curated bank: all scans of a bank except some. Shards are linked, not rewritten; empty ones
    are omitted.

    Args:
        bank: the original bank.
        numbers: numbers of the scans to leave out, 0 <= number < len.
        why: the reason in words; it is stored in the index.
        out: the new bank's folder.
        progress: show a bar.

    Raises:
        ConfigError: if no scan is left, on a number out of range, or a folder that holds something
            else.
        FileError: if it cannot be written.
    """
    left_out = set(numbers)
    if invalid := sorted(number for number in left_out if not 0 <= number < len(bank)):
        raise ConfigError(f"scans {invalid[:8]} to leave out", f"0 to {len(bank) - 1}")
    if len(left_out) == len(bank):
        raise ConfigError(
            f"all {len(bank)} scans of {bank.root} left out ({why})",
            "a rule that leaves some",
        )
    with _making(
        out, "drop", [bank], hash_of_names(map(str, sorted(left_out))), why
    ) as complete:
        if complete:
            return Bank(out).index
        return _link_kept(bank, left_out, why, out, progress)


def _link_kept(
    bank: Bank, left_out: set[int], why: str, out: Path, progress: bool
) -> Index:
    """Write the index of a curated bank beside links to the shards of which a scan is left."""
    entries: list[Entry] = []
    shards = tqdm(bank.index.shards, desc="shards", unit="shard", disable=not progress)
    for entry, end in zip(shards, bank.index.ends, strict=True):
        start = end - entry.kept
        more = (
            entry.position(number - start)
            for number in range(start, end)
            if number in left_out
        )
        dropped = tuple(sorted({*entry.dropped, *more}))
        if len(dropped) < entry.scans:
            entries.append(
                replace(entry, file=_name(len(entries), True), dropped=dropped)
            )
            _link(bank, entry, out / entries[-1].file)
    index = replace(
        bank.index, shards=tuple(entries), curation=(*bank.index.curation, why)
    )
    return write_bank_files(out, index)


def _name(number: int, curated: bool) -> str:
    return f"shard-{number:05d}{'.curated' if curated else ''}.h5"


def _write(
    out: Path, complete: bool, parts: Sequence[tuple[Bank, int, int]], progress: bool
) -> Index:
    """Write a bank from ranges of scans (bank, first, one past the last), unless it is complete."""
    if complete:
        return Bank(out).index
    curation = tuple(
        dict.fromkeys(why for bank, _, _ in parts for why in bank.index.curation)
    )
    sources: list[Facts] = []
    entries: list[Entry] = []
    with tqdm(
        total=sum(b - a for _, a, b in parts), unit="scan", disable=not progress
    ) as bar:
        for bank, start, stop in parts:
            for number, (entry, end) in enumerate(
                zip(bank.index.shards, bank.index.ends, strict=True)
            ):
                base = end - entry.kept
                first = max(start - base, 0)
                last = min(stop - base, entry.kept)
                if first >= last:
                    continue
                facts = bank.index.sources[entry.source]
                if facts not in sources:
                    sources.append(facts)
                new = replace(
                    entry,
                    file=_name(len(entries), bool(curation)),
                    source=sources.index(facts),
                )
                entries.append(_copy_part(bank, number, new, first, last, out))
                bar.update(last - first)
    return write_bank_files(
        out, Index(tuple(sources), tuple(entries), curation=curation)
    )


def _copy_part(
    bank: Bank, number: int, entry: Entry, first: int, last: int, out: Path
) -> Entry:
    """Write the kept scans ``first`` to ``last`` - 1 of a shard as the shard ``entry.file`` of
    another bank."""
    if (first, last) == (0, entry.kept):
        _link(bank, bank.index.shards[number], out / entry.file)
        return entry
    # A file holds consecutive scans: dropped ones in between are copied too, and stay dropped.
    start = entry.position(first)
    stop = entry.position(last - 1) + 1
    dropped = tuple(
        position - start for position in entry.dropped if start <= position < stop
    )
    entry = replace(
        entry, first=entry.first + start, scans=stop - start, dropped=dropped
    )
    folder = LocalFolder(out)
    with folder.making(entry.file) as part:
        _copy_scans(bank.shard(number), range(start, stop), entry, part)
        entry = entry.measure(part)
        folder.put(part, entry.file)
    return entry


def _copy_scans(shard: ShardReader, positions: range, entry: Entry, path: Path) -> None:
    """Write scans of a shard to a new file, without decompressing them."""
    names = shard.conditions(positions)
    with ShardWriter(path, shard.facts, entry, conditions=names) as writer:
        for position in positions:
            writer.append_chunks(*shard.chunks(position))


def _link(bank: Bank, entry: Entry, path: Path) -> None:
    """Hard-link a shard; copy it where the file system has no hard links, or from a URL."""
    folder = LocalFolder(path.parent)
    with folder.making(path.name) as part:
        if isinstance(bank.root, str):
            copy_shard(bank.root, entry, part)
        else:
            _link_file(bank.root / entry.file, part)
        folder.put(part, path.name)


def _link_file(source: Path, path: Path) -> None:
    try:
        os.link(source.resolve(), path)  # the hub's cache holds relative symlinks
    except OSError:
        with writing(path):
            shutil.copyfile(source, path)


@contextmanager
def _making(out: Path, what: str, banks: Sequence[Bank], *more: Any) -> Iterator[bool]:
    """Claim the folder of a new bank, without the shards of a killed call; yields whether it is
    complete.

    Args:
        out: the folder.
        what: the operation.
        banks: those that it is made from.
        more: the operation's other arguments, plain values.
    """
    settings = {
        "made": what,
        "from": [bank.index.checksum for bank in banks],
        "arguments": more,
    }
    with claim_bank(out, settings):
        complete = (out / INDEX).is_file()
        if not complete:
            for shard in out.glob("*.h5"):
                shard.unlink()
        yield complete


def _check_disjoint(banks: Sequence[Bank]) -> None:
    """Refuse banks that share a scan: the same model, seed and index, by which scans are named."""
    taken: dict[tuple[str, int], list[tuple[Entry, str | Path]]] = {}
    for bank in banks:
        for entry in bank.index.shards:
            facts = bank.index.sources[entry.source]
            others = taken.setdefault((facts.model, entry.seed), [])
            for other, root in others:
                overlap = other.first < _end(entry) and entry.first < _end(other)
                if overlap and (both := _kept(other) & _kept(entry)):
                    raise ConfigError(
                        f"{root} and {bank.root} both hold scan {min(both)} of seed {entry.seed}",
                        "every scan only once",
                        "Bake with another --seed, or a --first after the end of the other bank.",
                    )
            others.append((entry, bank.root))


def _end(entry: Entry) -> int:
    return entry.first + entry.scans


def _kept(entry: Entry) -> set[int]:
    """The indices of the scans of a shard that are in the bank."""
    return {entry.first + entry.position(rank) for rank in range(entry.kept)}
