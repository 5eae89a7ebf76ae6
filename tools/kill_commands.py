"""Disturb commands that write, run them again, and compare with runs that nothing disturbed.

    python tools/kill_commands.py --kills 50 [--command convert ...]

Every command is run twice undisturbed, to see whether it gives the same bytes at all and how long
it takes after its imports. Then it runs in a forked process that is killed (SIGKILL) after a random
part of that time and started again, until it ends by itself. Likewise it runs with a limit of the
size of files (a full disk), as a user who may not write into the folder, and twice at once. A run
that cannot end has to say so by one of the package's errors; the next one has to give the bytes of
an undisturbed run.
"""

import argparse
import encodings.cp437  # noqa: F401  for zip files, where "nobody" may not read Python's folder
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import accelerate  # noqa: F401 - not in every child again
import numba
import torch.utils.tensorboard  # noqa: F401
from bench.untrained import write_untrained
from safetensors import safe_open
from typer.testing import CliRunner

import lidar_synth.bake
import lidar_synth.lab.kitti360
import lidar_synth.lab.proof
import lidar_synth.lab.train
import lidar_synth.labels.edit  # noqa: F401
from lidar_synth.cli import app
from lidar_synth.errors import LidarSynthError

COMMANDS = {
    "town": "town OUT --scans 6 --layout semantic_kitti --no-camera",
    "town, kitti360": "town OUT --scans 6 --layout kitti360 --no-camera",
    "convert": "convert TOWN OUT --to range",
    "convert, pcd": "convert TOWN OUT --to pcd",
    "convert, webdataset": "convert TOWN OUT --to webdataset",
    "sample": "sample OUT --model MODEL --count 12 --to npz",
    "bake": "bake OUT --model MODEL --count 24 --shard-size 3",
    "bake, processes": "bake OUT --model MODEL --count 16 --shard-size 1 "
    "--engine processes --workers 2",
    "bank merge": "bank merge OUT BANK OTHER",
    "bank head": "bank head BANK OUT --count 20",
    "bank split": "bank split BANK OUT/a=0.5 OUT/b=0.5",
    "bank as-sensor": "bank as-sensor BANK OUT --sensor hdl32e",
    "curate": "curate BANK --drop range<0.0125 --out OUT",
    "edit remove": "edit remove KITTI360 OUT --scan 0 --name Car",
    "repair": "repair OUT --model MODEL",
    "label kitti360": "label kitti360 KITTI360 OUT",
    "train": "train town_tiny --resume output=OUT recipe.iterations=6 recipe.batch=2 data.town=4 "
    "save_every=2 samples.every=3 samples.count=1",
    "prove": "prove TOWN --out OUT --places stretch --labelled 2 --iterations 10 --batch 1 "
    "--seeds 1 --arm pretrain --synthetic 2 --jobs 1",
}
"""Commands by name. OUT is the output; the other places are made beforehand."""

STARTS = {"repair": "DAMAGED"}
"""Commands that change a folder which exists already: the place that they begin with."""

TIMES = {
    "train": {"seconds", "checksum"},
    "prove": {
        "seconds",
        "minutes",
        "training_seconds",
        "preparation_seconds",
        "date",
        "checksum",
    },
}
"""Fields of JSON and of the metadata of tensors that differ between two undisturbed runs."""

UNCOMPARED = {"train": {"logs"}, "prove": {"index.html"}}
"""Files and folders that tell the time: TensorBoard's, and the page, which shows what
``results.json`` holds."""

DONE, FAILED, REFUSED = range(3)
"""How a run ended: well, with an exception, or with one of the package's errors."""

NOBODY = 65534
"""A user who may write nowhere."""


def run(words: list[str]) -> None:
    """Run a command in this process.

    Raises:
        LidarSynthError: if it is refused.
        RuntimeError: if it fails in another way.
    """
    result = CliRunner().invoke(app, words)
    if isinstance(result.exception, LidarSynthError):
        raise result.exception
    if result.exit_code != 0:
        raise RuntimeError(
            f"lidar-synth {' '.join(words)}: {result.exception or result.output}"
        )


