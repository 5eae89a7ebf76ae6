"""The readers under mutated files: a share of what ``tools/fuzz.py`` runs, and the harness itself.

Whatever a file holds, a reader gives a sound result or one of the package's errors, in less than
500 MB and 5 seconds.
"""

import importlib
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from layouts import some_scan

if not Path("/proc/self/status").exists():
    pytest.skip(
        "limits and peaks of memory are those of Linux", allow_module_level=True
    )

from fuzzing import mutators
from fuzzing.cases import Cases, mutable, seed_files
from fuzzing.checks import fingerprint, flaws
from fuzzing.containers import gunzip, gzipped_zeros
from fuzzing.run import FLAWS, fuzz
from fuzzing.targets import TARGETS, Target, read
from fuzzing.worker import DIED, EQUAL, FOREIGN, MEMORY, REFUSED, SLOW, UNSOUND, Limits

from lidar_synth.errors import DataError
from lidar_synth.formats import READERS
from lidar_synth.formats.folder import SUFFIXES

CASES = 80
"""Of each reader, in every run of the tests."""

EXEMPT = {"py123d": "Arrow, LAZ and Draco are read by their own libraries"}
"""{layout: why its reader is not fuzzed}."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_mutated_files_are_read_soundly_or_refused(name: str) -> None:
    report = fuzz(name, TARGETS[name], range(CASES))
    found = "\n".join(
        f"python tools/fuzz.py --reader {name} --case {f.number}: {f}"
        for f in report.flaws
    )
    assert not report.flaws, found
    assert report.cases == CASES and report.counts[REFUSED] > CASES / 8


def test_every_reader_is_fuzzed() -> None:
    reads = [target.read for target in TARGETS.values()]
    covered = {r.args[0] for r in reads if isinstance(r, partial) and r.func is read}
    assert covered | set(EXEMPT) == set(READERS)
    assert {f".{name}" for name in TARGETS} >= set(SUFFIXES)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_number_gives_the_same_case(tmp_path: Path, name: str) -> None:
    def contents(cases: Cases, number: int) -> dict[str, bytes]:
        root = cases.place(number)
        found = {
            str(p.relative_to(root)): p.read_bytes()
            for p in root.rglob("*")
            if p.is_file()
        }
        cases.restore()
        return found

    first, second, other = (
        Cases(name, TARGETS[name], s, tmp_path / d)
        for s, d in ((0, "a"), (0, "b"), (1, "c"))
    )
    assert first.files == second.files == other.files
    forwards = [contents(first, number) for number in range(8)]
    backwards = [contents(second, number) for number in reversed(range(8))][::-1]
    assert forwards == backwards
    assert sum(case != first.files for case in forwards) >= 6
    assert forwards != [contents(other, number) for number in range(8)]
    assert contents(first, 0) == forwards[0]


@pytest.mark.parametrize("name", TARGETS)
def test_mutators_read_the_valid_files_and_change_them(
    tmp_path: Path, name: str
) -> None:
    """One that always raised would be replaced by flipped bits without a word."""
    files = seed_files(TARGETS[name], tmp_path / "valid")
    for file in mutable(TARGETS[name], files):
        content = files[file]
        known = mutators.BY_SUFFIX.get(Path(file).suffix)
        assert known, f"no mutator knows {file}"
        for mutator in [*known, *mutators.BY_SUFFIX[""]]:
            made = [mutator(content, Random(number)) for number in range(8)]
            assert sum(other != content for other in made) >= 3, mutator
            assert made[0] == mutator(content, Random(0)), mutator


NUMBERS = bytes(range(256))


def only_numbers(root: Path) -> None:
    root.mkdir()
    (root / "numbers.bin").write_bytes(NUMBERS)


def is_valid(root: Path) -> bool:
    return (root / "numbers.bin").is_file() and (
        root / "numbers.bin"
    ).read_bytes() == NUMBERS


def refuses(root: Path) -> list[Any]:
    if not is_valid(root):
        raise DataError("no")
    return []


def raises(root: Path) -> list[Any]:
    return [] if is_valid(root) else [{}["x"]]


def kills_itself(root: Path) -> list[Any]:
    if not is_valid(root):
        os.kill(os.getpid(), signal.SIGSEGV)
    return []


def exits(root: Path) -> list[Any]:
    if not is_valid(root):
        os._exit(0)
    return []


def allocates(megabytes: int, root: Path) -> list[Any]:
    if not is_valid(root):
        np.ones(megabytes * 1_000_000, np.uint8)
    return []


def hides_its_allocation(root: Path) -> list[Any]:
    try:
        return allocates(600, root)
    except MemoryError:
        raise DataError("no") from None


def sleeps(root: Path) -> list[Any]:
    if not is_valid(root):
        time.sleep(60)
    return []


def gives_nan(root: Path) -> list[Any]:
    scan = some_scan()
    if not is_valid(root):
        scan.points[3, 1] = np.nan
    return [scan]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reader", "verdict", "detail"),
    [
        (refuses, REFUSED, ""),
        (raises, FOREIGN, "KeyError: 'x'"),
        (kills_itself, DIED, "SIGSEGV"),
        (exits, DIED, "exit status 0"),
        (partial(allocates, 600), MEMORY, "MemoryError"),
        (partial(allocates, 300), EQUAL, ""),
        (hides_its_allocation, MEMORY, "DataError: no"),
        (sleeps, SLOW, "more than 1 s"),
        (gives_nan, UNSOUND, "points up to nan m"),
    ],
)
def test_what_a_broken_reader_does_is_noticed(
    reader: Any, verdict: str, detail: str
) -> None:
    """The process is started again where a case ended it, so that every case is counted."""
    limits = Limits(seconds=1.0 if reader is sleeps else 60.0)
    report = fuzz("broken", Target(only_numbers, reader), range(3), limits=limits)
    assert report.counts == {verdict: 3}
    assert [flaw.number for flaw in report.flaws] == (
        [0, 1, 2] if verdict in FLAWS else []
    )
    assert all(detail in flaw.detail for flaw in report.flaws)


def test_a_harness_that_fails_is_no_verdict() -> None:
    with pytest.raises(
        RuntimeError,
        match=r"broken: the harness failed \(exit status 1\)(.|\n)*KeyError",
    ):
        fuzz("broken", Target(only_numbers, partial(dict.__getitem__, {})), range(1))


def test_checks_see_what_is_unsound() -> None:
    scan = some_scan()
    assert list(flaws(scan)) == []
    assert fingerprint(scan) == fingerprint(some_scan())
    assert fingerprint(scan) != fingerprint(some_scan(1))
    for name, value in {
        "points": np.full_like(scan.points, np.inf),
        "reflectance": scan.reflectance * 255,
        "label": np.full(len(scan), 19, np.uint8),
        "raw_label": scan.raw_label[:-1],  # type: ignore[index]
        "instance": scan.instance.astype(np.int64),  # type: ignore[union-attr]
        "pose": np.eye(4) * 2,
        "domain": 7,
    }.items():
        changed = some_scan()
        setattr(changed, name, value)
        assert list(flaws(changed)), name
        assert fingerprint(changed) != fingerprint(scan), name


@pytest.mark.slow
def test_the_tool_prints_a_table_and_keeps_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "tools"))
    tool = importlib.import_module("fuzz")
    monkeypatch.setitem(TARGETS, "broken", Target(only_numbers, raises))
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "fuzz.py",
            "--cases",
            "4",
            "--reader",
            "bin",
            "--reader",
            "broken",
            "--keep",
            str(tmp_path),
        ],
    )
    with pytest.raises(SystemExit) as ended:
        tool.main()
    assert ended.value.code == 1
    printed = capsys.readouterr().out
    assert "| reader | cases | read equal |" in printed and "| bin | 4 |" in printed
    assert "| broken | 4 | 0 | 0 | 0 | 0 | 4 | 0 |" in printed
    assert (
        "broken --seed 0 --case [0, 1, 2]: 4 x foreign error: \"KeyError: 'x'\""
        in printed
    )
    assert not is_valid(tmp_path / "broken" / "0-0" / "case")
    monkeypatch.setattr(
        sys,
        "argv",
        ["fuzz.py", "--reader", "bin", "--case", "0", "--keep", str(tmp_path)],
    )
    with pytest.raises(DataError):
        tool.main()


def test_mutators_unpack_no_bomb() -> None:
    assert gunzip(gzipped_zeros(1)) == bytes(1_000_448)
    with pytest.raises(ValueError, match="a bomb"):
        gunzip(gzipped_zeros(70))
