"""How large a bank of town scans is, and how fast it is written and read, on one core.

    python tools/bench/bank.py [SCAN.bin] [--scans N] [--model NAME|FILE] [--generated N] [--tree SHARDS]

Reading is compared with SCAN.bin, a KITTI-360 scan, or by default with a random scan of 120,000
points. The figures are processor time, so that they hardly change on a busy machine. Scans of the
town have no confidence; they get an artificial one, which is high except where labels change. The
size of a real confidence is measured on scans of the model. The last table is of random reads from
a tree of files of so many shards, each with 1,024 small scans, as a bank of a million scans has
them; only a read's overhead depends on their number.
"""

import argparse
import os
import resource
import shutil
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import deflate as libdeflate
import h5py
import numpy as np
import torch
from projection import random_points
from timing import machine, print_table, time_in_turns
from tqdm import tqdm

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Encoding, Entry, Facts, Index, ShardWriter
from lidar_synth.bank.chunks import checksum, deflate, fletcher32, inflate
from lidar_synth.files.disk import sha256
from lidar_synth.formats.points import read_points
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.lab.town import Town

SHARD = 64
LARGE = 1024
"""Scans of a shard: of banks of the town, and of the tree of files."""
FIELDS = ("reflectance", "label", "confidence")


def town_images(count: int) -> list[RangeImage]:
    """Range images of the town with an artificial confidence."""
    town = Town(0, load_sensor("hdl64e_kitti360"), count)
    rng = np.random.default_rng(0)
    images = []
    for i in tqdm(range(count), "town", leave=False):
        image = project(town[i], channels=["reflectance", "label"])
        edge = (image.label != np.roll(image.label, 1, 1)) | (
            image.label != np.roll(image.label, 1, 0)
        )
        doubt = np.where(edge, rng.beta(2, 3, edge.shape), rng.beta(1, 12, edge.shape))
        image.channels["confidence"] = ((1 - doubt) * image.mask).astype(np.float32)
        images.append(image)
    return images


def write(
    root: Path, images: list[RangeImage], fields: tuple[str, ...], threads: int = 1
) -> Bank:
    """A bank of the images, compressed by this many threads."""
    facts = Facts(images[0].sensor, fields, "town", "", {}, "generated", "MIT", "MIT")
    entries = []
    root.mkdir()
    for first in range(0, len(images), SHARD):
        entry = Entry(
            f"shard-{len(entries):05d}.h5", 0, first, len(images[first : first + SHARD])
        )
        with ShardWriter(root / entry.file, facts, entry, threads=threads) as writer:
            for image in images[first : first + SHARD]:
                writer.append(image)
        path = root / entry.file
        entries.append(replace(entry, bytes=path.stat().st_size, sha256=sha256(path)))
    write_bank_files(root, Index((facts,), tuple(entries)))
    return Bank(root)


def sizes(root: Path, images: list[RangeImage]) -> None:
    """Prints the size of each array of the images in a bank."""
    bank = write(root, images, FIELDS)
    total = bank.index.size / len(images)
    with h5py.File(root / bank.index.shards[0].file) as file:
        parts = {
            name: file[name].id.get_storage_size() / len(file[name])
            for name in bank.facts.encoding.names
        }
    print(f"| all arrays | {total / 1e3:.1f} kB a scan |")
    print(
        f"| without confidence | {(total - parts['confidence']) / 1e3:.1f} kB a scan |"
    )
    for name, size in parts.items():
        print(f"| {name} | {size / 1e3:.1f} kB a scan |")


def seconds(call: Callable[[], object]) -> float:
    """Processor time of one call, of all threads."""
    start = time.process_time()
    call()
    return time.process_time() - start


def scans_per_second(root: Path, images: list[RangeImage], threads: int) -> float:
    """Scans with confidence that one process writes per second of wall-clock time, with all its
    threads."""
    start = time.perf_counter()
    write(root, images, FIELDS, threads)
    return len(images) / (time.perf_counter() - start)


