"""Damage a shard in many ways, one at a time; check that all damage is found and that no wrong scan
is returned.

    python tools/damage_bank.py [--model town] [--flips 1000] [--cuts 200]

Random bits are flipped and the file is truncated at random lengths. After each damage all scans are
    read twice: through
the index, and from the shard alone, without the size and hash of the index. Every scan that a
reader returns has to equal the one that was written, and ``verify`` has to find all damage. At the
end ``repair`` generates the shard again.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import check_shard
from lidar_synth.bank import Bank, ShardReader
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


def main() -> None:
    """Prints what each check found; exits with 1 on a wrong scan or on damage that no check
    found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--model", default="town", help="a shipped model or a checkpoint"
    )
    parser.add_argument("--flips", type=int, default=1000)
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the flipped bits and the lengths"
    )
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "bank"
        index = bake(
            make_plan(root, BakeJob(model=given.model, count=4, shard_size=2)),
            progress=False,
        )
        assert index is not None
        path = root / index.shards[1].file
        facts = index.sources[0]
        entry = index.shards[1]
        content = path.read_bytes()
        whole = by_index(root, 1)
        arrays = alone(path)
        bits = rng.choice(8 * len(content), given.flips, replace=False).tolist()
        lengths = rng.choice(len(content), given.cuts, replace=False).tolist()
        damaged = [("flip", flipped(content, bit)) for bit in bits] + [
            ("cut", content[:length]) for length in lengths
        ]
        counts: Counter[tuple[str, str, str]] = Counter()
        for kind, values in tqdm(damaged, unit="damage"):
            path.write_bytes(values)
            counts[
                kind, "reading the bank", attempt(lambda: by_index(root, 1), whole)
            ] += 1
            counts[
                kind, "reading the shard alone", attempt(lambda: alone(path), arrays)
            ] += 1
            found = next(check_shard(root, facts, entry), None) is not None
            counts[kind, "verify", "found" if found else "NOT FOUND"] += 1
        done = repair(root, given.model, progress=False)
        same = path.read_bytes() == content
    print(
        f"a shard of {len(content):,} bytes, {entry.scans} scans of {facts.sensor.shape}, "
        f"{facts.fields}"
    )
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
    main()
