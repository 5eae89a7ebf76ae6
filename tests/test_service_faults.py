"""The life and death of a rolling bank: nobody waits for ever, nothing is left behind, and the
error says what died."""

import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from test_generator import write
from torch.utils.data import DataLoader

from lidar_synth.errors import ProcessError
from lidar_synth.files.processes import GUARD
from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint, save_checkpoint
from lidar_synth.mixing.service import RollingBank

ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("service") / "small.safetensors")


@pytest.fixture
def bank(path: Path) -> Iterator[RollingBank]:
    with RollingBank(path, slots=4, threads=1, timeout=60) as bank:
        yield bank


class Ids(torch.utils.data.Dataset[str]):
    """A bank's scans 0 .. 999 as workers read them."""

    def __init__(self, bank: RollingBank) -> None:
        self.bank = bank

    def __len__(self) -> int:
        return 1000

    def __getitem__(self, number: int) -> str:
        return self.bank[number].id


def gone(pid: int, seconds: float = 20) -> bool:
    """Whether a process that is nobody's child any more ends in time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        stat = Path(f"/proc/{pid}/stat")
        if stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.05)
    return False


@pytest.mark.slow
def test_a_bank_outlives_a_worker_and_names_a_dead_generator(bank: RollingBank) -> None:
    loader = DataLoader(
        Ids(bank), batch_size=2, num_workers=2, multiprocessing_context="fork"
    )
    batches: Any = iter(loader)
    next(batches)
    os.kill(batches._workers[0].pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="DataLoader worker"):
        list(batches)
    batches = iter(loader)
    assert next(batches) == ["small/0/0", "small/0/1"]
    assert bank[999].id == "small/0/999"

    os.kill(bank.pid, signal.SIGKILL)
    message = rf"generator process of the rolling bank died \(process {bank.pid}"
    with pytest.raises(ProcessError, match=message):
        list(batches)
    for _ in range(2):  # a line that was open, and a new one
        with pytest.raises(ProcessError, match=message + ", exit code -9; no message"):
            bank[0]


@pytest.mark.slow
def test_a_generator_that_hangs_is_not_waited_for_longer_than_stated(
    bank: RollingBank,
) -> None:
    bank[0]
    os.kill(bank.pid, signal.SIGSTOP)
    bank._client.timeout = 0.3
    start = time.monotonic()
    for _ in range(2):
        with pytest.raises(
            ProcessError,
            match=rf"process {bank.pid}, .*has not answered \(scan 5\) within 0.3 s",
        ):
            bank[5]
    with pytest.raises(ProcessError, match="has not answered within 0.3 s"):
        bank.expect(range(100_000))
    assert time.monotonic() - start < 10
    os.kill(bank.pid, signal.SIGCONT)
    bank._client.timeout = 60.0
    # Late answers are not taken for these.
    assert [bank[n].id for n in (7, 5)] == [
        "small/0/7",
        "small/0/5",
    ]
    os.kill(bank.pid, signal.SIGSTOP)
    bank.close()
    assert gone(bank.pid)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")
def test_a_generator_gets_no_ctrl_c_while_it_starts(bank: RollingBank) -> None:
    """A terminal sends it to every process; one that starts would print a traceback."""
    status = Path(f"/proc/{bank.pid}/status").read_text()
    [blocked] = [v for v in status.splitlines() if v.startswith("SigBlk")]
    assert int(blocked.split()[1], 16) & 1 << (signal.SIGINT - 1)


def test_a_model_that_loads_for_too_long(path: Path) -> None:
    with pytest.raises(
        ProcessError,
        match="0 scans made so far.* has not loaded the model within 0.01 s",
    ):
        RollingBank(path, timeout=0.01)


@pytest.mark.slow
def test_the_generators_last_words_are_heard(path: Path, tmp_path: Path) -> None:
    checkpoint = load_checkpoint(path)
    for parameter in checkpoint.networks[VELOCITY].parameters():
        torch.nn.init.constant_(parameter, 1e30)
    broken = tmp_path / "broken.safetensors"
    save_checkpoint(broken, checkpoint.header, checkpoint.networks)
    with RollingBank(broken, threads=1, timeout=60) as bank:
        for _ in range(2):
            with pytest.raises(
                ProcessError,
                match=r"died \(process \d+, exit code 1; DataError: .*NaN or infinity",
            ):
                bank[0]


@pytest.mark.slow
def test_banks_are_independent_and_end_with_their_last_reference(path: Path) -> None:
    first, second = (
        RollingBank(path, seed=seed, slots=2, threads=1, timeout=60) for seed in (1, 2)
    )
    assert [bank[4].id for bank in (first, second)] == ["small/1/4", "small/2/4"]
    pid = first.pid
    del first
    gc.collect()
    assert gone(pid)
    assert second[5].id == "small/2/5"
    second.close()


TRAINER = """
import os, sys, time
from lidar_synth.mixing.service import RollingBank

def main():
    bank = RollingBank(sys.argv[1], slots=2, threads=1, timeout=60)
    print(bank.pid, bank[3].id, flush=True)
    if sys.argv[2] == "interrupt":
        time.sleep(60)
    elif sys.argv[2] == "raise":
        raise SystemError("a trainer's own")
    elif sys.argv[2] == "vanish":
        os._exit(0)

"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "code"), [("raise", 1), ("vanish", 0), ("interrupt", -signal.SIGINT)]
)
def test_a_trainer_that_ends_without_closing_leaves_nothing(
    how: str, code: int, path: Path, tmp_path: Path
) -> None:
    script = tmp_path / "trainer.py"
    script.write_text(TRAINER + "if __name__ == '__main__':\n    main()\n")
    trainer = subprocess.Popen(
        [sys.executable, script, path, how],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert trainer.stdout is not None
    pid, name = trainer.stdout.readline().split()
    assert name == "small/0/3"
    if how == "interrupt":
        os.killpg(trainer.pid, signal.SIGINT)  # as a terminal does it
    errors = trainer.communicate(timeout=60)[1]
    assert trainer.returncode == code, errors
    # the generator is silent
    assert errors.count("Traceback") == (how in ("raise", "interrupt"))
    assert gone(int(pid))


@pytest.mark.slow
def test_a_script_without_a_main_guard_gets_a_hint(path: Path, tmp_path: Path) -> None:
    script = tmp_path / "trainer.py"
    script.write_text(TRAINER + "main()\n")
    trainer = subprocess.run(
        [sys.executable, script, path, "return"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert trainer.returncode == 1
    assert GUARD in trainer.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"
)
def test_a_killed_trainer_generator_or_worker_leaves_nothing() -> None:
    """A short run of the stress test; the whole one takes minutes."""
    call = [
        sys.executable,
        ROOT / "tools" / "stress_service.py",
        "--kills",
        "3",
        "--reads",
        "0",
    ]
    run = subprocess.run(call, capture_output=True, text=True, timeout=480)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "3 kills: 0 went wrong" in run.stdout
