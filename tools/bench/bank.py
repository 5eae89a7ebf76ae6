"""How large a bank of town scans is, and how fast it is written and read, on one core.

    python tools/bench/bank.py [SCAN.bin] [--scans N] [--model NAME|FILE] [--generated N]
        [--tree SHARDS]

Reading is compared with SCAN.bin, a KITTI-360 scan, or by default with a random scan of 120,000
points. The figures are processor time, so that they hardly change on a busy machine. Scans of the
town have no confidence; they get an artificial one, which is high except where labels change. The
size of a real confidence is measured on scans of the model. The last table is of random reads from
a tree of files of so many shards, each with 1,024 small scans, as a bank of a million scans has
them; only a read's overhead depends on their number.
"""

import os
import resource
import shutil
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import deflate as libdeflate
import h5py
import numpy as np
import torch
from projection import random_points, read
from timing import machine, print_table, seconds, time_in_turns
from tqdm import tqdm
from typer import Argument, run

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Encoding, Entry, Facts, Index, ShardWriter
from lidar_synth.bank.chunks import checksum, deflate, fletcher32, inflate
from lidar_synth.files.disk import sha256
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import RangeImage, Sensor, load_sensor
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.lab.town import Town

SHARD = 64
LARGE = 1024
"""Scans of a shard: of banks of the town, and of the tree of files."""
PACK = "shuffle, deflate, Fletcher-32"
"""The stage with which the others are compared."""
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
    root: Path,
    images: list[RangeImage],
    fields: tuple[str, ...],
    threads: int = 1,
    size: int = SHARD,
) -> Bank:
    """A bank of the images in shards of this size, compressed by this many threads."""
    facts = Facts(images[0].sensor, fields, "town", "", {}, "generated", "MIT", "MIT")
    entries = []
    root.mkdir()
    for first in range(0, len(images), size):
        entry = Entry(
            f"shard-{len(entries):05d}.h5", 0, first, len(images[first : first + size])
        )
        with ShardWriter(root / entry.file, facts, entry, threads=threads) as writer:
            for image in images[first : first + size]:
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
    read = partial(read_all, plain, range(count))
    error = max(
        float(np.abs(plain.image(i).range - image.range).max())
        for i, image in enumerate(images)
    )
    print(
        f"\n### Size and rate, 64 x 1024, {count} scans of the town\n\n{machine()}\n\n| what | "
        "|\n|---|---:|"
    )
    sizes(root / "full", images)
    print(f"| step of the range | {plain.facts.encoding.scale * 1e3:.2f} mm |")
    print(f"| largest error of a range | {error * 1e3:.2f} mm |")
    fastest = min(seconds(read, time.process_time) for _ in range(3))
    print(f"| read in order, as images | {count / fastest:.0f} scans/s |")
    print_writing(root, images)
    return plain


def print_writing(root: Path, images: list[RangeImage]) -> None:
    """Prints the rates of writing."""
    for fields in (FIELDS[:2], FIELDS):
        took = [
            seconds(
                partial(write, root / f"{len(fields)}-{turn}", images, fields),
                time.process_time,
            )
            for turn in range(3)
        ]
        name = ", ".join(("range", *fields))
        rate = len(images) / min(took)
        print(f"| written by one core: {name} | {rate:.0f} scans/s |")
    threads = os.cpu_count() or 1
    clock = max(
        scans_per_second(root / f"clock-{turn}", images, threads) for turn in range(3)
    )
    print(
        f"| written by one process with {threads} threads, with confidence, wall-clock time | "
        f"{clock:.0f} scans/s |"
    )


def reading(path: Path, bank: Bank) -> None:
    """Prints the cost of reading a scan from a bank, and from a point file."""
    turn = iter(np.random.default_rng(0).integers(0, len(bank), 10**6).tolist())
    shard = bank.shard(0)
    ours = "random scan of a bank, as image"
    # Without a cache every read decompresses.
    with h5py.File(bank.root / shard.entry.file, "r", rdcc_nbytes=0) as file:
        datasets = [file[name] for name in bank.facts.encoding.names]

        def by_hdf5() -> list[object]:
            position = next(turn) % shard.entry.scans
            return [dataset[position] for dataset in datasets]

        calls: dict[str, Callable[[], object]] = {
            ours: lambda: bank.image(next(turn)),
            "the same, as points": lambda: bank[next(turn)],
            "its arrays only": lambda: shard.read(next(turn) % shard.entry.scans),
            "its arrays only, by HDF5's own filters (zlib), without CRC": by_hdf5,
            f"{path.name}, {path.stat().st_size // 16} points, read and projected": (
                lambda: project(read(path, bank.sensor))
            ),
        }
        print_table("Reading", time_in_turns(calls, 200, time.process_time), ours)


