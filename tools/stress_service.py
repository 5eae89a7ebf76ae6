"""Stress the rolling bank: kill its processes at random, and read while scans are replaced.

    python tools/stress_service.py [--kills 50] [--reads 100000] [--workers 4] [--seed 0]

A SIGKILL hits a worker, the generator or the trainer itself. Within the time limit the trainer has
to continue or to end with an error that names the dead process, without a wrong scan and without
leaving a process or a segment of shared
memory behind. Linux only: processes are counted in /proc.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench.untrained import write_untrained
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import LidarSynthError
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.mixing.service import RollingBank

SCANS = 40
"""Different scans; their checksums are known beforehand."""

LIMIT = 60.0
"""Seconds after a kill within which everything has to be over."""


def checksum(image: RangeImage) -> int:
    """CRC-32 of all arrays that a reader gets."""
    value = zlib.crc32(image.range.data)
    for name in sorted(image.channels):
        value = zlib.crc32(np.ascontiguousarray(image.channels[name]).data, value)
    return value


def known_checksums(model: Path) -> list[int]:
    """The checksums of scans 0 .. SCANS - 1, directly from the generator."""
    generator = load_generator(model)
    encoding = Encoding(generator.sensor, generator.fields)
    images = (generator.range_images(0, [number])[0] for number in range(SCANS))
    return [checksum(encoding.decode(encoding.encode(image))) for image in images]


class Reads(Dataset[int]):
    """Reads in an order that soon rewrites every slot; an item is 1 if the scan was wrong."""

    def __init__(self, bank: RollingBank, known: list[int], count: int) -> None:
        rng = np.random.default_rng(0)
        self.bank = bank
        self.known = known
        self.numbers = (np.arange(count) // 40 + rng.integers(0, 8, count)) % SCANS
        bank.expect(self.numbers.tolist())

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> int:
        number = int(self.numbers[index])
        return int(checksum(self.bank.image(number)) != self.known[number])


def loader(
    bank: RollingBank, known: list[int], reads: int, workers: int
) -> DataLoader[int]:
    return DataLoader(
        Reads(bank, known, reads), batch_size=16, num_workers=workers, collate_fn=sum
    )


def train(model: Path, known: list[int], workers: int) -> None:
    """A trainer that reads without end and prints the errors that it meets."""
    bank = RollingBank(model, slots=16, threads=1, timeout=LIMIT / 3)
    for reads in (
        10**6,
        320,
    ):  # after the death of a worker the same bank serves the next loader
        batches = iter(loader(bank, known, reads, workers))
        try:
            for n, wrong in enumerate(batches):
                if wrong:
                    raise SystemExit("wrong scan")
                if n == 2 and reads > 320:
                    pids = [w.pid for w in batches._workers]  # type: ignore[attr-defined]
                    print(
                        json.dumps({"generator": bank.pid, "worker": pids}), flush=True
                    )
        except LidarSynthError as error:
            raise SystemExit(f"{type(error).__name__}: {error}") from None
        except RuntimeError as error:
            print(f"continued after: {error}".replace("\n", " "), flush=True)
            del batches
    print(json.dumps(bank.counts()), flush=True)


def living(session: int) -> list[int]:
    """The living processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(its) == session and state != "Z":
            found.append(int(stat.parent.name))
    return found


def kill_one(model: Path, known: list[int], victim: str, rng: random.Random) -> str:
    """One trainer, one kill; returns what is wrong with the outcome, or ""."""
    call = [
        sys.executable,
        __file__,
        "--trainer",
        str(model),
        "--known",
        json.dumps(known),
        "--workers",
        "2",
    ]
    trainer = subprocess.Popen(
        call,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert trainer.stdout is not None
    pids: dict[str, Any] = json.loads(trainer.stdout.readline() or "{}")
    if not pids:
        return f"the trainer did not start: {trainer.communicate()[1]}"
    everyone = living(trainer.pid)
    time.sleep(rng.random())
    target = {
        "trainer": trainer.pid,
        "generator": pids["generator"],
        "worker": rng.choice(pids["worker"]),
    }[victim]
    os.kill(target, signal.SIGKILL)
    try:
        output, errors = trainer.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(trainer.pid, signal.SIGKILL)
        return f"{victim} killed: still running after {LIMIT:g} s"
    said = {
        "trainer": trainer.returncode == -signal.SIGKILL,
        "generator": trainer.returncode == 1
        and f"rolling bank died (process {target}" in errors,
        "worker": trainer.returncode == 0
        and "went on after" in output
        and str(target) in output,
    }[victim]
    if not said:
        return f"{victim} killed: exit code {trainer.returncode}, {output} {errors}"
    end = time.monotonic() + 15
    while (left := living(trainer.pid)) and time.monotonic() < end:
        time.sleep(0.1)
    segments = [
        p.name
        for p in Path("/dev/shm").glob("*")
        if any(f"_{pid}_" in p.name for pid in everyone)
    ]
    return (
        f"{victim} killed: processes {left} and segments {segments} are left"
        if left or segments
        else ""
    )


def main() -> None:
    """Prints the outcome; exits with 1 if anything was wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--reads", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trainer", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--known", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.trainer:
        train(options.trainer, options.known, options.workers)
        return
    wrong = []
    with tempfile.TemporaryDirectory() as folder:
        model = write_untrained(Path(folder) / "untrained.safetensors")
        known = known_checksums(model)
        rng = random.Random(options.seed)
        victims = [
            ("trainer", "generator", "worker")[n % 3] for n in range(options.kills)
        ]
        for victim in tqdm(
            rng.sample(victims, len(victims)), desc="kills", unit="kill"
        ):
            if problem := kill_one(model, known, victim, rng):
                wrong.append(problem)
        print(f"{options.kills} kills: {len(wrong)} went wrong")
        if options.reads:
            with RollingBank(model, slots=16, threads=1) as bank:
                batches = tqdm(
                    loader(bank, known, options.reads, options.workers),
                    desc="reads",
                    unit="batch",
                )
                torn = sum(batches)
                print(
                    f"{options.reads} reads by {options.workers} workers: {torn} torn or wrong; "
                    f"{bank.counts()}"
                )
            wrong += [f"{torn} wrong reads"] if torn else []
    print(*wrong, sep="\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
