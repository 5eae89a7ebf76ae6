"""Interrupted bakes: signals, kills, full disks, lost folders. Finished shards are kept, a rerun
completes the bank."""

import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from bakes import SIZE, files, plan_in
from test_generator import write

import lidar_synth.bake.folder as folder_module
import lidar_synth.bake.processes as processes_module
import lidar_synth.bake.run as run_module
import lidar_synth.bake.shard as shard_module
from lidar_synth.bake import ENGINES, BakePlan, Resources, Share, bake, bake_shard
from lidar_synth.bake.folder import prepare
from lidar_synth.bank import INDEX, Index
from lidar_synth.bank.index import SETTINGS
from lidar_synth.errors import ConfigError, FileError
from lidar_synth.files.processes import GUARD
from lidar_synth.formats.writer import NOTES


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture
def plan(model: Path, tmp_path: Path) -> BakePlan:
    return plan_in(tmp_path / "bank", model)


@pytest.fixture(scope="module")
def expected(model: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the bank, baked without interruption in this process."""
    plan = plan_in(tmp_path_factory.mktemp("expected") / "bank", model)
    bake(plan, progress=False)
    return files(plan.out)


@pytest.fixture(scope="module")
def sixty(model: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the bank that ``start`` bakes, without interruption in this process."""
    plan = plan_in(
        tmp_path_factory.mktemp("sixty") / "bank", model, count=60, shard_size=5
    )
    bake(plan, progress=False)
    return files(plan.out)


def stop_after(plan: BakePlan, scans: int, stop: Callable[[], object]) -> None:
    """Bake in this process; call ``stop`` after this many scans."""
    made = 0

    def progress(number: int) -> None:
        nonlocal made
        made += number
        if made == scans:
            stop()

    def engine(plan: BakePlan, numbers: Any, resources: Resources, _: Any) -> None:
        for number in numbers:
            bake_shard(plan, number, progress)

    engines = run_module.ENGINES
    run_module.ENGINES = {"local": engine}
    try:
        bake(plan, progress=False)
    finally:
        run_module.ENGINES = engines


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("scans", [1, 5, 10])
def test_a_signal_keeps_finished_shards(
    plan: BakePlan, expected: dict[str, bytes], stop: signal.Signals, scans: int
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        stop_after(plan, scans, lambda: os.kill(os.getpid(), stop))
    assert signal.getsignal(signal.SIGTERM) == before
    kept = sorted(path.name for path in plan.out.glob("*.h5"))
    assert (
        len(kept) == (scans - 1) // SIZE
        and not list(plan.out.glob(".*.part"))
        and not (plan.out / INDEX).exists()
    )
    times = {name: (plan.out / name).stat().st_mtime_ns for name in kept}
    bake(plan, progress=False)
    assert files(plan.out) == expected
    # Not written twice.
    assert times == {name: (plan.out / name).stat().st_mtime_ns for name in kept}


def start(
    out: Path, model: Path, *options: str, **others: Any
) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "lidar_synth",
        "bake",
        str(out),
        "--model",
        str(model),
        "--count",
        "60",
    ]
    command += ["--shard-size", "5", "--seed", "4", *options]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **others)


def wait_for_shards(process: subprocess.Popen[str], out: Path, count: int) -> None:
    while len(list(out.glob("*.h5"))) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


@pytest.mark.slow
def test_killed_and_terminated_runs_resume(
    model: Path, tmp_path: Path, sixty: dict[str, bytes]
) -> None:
    out = tmp_path / "bank"
    process = start(out, model)
    wait_for_shards(process, out, 2)
    process.kill()
    process.wait()
    assert not (out / INDEX).exists()
    process = start(out, model, "--engine", "processes", "--workers", "2")
    wait_for_shards(process, out, 5)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert (
        f"stopped; finished shards are kept in {out}, the same command resumes"
        in errors
    )
    assert "Traceback" not in errors
    bake(plan_in(out, model, count=60, shard_size=5), progress=False)
    assert files(out) == sixty


@pytest.mark.slow
def test_control_c_while_workers_start(model: Path, tmp_path: Path) -> None:
    """A terminal sends the signal to every process of the group; only the parent reports it."""
    process = start(
        tmp_path / "bank",
        model,
        "--engine",
        "processes",
        "--workers",
        "2",
        start_new_session=True,
    )
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    # the workers, and Python's own for what they share
    while len(children.read_text().split()) < 3:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert "stopped; finished shards are kept" in errors and "Traceback" not in errors