def stages(image: RangeImage) -> None:
    """Prints the time of each stage of writing and reading a scan with confidence."""
    encoding = Encoding(image.sensor, FIELDS)
    arrays = encoding.encode(image)
    decoded = encoding.decode(arrays)
    calls: dict[str, Callable[[], object]] = {
        "encode": lambda: encoding.encode(image),
        "CRC-32": lambda: checksum(0, 0, arrays),
        **packing(arrays),
        **unpacking(encoding, arrays),
        "decode": lambda: encoding.decode(arrays),
        "unproject": lambda: unproject(decoded),
    }
    seconds = time_in_turns(calls, 200, time.process_time)
    print_table("Stages of a scan with confidence", seconds, PACK)


def packing(arrays: dict[str, np.ndarray]) -> dict[str, Callable[[], object]]:
    """The stages of compression."""
    planes = [
        values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
        for values in arrays.values()
    ]
    fast = partial(libdeflate.zlib_compress, compresslevel=1)
    return {
        PACK: lambda: [deflate(values) for values in arrays.values()],
        "deflate alone": lambda: [fast(plane) for plane in planes],
        "deflate by zlib": lambda: [zlib.compress(plane, 1) for plane in planes],
    }


def unpacking(
    encoding: Encoding, arrays: dict[str, np.ndarray]
) -> dict[str, Callable[[], object]]:
    """The stages of decompression."""
    kinds = encoding.arrays()
    packed = {name: deflate(values) for name, values in arrays.items()}
    bare = [chunk[:-4] for chunk in packed.values()]
    size = 1 << 17
    return {
        "Fletcher-32, inflate, unshuffle": lambda: [
            inflate(chunk, *kinds[name]) for name, chunk in packed.items()
        ],
        "inflate alone": lambda: [libdeflate.zlib_decompress(c, size) for c in bare],
        "inflate by zlib": lambda: [zlib.decompress(c, bufsize=size) for c in bare],
        "Fletcher-32 alone": lambda: [fletcher32(chunk) for chunk in packed.values()],
    }


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
    numbers = tqdm(range(shards), "shards", leave=False)
    entries = [copied(first, number, arrays) for number in numbers]
    write_bank_files(root, Index((facts,), tuple(entries)))
    return Bank(root)


def copied(first: Path, number: int, arrays: dict[str, np.ndarray]) -> Entry:
    """The entry of a copy of the first shard with the indices of another one."""
    path = first.with_name(f"shard-{number:05d}.h5")
    begin = number * LARGE
    if number:
        shutil.copyfile(first, path)
        indices = np.arange(begin, begin + LARGE, dtype=np.uint64)
        with h5py.File(path, "r+", libver="latest") as file:
            file.attrs.modify("first", indices[0])
            file["index"][:] = indices
            file["crc"][:] = [checksum(0, int(index), arrays) for index in indices]
    return Entry(path.name, 0, begin, LARGE, 0, path.stat().st_size, sha256(path))


def random_reads(root: Path, shards: int, reads: int = 20_000) -> None:
    """Prints processor time and memory of random reads by the number of shards that they are
    from."""
    tree(root, shards)
    print(f"\n### Random reads from shards of {LARGE:,} scans\n\n{machine()}\n")
    print(
        "| shards | scans | first read of a shard, ms | later reads, ms | overhead, ms | memory, "
        "MB |\n|---:|---:|---:|---:|---:|---:|"
    )
    base = 0.0
    for count in sorted({min(count, shards) for count in (1, 64, 128, 512, shards)}):
        bank = Bank(root)
        before = peak_memory()
        firsts = range(0, count * LARGE, LARGE)
        opened = seconds(partial(read_all, bank, firsts), time.process_time) / count
        order = np.random.default_rng(0).integers(0, count * LARGE, reads).tolist()
        later = seconds(partial(read_all, bank, order), time.process_time) / reads
        base = base or later
        memory = peak_memory() - before
        print(
            f"| {count:,} | {count * LARGE:,} | {1e3 * opened:.2f} | {1e3 * later:.3f} | "
            f"{1e3 * (later - base):.3f} | {memory:.0f} |",
            flush=True,
        )


def read_all(bank: Bank, order: Sequence[int]) -> None:
    """Reads scans in this order, as images."""
    for number in order:
        bank.image(number)


def peak_memory() -> float:
    """Peak memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def print_generated(root: Path, model: str, count: int) -> None:
    """Prints the sizes of scans of a model."""
    generator = load_generator(model)
    title = f"Size of {count} scans of {generator.name}"
    print(f"\n### {title}\n\n| what | |\n|---|---:|")
    numbers = tqdm(range(count), "generated", leave=False)
    sizes(root, [generator.range_images(0, [i])[0] for i in numbers])


def main(
    scan: Annotated[Path | None, Argument()] = None,
    scans: int = 192,
    model: str = "town",
    generated: int = 40,
    tree: int = 1000,
) -> None:
    """Prints the tables."""
    torch.set_num_threads(1)
    images = town_images(scans)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        plain = size_and_rate(root, images)
        path = scan or root / "random.bin"
        if scan is None:
            random_points(plain.sensor).tofile(path)
        reading(path, plain)
        stages(images[0])
        if tree:
            random_reads(root / "tree", tree)
        if generated:
            print_generated(root / "generated", model, generated)


if __name__ == "__main__":
    run(main)
