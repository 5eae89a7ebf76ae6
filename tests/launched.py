"""Trainers' own scripts, run by our launchers as a user types it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from lidar_synth.mixing.settings import VARIABLE


def launched(
    trainer: str, *arguments: str | Path, cwd: Path, mixture: Path, status: int = 0
) -> str:
    """What ``python -m lidar_synth.integrations.<trainer> <arguments>`` says; another exit status
    fails the test."""
    command = [
        sys.executable,
        "-m",
        f"lidar_synth.integrations.{trainer}",
        *map(str, arguments),
    ]
    done = subprocess.run(
        command,
        cwd=cwd,
        env=os.environ | {VARIABLE: str(mixture)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == status, f"exit status {done.returncode}; see what it said"
    return done.stdout


def epochs(said: str) -> list[tuple[int, int, int, str]]:
    """(epoch, samples, synthetic samples, start of the plan's hash) of each epoch that a launcher
    announced."""
    found = re.findall(
        r"lidar_synth: epoch (\d+): (\d+) samples, (\d+) of them synthetic, plan (\w+)",
        said,
    )
    return [(int(a), int(b), int(c), plan) for a, b, c, plan in found]


def clone(root: Path, out: Path) -> Path:
    """A copy of a checkout with a commit, as ``git clone`` leaves it; trainers write beside their
    code and ask git."""
    shutil.copytree(
        root,
        out,
        ignore=shutil.ignore_patterns(".git", "__pycache__", "*.gif", "*.png"),
    )
    who = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    for arguments in (
        ["init", "-q"],
        [*who, "commit", "-q", "--allow-empty", "-m", "copy"],
    ):
        subprocess.run(["git", *arguments], cwd=out, check=True)
    return out
