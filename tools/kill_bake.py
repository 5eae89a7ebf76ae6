"""Kill a bake at random moments, many times, and check that the finished bank has the same bytes.

    python tools/kill_bake.py --kills 100 [--engine processes] [--model town]

First a bank is baked without interruption. Then the same bake runs in its own process group, which
is killed (SIGKILL) after a random fraction of the time of a complete run, and is started again.
Whenever a bake finishes, its files are compared and the next bank begins. By default the model is a
fast one with random weights, because the test is about writing.
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

from lidar_synth.bake import BakeJob, BakePlan, Resources, bake, make_plan
from lidar_synth.bake.verify import verify
from lidar_synth.bank import INDEX


def start(plan: BakePlan, engine: str, workers: int) -> int:
    """Bake in a child process with its own process group; returns its id."""
    child = os.fork()
    if child:
        # In the parent too: the child may be killed before it sets its group itself.
        os.setpgid(child, child)
        return child
    os.setpgid(0, 0)
    try:
        bake(plan, engine, Resources(workers), progress=False)
    except BaseException as error:
        print(error, file=sys.stderr)
        os._exit(1)
    os._exit(0)


def killed(child: int, seconds: float) -> bool:
    """Wait, then kill the child's group; returns whether it was still running."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            assert status == 0, f"the bake failed with status {status}"
            return False
        time.sleep(0.002)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def files(root: Path) -> dict[str, bytes]:
    """All files of a bank, including those of an unfinished bake."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file()
    }


def main() -> None:
    """Repeats until the number of kills is reached; exits with 1 if bytes differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", help="a shipped model or a checkpoint")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--shard-size", type=int, default=4)
    parser.add_argument("--engine", default="local")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    given = parser.parse_args()
    rng = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        model = given.model or str(
            write_untrained(Path(folder) / "untrained.safetensors")
        )
        job = BakeJob(model=model, count=given.count, shard_size=given.shard_size)
        whole, plan = (
            make_plan(Path(folder) / name / "bank", job) for name in ("whole", "killed")
        )
        assert not killed(start(whole, "local", 1), 1e6)
        begin = time.monotonic()
        assert not killed(start(plan, given.engine, given.workers), 1e6)
        seconds = time.monotonic() - begin
        expected = files(whole.out)
        out = plan.out
        assert files(out) == expected, "the engine writes other bytes"
        shutil.rmtree(out)
        kills = banks = 0
        with tqdm(total=given.kills, unit="kill") as bar:
            while kills < given.kills or out.exists():
                moment = rng.uniform(0, seconds) if kills < given.kills else 1e6
                if killed(start(plan, given.engine, given.workers), moment):
                    kills += 1
                    bar.update()
                elif (out / INDEX).exists():
                    assert verify(out, progress=False) == []
                    if files(out) != expected:
                        sys.exit(
                            f"bank {banks} after {kills} kills has other bytes than one baked "
                            "without a kill"
                        )
                    banks += 1
                    shutil.rmtree(out)
        print(
            f"{kills} kills, {banks} banks of {given.count} scans in {len(plan.shards)} shards by "
            f"{given.engine}, "
            f"a whole run takes {seconds:.1f} s: all files have the same bytes as without a kill"
        )


if __name__ == "__main__":
    main()
