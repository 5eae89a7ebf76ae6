"""Kill a bake at random moments, over and over, and see that what is there in the end has the same bytes.

    python tools/kill_bake.py --kills 100 [--engine processes] [--model town]

A bank is baked in one go first. Then the same bake runs in a process group of its own, which is killed (SIGKILL) after
a random part of the time that a whole run takes, and is started again; whenever it comes to its end, its files are
compared and the next bank begins. The model is a quick one that has learnt nothing, unless another is named: what is
tried is the writing.
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
    """Bake in a child process with a group of its own; its id."""
    child = os.fork()
    if child:
        os.setpgid(child, child)  # here too: it may be killed before it has come to that itself
        return child
    os.setpgid(0, 0)
    try:
        bake(plan, engine, Resources(workers), progress=False)
    except BaseException as error:
        print(error, file=sys.stderr)
        os._exit(1)
    os._exit(0)


def killed(child: int, seconds: float) -> bool:
    """Wait, then kill the child's group; whether there still was something to kill."""
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
    """All files of a bank, those of a bake that is not at its end among them."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def main() -> None:
    """Kills until the number is reached; exits with 1 where bytes differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", help="a shipped model or a checkpoint")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--shard-size", type=int, default=4)
    parser.add_argument("--engine", default="local")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    given = parser.parse_args()
    chance = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        model = given.model or str(write_untrained(Path(folder) / "untrained.safetensors"))
        job = BakeJob(model=model, count=given.count, shard_size=given.shard_size)
        whole, plan = (make_plan(Path(folder) / name / "bank", job) for name in ("whole", "killed"))
        assert not killed(start(whole, "local", 1), 1e6)
        begin = time.monotonic()
        assert not killed(start(plan, given.engine, given.workers), 1e6)
        seconds, expected, out = time.monotonic() - begin, files(whole.out), plan.out
        assert files(out) == expected, "the engine writes other bytes"
        shutil.rmtree(out)
        kills = banks = 0
        with tqdm(total=given.kills, unit="kill") as bar:
            while kills < given.kills or out.exists():
                moment = chance.uniform(0, seconds) if kills < given.kills else 1e6
                if killed(start(plan, given.engine, given.workers), moment):
                    kills += 1
                    bar.update()
                elif (out / INDEX).exists():
                    assert verify(out, progress=False) == []
                    if files(out) != expected:
                        sys.exit(f"bank {banks} after {kills} kills has other bytes than one baked in one go")
                    banks += 1
                    shutil.rmtree(out)
        print(f"{kills} kills, {banks} banks of {given.count} scans in {len(plan.shards)} shards by {given.engine}, "
              f"a whole run takes {seconds:.1f} s: all files have the same bytes as those baked in one go")  # fmt: skip


if __name__ == "__main__":
    main()
