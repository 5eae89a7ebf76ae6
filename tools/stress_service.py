"""Stress the rolling bank: kill its processes at random, and read while scans are replaced.

    python tools/stress_service.py [--kills 50] [--reads 100000] [--workers 4] [--seed 0]

A SIGKILL hits a worker, the generator or the trainer itself. Within the time limit the trainer has
to continue or to end with an error that names the dead process, without a wrong scan and without
leaving a process or a segment of shared
memory behind. Linux only: processes are counted in /proc.
"""

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
from typing import Annotated, Any

import numpy as np
import torch
from bench.untrained import write_untrained
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm
from typer import Option, run

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import LidarSynthError
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import Scan
from lidar_synth.geometry.projection import unproject
from lidar_synth.mixing.service import RollingBank

SCANS = 40
"""Different scans; their checksums are known beforehand."""

LIMIT = 60.0
"""Seconds after a kill within which everything has to be over."""


def checksum(scan: Scan) -> int:
    """CRC-32 of all arrays that a reader gets."""
    value = 0
    for array in (scan.points, *scan.fields().values()):
        value = zlib.crc32(np.ascontiguousarray(array).data, value)
    return value


def known_checksums(model: Path) -> list[int]:
    """The checksums of scans 0 .. SCANS - 1, directly from the generator."""
    generator = load_generator(model)
    encoding = Encoding(generator.sensor, generator.fields)
    images = (generator.range_images(0, [number])[0] for number in range(SCANS))
    kept = (encoding.decode(encoding.encode(image)) for image in images)
    return [checksum(unproject(image)) for image in kept]


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
        return int(checksum(self.bank[number]) != self.known[number])


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


def started(model: Path, known: list[int]) -> tuple[subprocess.Popen[str], Any]:
    """A trainer in a session of its own, and the ids of its generator and workers; none if it did
    not start."""
    call = [sys.executable, __file__, "--trainer", model, "--workers", "2"]
    trainer = subprocess.Popen(
        [*call, "--known", json.dumps(known)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert trainer.stdout is not None
    return trainer, json.loads(trainer.stdout.readline() or "{}")


def left_behind(session: int, everyone: list[int]) -> str:
    """Processes and segments of memory that are left after a while, or ""."""
    end = time.monotonic() + 15
    while (left := living(session)) and time.monotonic() < end:
        time.sleep(0.1)
    segments = [
        path.name
        for path in Path("/dev/shm").glob("*")
        if any(f"_{pid}_" in path.name for pid in everyone)
    ]
    return (
        f"processes {left} and segments {segments} are left" if left or segments else ""
    )


def expected(victim: str, target: int, code: int, output: str, errors: str) -> bool:
    """Whether a trainer ended as it should after a kill."""
    if victim == "trainer":
        return code == -signal.SIGKILL
    if victim == "generator":
        return code == 1 and f"rolling bank died (process {target}" in errors
    return code == 0 and "continued after" in output and str(target) in output


def kill_one(model: Path, known: list[int], victim: str, rng: random.Random) -> str:
    """One trainer, one kill; returns what is wrong with the outcome, or ""."""
    trainer, pids = started(model, known)
    if not pids:
        return f"the trainer did not start: {trainer.communicate()[1]}"
    everyone = living(trainer.pid)
    time.sleep(rng.random())
    targets = {"trainer": trainer.pid, "worker": rng.choice(pids["worker"])}
    target = (pids | targets)[victim]
    os.kill(target, signal.SIGKILL)
    try:
        output, errors = trainer.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(trainer.pid, signal.SIGKILL)
        return f"{victim} killed: still running after {LIMIT:g} s"
    if not expected(victim, target, trainer.returncode, output, errors):
        return f"{victim} killed: exit code {trainer.returncode}, {output} {errors}"
    left = left_behind(trainer.pid, everyone)
    return left and f"{victim} killed: {left}"


def count_torn(model: Path, known: list[int], reads: int, workers: int) -> int:
    """The number of torn or wrong scans of so many reads."""
    with RollingBank(model, slots=16, threads=1) as bank:
        batches = loader(bank, known, reads, workers)
        torn = sum(tqdm(batches, desc="reads", unit="batch"))
        print(
            f"{reads} reads by {workers} workers: {torn} torn or wrong; {bank.counts()}"
        )
    return torn


def main(
    kills: int = 50,
    reads: int = 100_000,
    workers: int = 4,
    seed: int = 0,
    trainer: Annotated[Path | None, Option(hidden=True)] = None,
    known: Annotated[str, Option(hidden=True)] = "",
) -> None:
    """Prints the outcome; exits with 1 if anything was wrong."""
    torch.set_num_threads(1)
    if trainer:
        train(trainer, json.loads(known), workers)
        return
    rng = random.Random(seed)
    victims = [("trainer", "generator", "worker")[n % 3] for n in range(kills)]
    with tempfile.TemporaryDirectory() as folder:
        model = write_untrained(Path(folder) / "untrained.safetensors")
        sums = known_checksums(model)
        order = tqdm(rng.sample(victims, kills), desc="kills", unit="kill")
        wrong = list(filter(None, (kill_one(model, sums, who, rng) for who in order)))
        print(f"{kills} kills: {len(wrong)} went wrong")
        if reads and (torn := count_torn(model, sums, reads, workers)):
            wrong.append(f"{torn} wrong reads")
    print(*wrong, sep="\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    run(main)