def size_and_rate(root: Path, images: list[RangeImage]) -> Bank:
    """Prints the first table; returns a bank without confidence."""
    count = len(images)
    plain = write(root / "plain", images, FIELDS[:2])
    rates = {}
    for turn, fields in enumerate((FIELDS[:2], FIELDS) * 3):
        name = ", ".join(("range", *fields))
        took = seconds(partial(write, root / f"turn-{turn}", images, fields))
        rates[name] = max(rates.get(name, 0.0), count / took)
    error = max(
        float(np.abs(plain.image(i).range - image.range).max())
        for i, image in enumerate(images)
    )
    read = min(
        seconds(lambda: [plain.image(i) for i in range(count)]) for _ in range(3)
    )
    threads = os.cpu_count() or 1
    clock = max(
        scans_per_second(root / f"clock-{turn}", images, threads) for turn in range(3)
    )
    print(
        f"\n### Size and rate, 64 x 1024, {count} scans of the town\n\n{machine()}\n\n| what | "
        "|\n|---|---:|"
    )
    sizes(root / "full", images)
    print(f"| step of the range | {plain.facts.encoding.scale * 1e3:.2f} mm |")
    print(f"| largest error of a range | {error * 1e3:.2f} mm |")
    print(f"| read in order, as images | {count / read:.0f} scans/s |")
    for name, rate in rates.items():
        print(f"| written by one core: {name} | {rate:.0f} scans/s |")
    print(
        f"| written by one process with {threads} threads, with confidence, wall-clock time | "
        f"{clock:.0f} scans/s |"
    )
    return plain


def reading(path: Path, bank: Bank) -> None:
    """Prints the cost of reading a scan from a bank, and from a point file."""
    turn = iter(np.random.default_rng(0).integers(0, len(bank), 10**6).tolist())
    sensor = bank.sensor
    shard = bank.shard(0)

    def read_and_project() -> RangeImage:
        points = read_points(path)
        return project(Scan(points[:, :3], points[:, 3], sensor))

    ours = "random scan of a bank, as image"

    with h5py.File(
        bank.root / shard.entry.file, "r", rdcc_nbytes=0
    ) as file:  # no cache: every read decompresses
        datasets = [file[name] for name in bank.facts.encoding.names]

        def by_hdf5() -> list[object]:
            position = next(turn) % shard.entry.scans
            return [dataset[position] for dataset in datasets]

        calls: dict[str, Callable[[], object]] = {
            ours: lambda: bank.image(next(turn)),
            "the same, as points": lambda: bank[next(turn)],
            "its arrays only": lambda: shard.read(next(turn) % shard.entry.scans),
            "its arrays only, by HDF5's own filters (zlib), without CRC": by_hdf5,
            f"{path.name}, {path.stat().st_size // 16} points, read and projected": read_and_project,
        }
        print_table("Reading", time_in_turns(calls, 200, time.process_time), ours)


def stages(image: RangeImage) -> None:
    """Prints the time of each stage of writing and reading a scan with confidence."""
    encoding = Encoding(image.sensor, FIELDS)
    arrays = encoding.encode(image)
    kinds = encoding.arrays()
    packed = {name: deflate(values) for name, values in arrays.items()}
    decoded = encoding.decode(arrays)
    planes = [
        values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
        for values in arrays.values()
    ]
    pack = "shuffle, deflate, Fletcher-32"
    calls: dict[str, Callable[[], object]] = {
        "encode": lambda: encoding.encode(image),
        "CRC-32": lambda: checksum(0, 0, arrays),
        pack: lambda: [deflate(values) for values in arrays.values()],
        "deflate alone": lambda: [
            libdeflate.zlib_compress(plane, 1) for plane in planes
        ],
        "deflate by zlib": lambda: [zlib.compress(plane, 1) for plane in planes],
        "Fletcher-32, inflate, unshuffle": lambda: [
            inflate(c, *kinds[name]) for name, c in packed.items()
        ],
        "inflate alone": lambda: [
            libdeflate.zlib_decompress(c[:-4], 1 << 17) for c in packed.values()
        ],
        "inflate by zlib": lambda: [
            zlib.decompress(c[:-4], bufsize=1 << 17) for c in packed.values()
        ],
        "Fletcher-32 alone": lambda: [fletcher32(chunk) for chunk in packed.values()],
        "decode": lambda: encoding.decode(arrays),
        "unproject": lambda: unproject(decoded),
    }
    print_table(
        "Stages of a scan with confidence",
        time_in_turns(calls, 200, time.process_time),
        pack,
    )


