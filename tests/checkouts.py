"""Checkouts of trainers' public code, given by environment variables, and runs of their own
scripts."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidar_synth.mixing.settings import VARIABLE


def checkout(variable: str, what: str) -> Path:
    """The folder that a variable names; the whole test file is skipped where it is not set."""
    value = os.environ.get(variable)
    if not value:
        pytest.skip(
            f"{variable} is not set to a checkout of {what}", allow_module_level=True
        )
    path = Path(value)
    if not path.is_dir():
        raise FileNotFoundError(f"{variable}={value} leads to no folder")
    return path


def needs(*libraries: str) -> None:
    """Skip the whole test file where a library is not installed."""
    for library in libraries:
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed", allow_module_level=True)


SCRIPTS = Path(__file__).parent.parent / "tools" / "trainers" / "scripts"
"""Scripts that run trainers' own scripts on a machine without a GPU."""


def run_script(
    script: Path,
    *arguments: str,
    cwd: Path,
    mixture: Path | None = None,
    **variables: str,
) -> str:
    """What a Python script says.

    Raises:
        RuntimeError: with what it said, if it fails.
    """
    environment = (
        os.environ | variables | ({} if mixture is None else {VARIABLE: str(mixture)})
    )
    done = subprocess.run(
        [sys.executable, str(script), *arguments],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print(done.stdout)
    if done.returncode:
        raise RuntimeError(done.stdout[-8000:])
    return done.stdout