def start(words: list[str], limit: Callable[[], object] = lambda: None) -> int:
    """Run a command in a child process, which ``limit`` limits before; the process."""
    child = os.fork()
    if child == 0:
        ended = DONE
        try:
            os.setpgid(0, 0)
            limit()
            run(words)
        except LidarSynthError as error:
            print(error, file=sys.stderr)
            ended = REFUSED
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
            ended = FAILED
        os._exit(ended)
    with suppress(OSError):  # the child may have done it, or have ended
        os.setpgid(child, child)
    return child


def wait(child: int) -> int:
    """How a child ended."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def kill(child: int, seconds: float) -> int | None:
    """Kill a child after some seconds; None, or how it ended before."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def read_files(root: Path, name: str) -> dict[str, Any]:
    """What is compared of the files that a command wrote, by their relative paths."""
    times = TIMES.get(name, set())
    found = {}
    for path in root.rglob("*"):
        inside = path.relative_to(root)
        if path.is_file() and UNCOMPARED.get(name, set()).isdisjoint(inside.parts):
            found[inside.as_posix()] = read_content(path, times)
    return found


def read_content(path: Path, times: set[str]) -> Any:
    """The bytes of a file, or its values without the fields ``times``."""
    if times and path.suffix == ".safetensors":
        with safe_open(path, "np") as file:
            tensors = {key: file.get_tensor(key).tobytes() for key in file.keys()}  # noqa: SIM118
            return tensors, without(file.metadata(), times)
    if times and (path.suffix == ".json" or path.name == "complete"):
        return without(json.loads(path.read_bytes()), times)
    return path.read_bytes()


def without(value: Any, names: set[str]) -> Any:
    """A value of JSON without the fields of these names, at any depth."""
    if isinstance(value, dict):
        return {k: without(v, names) for k, v in value.items() if k not in names}
    if isinstance(value, list):
        return [without(part, names) for part in value]
    return value


class Trial:
    """A command and its undisturbed result.

    Args:
        name: a key of ``COMMANDS``.
        places: {name of a place: path}.
        out: the output.

    Raises:
        RuntimeError: if two undisturbed runs fail or differ.
    """

    def __init__(self, name: str, places: dict[str, str], out: Path) -> None:
        words = COMMANDS[name]
        for place, path in {**places, "OUT": str(out)}.items():
            words = words.replace(place, path)
        self.name = name
        self.words = words.split()
        self.out = out
        self.begins_with = places.get(STARTS.get(name, ""))
        self.expected: dict[str, Any] = {}
        self.clear()
        begin = time.monotonic()
        if wait(start(self.words)) != DONE:
            raise RuntimeError("an undisturbed run fails")
        self.seconds = time.monotonic() - begin
        self.expected = read_files(out, name)
        self.largest = max(path.stat().st_size for path in out.rglob("*"))
        self.clear()
        self.complete("an undisturbed run")

    def clear(self) -> None:
        """Put the output back into the state before the command."""
        shutil.rmtree(self.out, ignore_errors=True)
        if self.begins_with is not None:
            shutil.copytree(self.begins_with, self.out)

    def complete(self, after: str) -> None:
        """Run the command to its end, compare, and clear.

        Raises:
            RuntimeError: if it fails, or a file differs.
        """
        if wait(start(self.words)) != DONE:
            raise RuntimeError(f"fails after {after}")
        found = read_files(self.out, self.name)
        names = sorted(self.expected.keys() | found.keys())
        differing = [n for n in names if self.expected.get(n) != found.get(n)]
        if differing:
            raise RuntimeError(f"differs after {after}: {', '.join(differing[:4])}")
        self.clear()


def kill_often(trial: Trial, kills: int, rng: random.Random) -> None:
    """Kill a command at random moments; a run that ends before is compared."""
    done = 0
    while done < kills:
        ended = kill(start(trial.words), rng.uniform(0, trial.seconds))
        if ended is None:
            done += 1
            continue
        if ended != DONE:
            raise RuntimeError("fails after a kill")
        trial.complete("a kill")
    trial.complete("a kill")