@pytest.mark.slow
def test_a_killed_worker_is_reported(
    model: Path, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    plan = plan_in(tmp_path / "bank", model, count=300, shard_size=100)

    def kill(scans: int) -> None:
        for worker in multiprocessing.active_children():
            if worker.pid is not None and worker.name.startswith("SpawnProcess"):
                os.kill(worker.pid, signal.SIGKILL)

    prepare(plan)
    with pytest.raises(
        FileError,
        match=r"a worker was killed \(exit status -9\).*finished shards are kept",
    ):
        ENGINES["processes"](plan, range(3), Resources(1), kill)
    assert multiprocessing.active_children() == []


def leave(*args: Any) -> None:
    """A worker that ends as one does that runs a script without a guard again."""
    sys.exit(1)


@pytest.mark.slow
def test_a_worker_that_fails_was_not_killed(
    plan: BakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(plan)
    monkeypatch.setattr(processes_module, "_work", leave)
    with pytest.raises(FileError, match=r"a worker failed \(exit status 1\)") as error:
        ENGINES["processes"](plan, range(4), Resources(1), lambda scans: None)
    assert GUARD in str(error.value) and "memory" not in str(error.value)


@pytest.mark.slow
def test_an_error_of_a_worker_is_raised(plan: BakePlan, model: Path) -> None:
    prepare(plan)
    (plan.out / SETTINGS).unlink()
    with pytest.raises(FileError, match="has vanished or lost its .bake.json"):
        ENGINES["processes"](plan, range(4), Resources(1), lambda scans: None)


def test_a_damaged_finished_shard_is_regenerated(
    plan: BakePlan, expected: dict[str, bytes]
) -> None:
    bake(plan, progress=False)
    path = plan.out / "shard-00001.h5"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    (plan.out / "shard-00003.h5").unlink()
    bake(plan, progress=False)
    assert files(plan.out) == expected


def test_a_finished_bake_writes_nothing_again(plan: BakePlan) -> None:
    """So that it may be on a disk that can only be read."""
    bake(plan, progress=False)
    there = {path: path.stat().st_ino for path in plan.out.iterdir()}
    bake(plan, progress=False)
    assert {path: path.stat().st_ino for path in plan.out.iterdir()} == there


def test_temporary_files_of_killed_processes_are_removed(
    plan: BakePlan, expected: dict[str, bytes]
) -> None:
    """Only after the last process in the folder has ended, whichever process wrote them."""
    prepare(plan)
    halves = [plan.out / f".shard-0000{k}.h5.abcd.part" for k in range(2)]
    for path in halves:
        path.touch()
    hold = (
        "from lidar_synth.files.lock import lock_shared; from pathlib import Path\n"
        f"with lock_shared(Path({str(plan.out / SETTINGS)!r})): print(flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "\n"
        assert bake(plan, progress=False) is not None
        assert all(path.exists() for path in halves) and (plan.out / NOTES).exists()
        other.kill()  # the system releases its lock
    bake(plan, progress=False)
    assert files(plan.out) == expected


SHARES = {
    "all": [()] * 3,
    "shares": [("--shard-index", str(k), "--num-shards", "3") for k in range(3)],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "shares", ["all", pytest.param("shares", marks=pytest.mark.slow)]
)
def test_three_concurrent_bakes_write_the_same_bytes(
    model: Path, tmp_path: Path, sixty: dict[str, bytes], shares: str
) -> None:
    """Three processes; none removes a file that another one is writing."""
    out = tmp_path / "bank"
    processes = [start(out, model, *options) for options in SHARES[shares]]
    ended = [(process.communicate()[1], process.returncode) for process in processes]
    assert [code for _, code in ended] == [0, 0, 0], ended
    assert files(out) == sixty


@pytest.mark.slow
def test_a_bake_that_ends_leaves_the_open_shard_of_another_one(
    plan: BakePlan, expected: dict[str, bytes]
) -> None:
    """A complete bake starts and ends while another one is in the middle of a shard."""
    ended: list[subprocess.CompletedProcess[str]] = []

    def another() -> None:
        assert list(plan.out.glob(".*.part"))
        command = [
            sys.executable,
            "-m",
            "lidar_synth",
            "bake",
            str(plan.out),
            "--model",
            plan.job.model,
        ]
        command += [
            "--count",
            str(plan.job.count),
            "--shard-size",
            str(SIZE),
            "--seed",
            "4",
        ]
        ended.append(
            subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
        )
        assert list(plan.out.glob(".*.part"))

    stop_after(plan, 4, another)
    assert [process.returncode for process in ended] == [0], ended
    assert files(plan.out) == expected


def test_two_concurrent_claims_of_a_folder(
    plan: BakePlan, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both see an empty folder; the later one detects the conflict."""
    late = plan_in(plan.out, model, seed=5)
    looked = Path.is_file

    def slow(path: Path, **options: bool) -> bool:
        seen = looked(path, **options)
        if path.name == SETTINGS and not seen:
            monkeypatch.setattr(Path, "is_file", looked)
            prepare(plan)
        return seen

    monkeypatch.setattr(Path, "is_file", slow)
    with pytest.raises(
        ConfigError, match="was filled with {'seed': 4}; expected {'seed': 5}"
    ):
        prepare(late)


def test_two_bakes_may_end_at_the_same_time(
    plan: BakePlan, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both write the same files, and neither needs the records that the other one removes."""
    prepare(plan)
    for number in range(4):
        bake_shard(plan, number)
    written = folder_module.write_bank_files

    def both(root: Path, index: Index, baked: bool = False) -> Index:
        monkeypatch.setattr(folder_module, "write_bank_files", written)
        assert bake(plan, progress=False) == index
        return written(root, index, baked)

    monkeypatch.setattr(folder_module, "write_bank_files", both)
    assert bake(plan, progress=False) is not None
    assert files(plan.out) == expected


# The disk


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.98])
def test_a_full_disk_by_limit(
    plan: BakePlan, expected: dict[str, bytes], share: float
) -> None:
    """A file cannot grow to the end of a shard; at a low limit HDF5 cannot even write its
    metadata."""
    bake(plan, share=Share(0, 4), progress=False)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    shortest = min(
        len(content) for name, content in expected.items() if name.endswith(".h5")
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * shortest), limits[1]))
    try:
        with pytest.raises(
            FileError,
            match=r"cannot be written \(File too large\).*finished shards are kept",
        ):
            bake(plan, progress=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in plan.out.glob("*.h5")] == ["shard-00000.h5"]
    assert not list(plan.out.glob(".*.part"))
    bake(plan, progress=False)
    assert files(plan.out) == expected


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 44 kB; skips the test where mounting is not permitted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=44k", "tmpfs", folder],
        capture_output=True,
        check=False,
    )
    if not mounted or mounted.returncode:
        pytest.skip("mounting a file system is not permitted")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk(
    small_disk: Path,
    model: Path,
    expected: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Disables the check of free space before a shard.
    monkeypatch.setattr(shard_module, "_PACKED", 0)
    plan = plan_in(small_disk / "bank", model)
    with pytest.raises(
        FileError, match=r"No space left on device.*finished shards are kept"
    ):
        bake(plan, progress=False)
    kept = {path.name for path in plan.out.glob("*.h5")}
    assert 1 <= len(kept) < 4 and not list(plan.out.glob(".*.part"))
    assert all((plan.out / name).read_bytes() == expected[name] for name in kept)
    subprocess.run(["mount", "-o", "remount,size=400k", small_disk], check=True)
    bake(plan, progress=False)
    assert files(plan.out) == expected


def test_free_space_is_checked_before_a_shard(
    plan: BakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    need = 3 * 8 * 32 * 5 * 0.6
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(0, 0, need - 1))
    with pytest.raises(
        FileError,
        match=r"bank has 0.0 MB free; expected 0.1 MB for the next shard. Free some space",
    ):
        bake(plan, progress=False)
    assert not list(plan.out.glob("*.h5"))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(0, 0, need + 1))
    assert bake(plan, progress=False) is not None


