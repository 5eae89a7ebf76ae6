"""Runs of two processes, none of which waits for the other for long, against runs of one."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from conftest import random_scan
from flows import gaussian_velocity
from latent_runs import (  # noqa: F401 - fixtures
    SENSOR,
    call,
    one_thread,
    scans,
    write_config,
)
from PIL import Image
from safetensors.torch import load_file

from lidar_synth.files.parsing import read_picture
from lidar_synth.formats import WRITERS
from lidar_synth.generate.flow.timesteps import TrajectoryCosts, sum_costs
from lidar_synth.lab.train.ranks import Ranks

LIMITED = """
import sys
from datetime import timedelta

import accelerate.utils
import torch.distributed as dist
import torch.utils.tensorboard

import lidar_synth.lab.train.runs
from lidar_synth.cli import app

dist.init_process_group("gloo")
dist.barrier()
limit = timedelta(seconds=5)
dist.distributed_c10d._set_pg_timeout(limit, dist.group.WORLD)
app(sys.argv[1:])
"""
"""The command line with five seconds as the limit of a wait for the other process."""

HDIT = {
    "architecture": "hdit",
    "arguments": {
        "width": 16,
        "time_width": 16,
        "depths": [1, 1],
        "heads": [2, 2],
        "patch": [2, 2],
        "window": [3, 3],
    },
}

CAMERA = {
    "kind": "camera",
    "dropout": 0.1,
    "image": [752, 2816],
    "arguments": {"resolution": [16, 32], "views": 2, "channels": 8, "widths": [4, 8]},
}

SIZE = (752, 2816, 3)

PAIR = ("one", "two")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans with images in KITTI-360's layout, as many as one process reads in ten seconds."""
    folder = tmp_path_factory.mktemp("kitti360")
    writer: Any = WRITERS["kitti360"](folder)
    pixels = np.add.outer(np.arange(SIZE[0]), np.arange(SIZE[1])) % 251
    image = np.repeat(pixels.astype(np.uint8)[..., None], 3, 2)
    writer.write(random_scan(SENSOR, 400, 0), 0, image=image)
    [first] = folder.rglob("*.png")
    start = time.perf_counter()
    read_picture(first).convert("RGB").resize((32, 16), Image.Resampling.BICUBIC)
    count = ceil(10 / (time.perf_counter() - start))
    for i in range(1, count):
        writer.write(random_scan(SENSOR, 400, i), i, image=image[:4, :4])
    writer.finish()
    for path in folder.rglob("*.png"):
        if path != first:
            path.unlink()
            os.link(first, path)
    return folder


def train_with_two(config: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "torch.distributed.run",
            "--standalone",
            "--nproc-per-node",
            "2",
            config.parent / "limited.py",
            "train",
            config,
        ],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_two_ranks_with_a_cold_cache_never_wait_and_train_as_one(
    scans: Path,  # noqa: F811
    kitti: Path,
    tmp_path: Path,
) -> None:
    def config(name: str) -> Path:
        return write_config(
            scans,
            tmp_path,
            name,
            network=HDIT,
            condition=CAMERA,
            steps=3,
            data={"path": str(kitti), "layout": "kitti360", "split": "all"},
            channels=["range", "reflectance"],
        )

    (tmp_path / "limited.py").write_text(LIMITED)
    train_with_two(config("two"))
    call("train", config("one"))
    for name in ("range", "reflectance", "camera"):
        one, two = (np.load(tmp_path / n / "cache" / f"{name}.npy") for n in PAIR)
        assert np.array_equal(one, two)
    one, two = (load_file(tmp_path / n / f"{n}.safetensors") for n in PAIR)
    assert one.keys() == two.keys()
    for name in one:
        assert torch.allclose(one[name], two[name], rtol=0, atol=2e-5), name


def test_what_is_left_is_divided_anew_after_every_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The second process is slow: the first one takes most of the items."""
    taken: list[int] = []

    def gather(self: Ranks, mine: list[Any]) -> list[Any]:
        left = [n for n in range(20) if n not in seen]
        seen.update(n for n, _ in mine)
        slow = [n for n in left[1::2] if n not in seen][:1]
        seen.update(slow)
        return mine + [(n, n * n) for n in slow]

    seen: set[int] = set()

    def square(n: int) -> int:
        taken.append(n)
        time.sleep(0.01)
        return n * n

    monkeypatch.setattr("lidar_synth.lab.train.ranks.TURN", 0.025)
    monkeypatch.setattr(Ranks, "_gather", gather)
    found: Iterator[int] = Ranks(0, 2).map(square, range(20))
    assert list(found) == [n * n for n in range(20)]
    assert len(taken) == len(set(taken)) and 12 <= len(taken) < 20


def select(rank: int, port: int, out: Path) -> None:
    """One of two processes that select timesteps together."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2"}
    os.environ["ACCELERATE_USE_CPU"] = "true"
    from accelerate.state import AcceleratorState, PartialState

    AcceleratorState._reset_state(True)  # forked from a process that may have had one
    PartialState._reset_state()
    PartialState(cpu=True)
    np.savez(out / f"{rank}.npz", **asdict(costs(Ranks(rank, 2))))
    dist.destroy_process_group()


def costs(ranks: Ranks) -> TrajectoryCosts:
    every = sum_costs(
        gaussian_velocity,
        (2, 3),
        intervals=3,
        candidates=8,
        trajectories=7,
        batch=2,
        progress=False,
        each=ranks.map,
    )
    *_, last = every
    return last


@pytest.mark.filterwarnings("ignore")
def test_two_ranks_select_the_timesteps_of_one(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    mp.start_processes(select, (port, tmp_path), nprocs=2, start_method="fork")
    alone = asdict(costs(Ranks()))
    for rank in (0, 1):
        with np.load(tmp_path / f"{rank}.npz") as found:
            for name, values in alone.items():
                assert np.array_equal(found[name], values), name