def fill_disk(trial: Trial, times: int, rng: random.Random) -> None:
    """Run a command where no file may be larger than a part of the largest one."""
    largest = trial.largest
    for _ in range(times):
        size = int(largest * rng.random())
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
        limited = start(trial.words, limit)
        if wait(limited) == FAILED:
            raise RuntimeError("a foreign error on a full disk")
        trial.complete("a full disk")


def become_nobody(cache: Path) -> None:
    """Give up the right to write anywhere but in ``cache``, where numba keeps what it compiles."""
    setattr(numba.config, "CACHE_DIR", str(cache))  # noqa: B010 - no attribute for mypy
    os.setuid(NOBODY)


def forbid_writing(trial: Trial, times: int, rng: random.Random) -> None:
    """Run a command as a user who may not write into the folder, from the beginning or midway."""
    cache = trial.out.with_name("numba")
    cache.mkdir(exist_ok=True)
    cache.chmod(0o777)
    for i in range(times):
        if i % 2:
            kill(start(trial.words), rng.uniform(0, trial.seconds))
        if wait(start(trial.words, partial(become_nobody, cache))) == FAILED:
            raise RuntimeError("a foreign error in a read-only folder")
        trial.complete("a read-only folder")


def run_twice(trial: Trial, times: int, rng: random.Random) -> None:
    """Run a command twice at once, the second a moment later."""
    for _ in range(times):
        first = start(trial.words)
        time.sleep(rng.uniform(0, trial.seconds / 2))
        second = start(trial.words)
        if FAILED in (wait(first), wait(second)):
            raise RuntimeError("a foreign error of one of two writers")
        trial.complete("two writers at once")


DISTURBANCES: dict[str, Callable[[Trial, int, random.Random], None]] = {
    "kills": kill_often,
    "full disk": fill_disk,
    "read-only": forbid_writing,
    "two writers": run_twice,
}


def make(command: str) -> None:
    """Run a command in a child, too: a process that has threads cannot be forked safely."""
    if wait(start(command.split())) != DONE:
        raise RuntimeError(f"lidar-synth {command} fails")


def make_places(root: Path) -> dict[str, str]:
    """What the commands read, by name; of every user, for those who may not write."""
    root.chmod(0o755)
    places = {name: f"{root}/{name}" for name in ("TOWN", "KITTI360", "BANK", "OTHER")}
    # A bank's card has the name of its folder.
    places["DAMAGED"] = f"{root}/damaged/out"
    places["MODEL"] = str(write_untrained(root / "untrained.safetensors"))
    for name, options in (
        ("TOWN", "--layout semantic_kitti --scans 12"),
        ("KITTI360", "--layout kitti360 --accumulate --scans 6"),
    ):
        make(f"town {places[name]} --no-camera {options}")
    for name, first in (("BANK", 0), ("OTHER", 24), ("DAMAGED", 0)):
        sizes = f"--count 24 --shard-size 5 --first {first}"
        make(f"bake {places[name]} --model {places['MODEL']} {sizes}")
    for shard in sorted(Path(places["DAMAGED"]).glob("*.h5"))[1:4]:
        shard.unlink()
    return places


def main() -> None:
    """Prints the table; exits with 1 if anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument(
        "--times", type=int, default=4, help="of each other disturbance"
    )
    parser.add_argument(
        "--command", action="append", choices=COMMANDS, help="repeatable [all]"
    )
    given = parser.parse_args()
    rng = random.Random(0)
    failed = False
    print(
        f"| command | {' | '.join(DISTURBANCES)} |\n|---|{'---:|' * len(DISTURBANCES)}"
    )
    with tempfile.TemporaryDirectory() as folder:
        places = make_places(Path(folder))
        for name in given.command or COMMANDS:
            cells = []
            for disturbance, disturb in DISTURBANCES.items():
                times = given.kills if disturbance == "kills" else given.times
                try:
                    disturb(Trial(name, places, Path(folder) / "out"), times, rng)
                    cells.append(f"{times}")
                except RuntimeError as error:
                    cells.append(str(error))
                    failed = True
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