def test_an_unwritable_folder_is_reported(model: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "bank", Path("/proc/bank")):
        with pytest.raises(
            FileError, match=r"cannot be written \(.*Choose another output folder"
        ):
            bake(plan_in(out, model), progress=False)


@contextmanager
def no_privileges() -> Iterator[None]:
    """Drop root's privileges, so that file permissions apply."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


def test_a_folder_that_becomes_read_only(
    model: Path, expected: dict[str, bytes]
) -> None:
    # pytest's own folders are not accessible to other users
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_in(Path(folder) / "bank", model)
        bake(plan, share=Share(0, 4), progress=False)
        Path(folder).chmod(0o755)
        plan.out.chmod(0o555)
        with (
            no_privileges(),
            pytest.raises(
                FileError,
                match=r"cannot be written \(Permission denied\).*finished shards are kept",
            ),
        ):
            bake(plan, progress=False)
        assert [path.name for path in plan.out.glob("*.h5")] == ["shard-00000.h5"]
        plan.out.chmod(0o755)
        bake(plan, progress=False)
        assert files(plan.out) == expected


@pytest.mark.slow
def test_a_folder_that_vanishes(plan: BakePlan, expected: dict[str, bytes]) -> None:
    for scans in (3, 4):  # at the end of a shard, and within one
        with pytest.raises(
            FileError, match=r"bank.*(has vanished or lost its .bake.json|No such file)"
        ):
            stop_after(plan, scans, lambda: shutil.rmtree(plan.out))
        assert not plan.out.exists()
    bake(plan, progress=False)
    assert files(plan.out) == expected


def test_a_disk_that_is_unmounted_during_a_bake(plan: BakePlan) -> None:
    """An empty folder replaces the bank's folder; nothing must be written into it."""
    prepare(plan)
    bake_shard(plan, 0)
    shutil.rmtree(plan.out)
    plan.out.mkdir()
    with pytest.raises(FileError, match="has vanished or lost its .bake.json"):
        bake_shard(plan, 1)
    assert not list(plan.out.iterdir())
