"""Kill a bake at random moments, many times, and check that the finished bank has the same bytes.

    python tools/kill_bake.py --kills 100 [--engine processes] [--model town]

First a bank is baked without interruption. Then the same bake runs in its own process group, which
is killed (SIGKILL) after a random fraction of the time of a complete run, and is started again.
Whenever a bake finishes, its files are compared and the next bank begins. By default the model is a
fast one with random weights, because the test is about writing.
"""

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from bench.untrained import write_untrained
from tqdm import tqdm
from typer import run

from lidar_synth.bake import BakeJob, BakePlan, Resources, bake, make_plan
from lidar_synth.bake.verify import verify


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


def count_kills(
    plan: BakePlan, again: Callable[[], int], seconds: float, rng: random.Random
) -> int:
    """Kill a bake and start it again until it has finished; the number of kills."""
    kills = 0
    while killed(again(), rng.uniform(0, seconds)):
        kills += 1
    assert verify(plan.out, progress=False) == []
    return kills


def repeat(
    again: Callable[[], int], plan: BakePlan, kills: int, seconds: float, seed: int
) -> Iterator[int]:
    """Bake banks under kills until there were enough of them; the number of kills of each."""
    rng = random.Random(seed)
    done = 0
    with tqdm(total=kills, unit="kill") as bar:
        while done < kills:
            shutil.rmtree(plan.out)
            found = count_kills(plan, again, seconds, rng)
            done += found
            bar.update(found)
            yield found


def main(
    model: str | None = None,
    kills: int = 100,
    count: int = 40,
    shard_size: int = 4,
    engine: str = "local",
    workers: int = 2,
    seed: int = 0,
) -> None:
    """Repeats until the number of kills is reached; exits with 1 if bytes differ."""
    with tempfile.TemporaryDirectory() as folder:
        model = model or str(write_untrained(Path(folder) / "untrained.safetensors"))
        job = BakeJob(model=model, count=count, shard_size=shard_size)
        plan = make_plan(Path(folder) / "bank", job)
        again = partial(start, plan, engine, workers)
        assert not killed(start(plan, "local", 1), 1e6)
        expected = files(plan.out)
        shutil.rmtree(plan.out)
        begin = time.monotonic()
        assert not killed(again(), 1e6)
        seconds = time.monotonic() - begin
        assert files(plan.out) == expected, "the engine writes other bytes"
        done = []
        for found in repeat(again, plan, kills, seconds, seed):
            done.append(found)
            if files(plan.out) != expected:
                sys.exit(
                    f"bank {len(done)} has other bytes than one baked without a kill"
                )
    print(
        f"{sum(done)} kills, {len(done)} banks of {count} scans in {len(plan.shards)} shards by "
        f"{engine}, a whole run takes {seconds:.1f} s: all files have the same bytes as "
        "without a kill"
    )


if __name__ == "__main__":
    run(main)
