"""Ctrl-C on the command line: one message, the exit status of an interrupted program, and no word
from workers; and workers that end before their work."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from layouts import some_scan, write_all

from lidar_synth import cli
from lidar_synth.files.processes import GUARD, defer_signals


def test_control_c_gives_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer()

    @app.command()
    def work() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", app)
    monkeypatch.setattr(sys, "argv", ["lidar-synth"])
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 130
    assert capsys.readouterr().err == "lidar-synth: interrupted\n"


HALF_MADE = """
from lidar_synth import cli

class Half:
    def __del__(self):
        self.made

def work():
    global half
    half = Half()
    raise KeyboardInterrupt

cli.app = work
cli.main()
"""


def test_control_c_while_an_object_is_made() -> None:
    """As in numba's compiler, whose half-made objects fail when the interpreter deletes them."""
    ended = subprocess.run(
        [sys.executable, "-c", HALF_MADE], capture_output=True, text=True
    )
    assert ended.returncode == 130
    assert ended.stderr == "lidar-synth: interrupted\n"


@pytest.mark.skipif(
    not hasattr(signal, "pthread_kill"), reason="Windows has no signals of threads"
)
def test_control_c_waits_while_processes_start() -> None:
    """Python interrupts the main thread also for a signal that another thread received."""
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    started = []
    with pytest.raises(KeyboardInterrupt), defer_signals(signal.SIGINT):
        signal.pthread_kill(other.ident, signal.SIGINT)
        time.sleep(0.1)
        started.append(True)
    end.set()
    other.join()
    assert started
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("guard", "work"), [("True", "abs"), ("__name__ == '__main__'", "os._exit")]
)
def test_a_worker_that_ends_is_explained(tmp_path: Path, guard: str, work: str) -> None:
    """One that runs a script without a guard again, or one that ends at its work."""
    script = tmp_path / "script.py"
    lines = [
        "import os",
        "from lidar_synth.files.processes import map_in_processes",
        f"if {guard}:",
        f"    with map_in_processes({work}, [1, 2], 2) as done:",
        "        print(list(done))",
    ]
    script.write_text("\n".join(lines))
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert ended.returncode == 1
    assert "ProcessError: a worker ended before its work" in ended.stderr
    assert f"{GUARD}\n" in ended.stderr


def children(process: int) -> list[str]:
    return Path(f"/proc/{process}/task/{process}/children").read_text().split()


WHEN: dict[str, Callable[[int, Path], bool]] = {
    "workers start": lambda process, out: (
        len(children(process)) > 2
    ),  # two, and Python's own for what they share
    "workers work": lambda process, out: any(out.rglob("*.bin")),
}


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/task").is_dir(), reason="children are counted in /proc"
)
@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize("command", ["town", "convert"])
def test_control_c_with_workers(tmp_path: Path, command: str, when: str) -> None:
    """A terminal sends the signal to every process of the group; only the first one reports it."""
    out = tmp_path / "out"
    options = ["--scans", "60", "--no-camera"]
    if command == "convert":
        write_all("kitti", tmp_path / "in", [some_scan()] * 800)
        options = ["--to", "kitti"]
    call = [
        command,
        *([str(tmp_path / "in")] if command == "convert" else []),
        str(out),
        *options,
        "--jobs",
        "2",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "lidar_synth", *call],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not WHEN[when](process.pid, out):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    started = time.monotonic()
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert (
        errors.rstrip().endswith("lidar-synth: interrupted")
        and "Traceback" not in errors
    ), errors
    assert not list(out.rglob("*.part")) and time.monotonic() - started < 60
