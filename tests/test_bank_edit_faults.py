"""Banks made from banks: a call that is killed at any moment is completed by the same call."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from banks import SENSOR, some_image, write_bank

from lidar_synth.bake import edit
from lidar_synth.bake.edit import drop, head, merge, split
from lidar_synth.bake.making import NOTE
from lidar_synth.bank import INDEX, Bank
from lidar_synth.errors import ConfigError
from lidar_synth.files.lock import lock_shared

CALLS: dict[str, Callable[[Bank, Path], object]] = {
    "merge": lambda bank, out: merge([bank], out / "one", progress=False),
    "head": lambda bank, out: head(bank, 5, out / "one", progress=False),
    "split": lambda bank, out: split(
        bank, {out / "one": 0.5, out / "two": 0.5}, progress=False
    ),
    "drop": lambda bank, out: drop(
        bank, [1, 4], "by hand", out / "one", progress=False
    ),
}


@pytest.fixture
def bank(tmp_path: Path) -> Bank:
    write_bank(tmp_path / "bank", [some_image(seed) for seed in range(8)])
    return Bank(tmp_path / "bank")


class Killed(BaseException):
    """Raised between two files in the place of SIGKILL; no handler of the package catches it."""


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file()
    }


@pytest.mark.parametrize("call", CALLS)
def test_a_killed_call_is_completed_by_the_same_call(
    call: str, bank: Bank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    CALLS[call](bank, tmp_path / "whole")
    expected = contents(tmp_path / "whole")
    files = len([name for name in expected if name.endswith(".h5")])
    out = tmp_path / "out"
    replace = Path.replace
    for survivors in range(files + 2):
        shutil.rmtree(out, ignore_errors=True)
        left = iter(range(survivors))

        def replace_or_die(path: Path, target: Path, left: object = left) -> Path:
            if next(left, None) is None:  # type: ignore[call-overload]
                raise Killed
            return replace(path, target)

        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", replace_or_die)
            with pytest.raises(Killed):
                CALLS[call](bank, out)
        CALLS[call](bank, out)
        assert contents(out) == expected, f"killed before file {survivors + 1}"
        CALLS[call](bank, out)
        assert contents(out) == expected


@pytest.mark.parametrize("call", CALLS)
def test_the_folder_of_another_call_is_refused(
    call: str, bank: Bank, tmp_path: Path
) -> None:
    head(bank, 3, tmp_path / "out" / "one", progress=False)
    before = contents(tmp_path / "out")
    with pytest.raises(ConfigError, match="was filled with"):
        CALLS[call](bank, tmp_path / "out")
    with pytest.raises(ConfigError, match="holds another bank"):
        CALLS[call](
            bank, shutil.copytree(tmp_path / "bank", tmp_path / "other" / "one").parent
        )
    assert contents(tmp_path / "out") == before


def test_a_file_of_the_user_is_not_replaced(bank: Bank, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "README.md").write_text("mine")
    with pytest.raises(ConfigError, match="holds a README.md"):
        head(bank, 3, tmp_path / "out", progress=False)
    assert contents(tmp_path / "out") == {"README.md": b"mine"}


def test_what_cannot_be_merged_is_named(bank: Bank, tmp_path: Path) -> None:
    wide = replace(SENSOR, columns=2 * SENSOR.columns)
    write_bank(tmp_path / "wide", [some_image(0, wide)])
    with pytest.raises(ConfigError, match=r"\(8 x 64, .*expected .*\(8 x 32, "):
        merge([bank, Bank(tmp_path / "wide")], tmp_path / "out")
    with pytest.raises(ConfigError, match="no bank to merge"):
        merge([], tmp_path / "out")


def test_a_refused_split_leaves_no_claim(bank: Bank, tmp_path: Path) -> None:
    train, val = tmp_path / "train", tmp_path / "val"
    val.mkdir()
    (val / "README.md").write_text("mine")
    with pytest.raises(ConfigError, match="holds a README.md"):
        split(bank, {train: 0.5, val: 0.5}, progress=False)
    assert contents(train) == {}
    (val / "README.md").unlink()
    parts = split(bank, {train: 0.75, val: 0.25}, progress=False)
    assert parts[train].scans == 6


@pytest.mark.skipif(os.name == "nt", reason="files are not locked on Windows")
def test_two_calls_do_not_write_one_folder(bank: Bank, tmp_path: Path) -> None:
    out = tmp_path / "out"
    head(bank, 3, out, progress=False)
    (out / INDEX).unlink()
    with (
        lock_shared(out / NOTE),
        pytest.raises(ConfigError, match="in which another process works"),
    ):
        head(bank, 3, out, progress=False)
    assert edit.head(bank, 3, out, progress=False).scans == 3


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the script forks")
def test_commands_that_are_killed_resume_to_the_same_bytes() -> None:
    script = Path(__file__).parent.parent / "tools" / "kill_commands.py"
    some = ["convert", "convert, webdataset", "bank split", "curate"]
    options = [word for name in some for word in ("--command", name)]
    done = subprocess.run(
        [sys.executable, script, "--kills", "2", *options],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = re.findall(
        r"\| ([a-z, -]+) \| 2 \|(?: \d+ \|){3}", done.stdout + done.stderr
    )
    assert rows == some
