"""Damage a shard in many ways, one at a time; check that all damage is found and that no wrong scan
is returned.

    python tools/damage_bank.py [--model town] [--flips 1000] [--cuts 200]

Random bits are flipped and the file is truncated at random lengths. After each damage all scans are
read twice: through the index, and from the shard alone, without the size and hash of the index.
Every scan that a reader returns has to equal the one that was written, and ``verify`` has to find
all damage. At the end ``repair`` generates the shard again.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm
from typer import run

from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import check_shard
from lidar_synth.bank import Bank, ShardReader
from lidar_synth.bank.folder import LocalFolder
from lidar_synth.errors import DataError, FileError


def by_index(root: Path, number: int) -> list[bytes]:
    """The scans of a shard, read through the bank's index."""
    bank = Bank(root)
    first = bank.index.ends[number] - bank.index.shards[number].scans
    scans = [bank[i] for i in range(first, bank.index.ends[number])]
    bank.close()
    return [
        b"".join(
            a.tobytes() for a in (s.points, s.reflectance, s.label) if a is not None
        )
        for s in scans
    ]


def alone(path: Path) -> list[bytes]:
    """The arrays of a shard's scans, read from the shard alone."""
    with ShardReader(path, str(path)) as shard:
        return [
            b"".join(a.tobytes() for a in shard.read(i).values())
            for i in range(shard.entry.scans)
        ]


def attempt(read: Callable[[], list[bytes]], expected: list[bytes]) -> str:
    """The outcome of reading: one of the package's errors, equal scans, or a fault."""
    try:
        return "equal scans" if read() == expected else "WRONG SCANS"
    except (DataError, FileError):
        return "refused"


def damages(
    content: bytes, flips: int, cuts: int, seed: int
) -> Iterator[tuple[str, bytes]]:
    """The kind of each damage, and the bytes of the damaged shard."""
    rng = np.random.default_rng(seed)
    for bit in rng.choice(8 * len(content), flips, replace=False).tolist():
        yield "flip", flipped(content, bit)
    for length in rng.choice(len(content), cuts, replace=False).tolist():
        yield "cut", content[:length]


def checks(root: Path) -> dict[str, Callable[[], str]]:
    """What is done with the second shard of a bank, each with its outcome."""
    index = Bank(root).index
    entry = index.shards[1]
    path = root / entry.file
    facts = index.sources[0]
    print(
        f"a shard of {entry.bytes:,} bytes, {entry.scans} scans of {facts.sensor.shape}, "
        f"{facts.fields}"
    )
    readers = {
        "reading the bank": partial(by_index, root, 1),
        "reading the shard alone": partial(alone, path),
    }
    found = {who: partial(attempt, read, read()) for who, read in readers.items()}

    def verified() -> str:
        fault = next(check_shard(LocalFolder(root), facts, entry), None)
        return "NOT FOUND" if fault is None else "found"

    return found | {"verify": verified}


def main(
    model: str = "town", flips: int = 1000, cuts: int = 200, seed: int = 0
) -> None:
    """Prints what each check found; exits with 1 on a wrong scan or on damage that no check
    found."""
    counts: Counter[tuple[str, str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "bank"
        job = BakeJob(model=model, count=4, shard_size=2)
        bake(make_plan(root, job), progress=False)
        every = checks(root)
        path = root / Bank(root).index.shards[1].file
        content = path.read_bytes()
        damaged = damages(content, flips, cuts, seed)
        for kind, values in tqdm(damaged, total=flips + cuts, unit="damage"):
            path.write_bytes(values)
            for who, check in every.items():
                counts[kind, who, check()] += 1
        done = repair(root, model, progress=False)
        same = path.read_bytes() == content
    for (kind, who, what), count in counts.items():
        print(f"{kind:5} {who:24} {what:12} {count:6}")
    print(f"repair: {done}, {'the same bytes' if same else 'DIFFERENT BYTES'}")
    if not same or any(what.isupper() for _, _, what in counts):
        sys.exit(1)


def flipped(content: bytes, bit: int) -> bytes:
    """The bytes with one bit changed."""
    values = bytearray(content)
    values[bit // 8] ^= 1 << bit % 8
    return bytes(values)


if __name__ == "__main__":
    run(main)
