"""Kill commands that write (SIGKILL) at random moments, run them again, and compare with runs
without a kill.

    python tools/kill_commands.py --kills 50 [--command convert ...]

Every command is run twice without a kill, to see whether it gives the same bytes at all and how
long it takes after its imports. Then it runs in a forked process that is killed after a random part
of that time and started again, until it ends by itself. The table has the kills and the files that
differ from those of the uninterrupted run.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from bench.untrained import write_untrained
from tqdm import tqdm
from typer.testing import CliRunner

from lidar_synth.cli import app

COMMANDS = {
    "town": "town OUT --scans 6 --layout semantic_kitti --no-camera",
    "town, kitti360": "town OUT --scans 6 --layout kitti360 --no-camera",
    "convert": "convert TOWN OUT --to range",
    "convert, pcd": "convert TOWN OUT --to pcd",
    "convert, webdataset": "convert TOWN OUT --to webdataset",
    "sample": "sample OUT --model MODEL --count 12 --to npz",
    "bake": "bake OUT --model MODEL --count 24 --shard-size 3",
    "bank merge": "bank merge OUT BANK OTHER",
    "bank head": "bank head BANK OUT --count 20",
    "bank split": "bank split BANK OUT/a=0.5 OUT/b=0.5",
    "bank as-sensor": "bank as-sensor BANK OUT --sensor hdl32e",
    "curate": "curate BANK --drop range<0.0125 --out OUT",
}
"""Commands by name. OUT is the output; TOWN, MODEL, BANK and OTHER are made beforehand."""


def run(words: list[str]) -> None:
    """Run a command in this process.

    Raises:
        RuntimeError: if it fails.
    """
    result = CliRunner().invoke(app, words)
    if result.exit_code != 0:
        raise RuntimeError(f"lidar-synth {' '.join(words)}: {result.exception or result.output}")


def run_and_kill(words: list[str], seconds: float) -> bool:
    """Run a command in a child process and kill it after some seconds; returns whether it was still
    running."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        try:
            run(words)
        except BaseException as error:
            print(error, file=sys.stderr)
            os._exit(1)
        os._exit(0)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            if status != 0:
                raise RuntimeError(f"lidar-synth {' '.join(words)} failed after a kill")
            return False
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def read_files(root: Path) -> dict[str, bytes]:
    """All files of a folder by their relative paths."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def try_command(
    name: str, places: dict[str, str], out: Path, kills: int, rng: random.Random
) -> tuple[int, int, str]:
    """Kill one command repeatedly.

    Returns:
        The kills, the runs that were completed after kills, and what differed or failed ("" if
        nothing).
    """
    words = COMMANDS[name]
    for place, path in {**places, "OUT": str(out)}.items():
        words = words.replace(place, path)
    given = words.split()
    expected = []
    for _ in range(2):
        shutil.rmtree(out, ignore_errors=True)
        begin = time.monotonic()
        run_and_kill(given, 1e6)
        seconds = time.monotonic() - begin
        expected.append(read_files(out))
    if expected[0] != expected[1]:
        return 0, 0, "two runs without a kill differ"
    shutil.rmtree(out)
    done = completed = 0
    while done < kills or out.exists():
        moment = rng.uniform(0, seconds) if done < kills else 1e6
        try:
            if run_and_kill(given, moment):
                done += 1
                continue
        except RuntimeError as error:
            return done, completed, str(error)
        found = read_files(out)
        differing = sorted(n for n in expected[0] | found if expected[0].get(n) != found.get(n))
        if differing:
            return done, completed, f"differs: {', '.join(differing[:4])}"
        completed += 1
        shutil.rmtree(out)
    return done, completed, ""


def main() -> None:
    """Prints the table; exits with 1 if anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--command", action="append", choices=COMMANDS, help="repeatable [all]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    given = parser.parse_args()
    rng = random.Random(given.seed)
    failed = False
    print("| command | kills | completed runs | differs |\n|---|---:|---:|---|")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        places = {name: str(root / name.lower()) for name in ("TOWN", "BANK", "OTHER")}
        places["MODEL"] = str(write_untrained(root / "untrained.safetensors"))
        run(["town", places["TOWN"], "--scans", "12", "--layout", "semantic_kitti", "--no-camera"])
        for name, first in (("BANK", "0"), ("OTHER", "24")):
            sizes = ["--count", "24", "--shard-size", "5", "--first", first]
            run(["bake", places[name], "--model", places["MODEL"], *sizes])
        for name in tqdm(given.command or COMMANDS, unit="command"):
            kills, completed, fault = try_command(name, places, root / "out", given.kills, rng)
            tqdm.write(f"| {name} | {kills} | {completed} | {fault or 'no'} |")
            failed |= bool(fault)
    sys.exit(failed)


if __name__ == "__main__":
    main()