def tree(root: Path, shards: int) -> Bank:
    """A bank of shards with ``LARGE`` scans each, all alike, of a small sensor: copies with other
    numbers."""
    sensor = Sensor("small", 8, 1.0, 80.0, rows=4, fov_up=3.0, fov_down=-25.0)
    facts = Facts(sensor, FIELDS[:2], "small", "", {}, "generated", "MIT", "MIT")
    rng = np.random.default_rng(0)
    values = rng.random(sensor.shape, np.float32)
    label = rng.integers(0, 19, sensor.shape, np.uint8)
    image = RangeImage(1 + 70 * values, sensor, {"reflectance": values, "label": label})
    arrays = facts.encoding.encode(image)
    root.mkdir()
    first = root / "shard-00000.h5"
    with ShardWriter(first, facts, Entry(first.name, 0, 0, LARGE)) as writer:
        for _ in range(LARGE):
            writer.append(image)
    entries = []
    for number in tqdm(range(shards), "shards", leave=False):
        path = root / f"shard-{number:05d}.h5"
        indices = np.arange(number * LARGE, (number + 1) * LARGE, dtype=np.uint64)
        if number:
            shutil.copyfile(first, path)
            with h5py.File(path, "r+", libver="latest") as file:
                file.attrs.modify("first", indices[0])
                file["index"][:] = indices
                file["crc"][:] = [checksum(0, int(index), arrays) for index in indices]
        entries.append(
            Entry(
                path.name,
                0,
                int(indices[0]),
                LARGE,
                0,
                path.stat().st_size,
                sha256(path),
            )
        )
    write_bank_files(root, Index((facts,), tuple(entries)))
    return Bank(root)


def random_reads(root: Path, shards: int, reads: int = 20_000) -> None:
    """Prints processor time and memory of random reads by the number of shards that they are
    from."""
    tree(root, shards)
    print(f"\n### Random reads from shards of {LARGE:,} scans\n\n{machine()}\n")
    print(
        "| shards | scans | first read of a shard, ms | later reads, ms | overhead, ms | memory, "
        "MB |"
    )
    print("|---:|---:|---:|---:|---:|---:|")
    base = 0.0
    for count in sorted({min(count, shards) for count in (1, 64, 128, 512, shards)}):
        bank = Bank(root)
        before = peak_memory()
        opened = (
            seconds(
                partial(read_all, bank, [number * LARGE for number in range(count)])
            )
            / count
        )
        order = np.random.default_rng(0).integers(0, count * LARGE, reads).tolist()
        later = seconds(partial(read_all, bank, order)) / reads
        base = base or later
        memory = peak_memory() - before
        values = f"{1e3 * opened:.2f} | {1e3 * later:.3f} | {1e3 * (later - base):.3f} | {memory:.0f}"
        print(f"| {count:,} | {count * LARGE:,} | {values} |", flush=True)


def read_all(bank: Bank, order: list[int]) -> None:
    """Reads scans in this order, as images."""
    for number in order:
        bank.image(number)


def peak_memory() -> float:
    """Peak memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scan", nargs="?", type=Path, help="a .bin file")
    parser.add_argument("--scans", type=int, default=192, help="scans of the town")
    parser.add_argument(
        "--model", default="town", help="a shipped model or a checkpoint"
    )
    parser.add_argument(
        "--generated",
        type=int,
        default=40,
        help="scans of the model; 0 omits that table",
    )
    parser.add_argument(
        "--tree",
        type=int,
        default=1000,
        help="shards of the tree of files; 0 omits that table",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    images = town_images(options.scans)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        plain = size_and_rate(root, images)
        path = options.scan or root / "random.bin"
        if options.scan is None:
            random_points(plain.sensor).tofile(path)
        reading(path, plain)
        stages(images[0])
        if options.tree:
            random_reads(root / "tree", options.tree)
        if options.generated:
            generator = load_generator(options.model)
            print(
                f"\n### Size of {options.generated} scans of {generator.name}\n\n| what | "
                "|\n|---|---:|"
            )
            rounds = tqdm(range(options.generated), "generated", leave=False)
            sizes(
                root / "generated", [generator.range_images(0, [i])[0] for i in rounds]
            )


if __name__ == "__main__":
    main()
