"""How large a bank of town scans is, and how fast it is written and read, on one core.

    python tools/bench/bank.py [SCAN.bin] [--scans N]

SCAN.bin is a KITTI-360 scan to compare reading with; without one, a random scan of 120,000 points. Processor time is
counted, not the clock's, so that a machine that is busy otherwise gives the same figures. The town's scans have no
confidence; one that is mostly high and falls where labels change stands in for it.
"""

import argparse
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from projection import random_points
from timing import machine, print_table, time_in_turns
from tqdm import tqdm

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Encoding, Entry, Facts, Index, ShardWriter
from lidar_synth.bank.chunks import deflate, fletcher32
from lidar_synth.files import sha256
from lidar_synth.formats.points import read_points
from lidar_synth.projection import project
from lidar_synth.scan import RangeImage, Scan
from lidar_synth.sensor import load_sensor
from lidar_synth.town import Town

SHARD = 64


def town_images(count: int) -> list[RangeImage]:
    """Range images of the town with a confidence."""
    town, rng = Town(0, load_sensor("hdl64e_kitti360"), count), np.random.default_rng(0)
    images = []
    for i in tqdm(range(count), "town", leave=False):
        image = project(town[i], channels=["reflectance", "label"])
        edge = (image.label != np.roll(image.label, 1, 1)) | (image.label != np.roll(image.label, 1, 0))
        doubt = np.where(edge, rng.beta(2, 3, edge.shape), rng.beta(1, 12, edge.shape))
        image.channels["confidence"] = ((1 - doubt) * image.mask).astype(np.float32)
        images.append(image)
    return images


def write(root: Path, images: list[RangeImage], fields: tuple[str, ...]) -> Bank:
    """A bank of the images."""
    facts = Facts(images[0].sensor, fields, "town", "", {}, "generated", "MIT", "MIT")
    entries = []
    root.mkdir()
    for first in range(0, len(images), SHARD):
        entry = Entry(f"shard-{len(entries):05d}.h5", 0, first, len(images[first : first + SHARD]))
        with ShardWriter(root / entry.file, facts, entry) as writer:
            for image in images[first : first + SHARD]:
                writer.append(image)
        path = root / entry.file
        entries.append(replace(entry, bytes=path.stat().st_size, sha256=sha256(path)))
    write_bank_files(root, Index((facts,), tuple(entries)))
    return Bank(root)


def seconds(call: Callable[[], object]) -> float:
    """Processor time of one call, of all threads."""
    start = time.process_time()
    call()
    return time.process_time() - start


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", nargs="?", type=Path, help="a .bin file")
    parser.add_argument("--scans", type=int, default=192)
    path, count = parser.parse_args().scan, parser.parse_args().scans
    images, sensor = town_images(count), load_sensor("hdl64e_kitti360")
    fields = ("reflectance", "label", "confidence")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        plain = write(root / "plain", images, fields[:2])
        took = seconds(lambda: write(root / "full", images, fields))
        full = Bank(root / "full")
        error = max(float(np.abs(full.image(i).range - image.range).max()) for i, image in enumerate(images))
        print(f"\n### Size and rate, 64 x 1024, {count} scans\n\n{machine()}\n\n| what | |\n|---|---:|")
        print(f"| range, reflectance, labels | {plain.index.size / count / 1e3:.1f} kB a scan |")
        print(f"| confidence beside them | {(full.index.size - plain.index.size) / count / 1e3:.1f} kB a scan |")
        print(f"| step of the range | {full.facts.encoding.scale * 1e3:.2f} mm |")
        print(f"| largest difference of a range | {error * 1e3:.2f} mm |")
        read = seconds(lambda: [plain.image(i) for i in range(count)])
        print(f"| read one after the other, as images | {count / read:.0f} scans/s |")
        print(f"| written by one core, with confidence | {count / took:.0f} scans/s |")

        if path is None:
            path = root / "random.bin"
            random_points(sensor).tofile(path)
        turn = iter(np.random.default_rng(0).integers(0, count, 10**6).tolist())

        def read_and_project() -> RangeImage:
            points = read_points(path)
            return project(Scan(points[:, :3], points[:, 3], sensor))

        ours = "random scan of a bank, as image"
        calls: dict[str, Callable[[], object]] = {
            ours: lambda: plain.image(next(turn)),
            "the same, as points": lambda: plain[next(turn)],
            f"{path.name}, {path.stat().st_size // 16} points, read and projected": read_and_project,
        }
        print_table("Reading", time_in_turns(calls, clock=time.process_time), ours)

    encoding, image = Encoding(sensor, fields), images[0]
    arrays = encoding.encode(image)
    packed = [deflate(values) for values in arrays.values()]
    encode, pack = "encode", "shuffle, deflate, Fletcher-32"
    stages: dict[str, Callable[[], object]] = {
        encode: lambda: encoding.encode(image),
        "CRC-32": lambda: [zlib.crc32(values.data) for values in arrays.values()],
        pack: lambda: [deflate(values) for values in arrays.values()],
        "of which Fletcher-32": lambda: [fletcher32(chunk) for chunk in packed],
        "decode": lambda: encoding.decode(arrays),
    }
    print_table("Stages of a scan with confidence", time_in_turns(stages, clock=time.process_time), pack)


if __name__ == "__main__":
    main()
