"""One trainer's trial: its folder, its fresh environment, the copy of its source tree, and the
commands it runs."""

import os
import re
import shutil
import subprocess
import sys
import time
import venv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainers.data import Data

ROOT = Path(__file__).parent.parent.parent
STEPS = ("training", "validation", "checkpoint", "resume")
"""What a run of a trainer can show: iterations with finite losses; its own evaluation; a checkpoint
on disk; and resumed training that sees the samples of an uninterrupted run."""

PIP = "^pip "
"""``skip`` of ``Trial.type_page`` for what has been installed."""
NOT_PIP = "^(?!pip )"
"""``skip`` of ``Trial.type_page`` for all but the installation."""


class Failed(Exception):
    """A trial that did not do what it should; the text says what to look at."""


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Args:
        trainer: the trainer and its configuration.
        script: its script as typed.
        ran: those of ``STEPS`` that ran.
        left_out: what could not run on a CPU and why; or the failure.
        minutes: wall-clock time of the run, the environment included.
        failed: whether the trial failed here.
    """

    trainer: str
    script: str
    ran: tuple[str, ...]
    left_out: str
    minutes: float
    failed: bool = False


class Trial:
    """What a file of ``tools/trainers`` needs to try its trainer.

    Args:
        name: name of the file, and of the trainer's folder in ``work``.
        title: the trainer in the table.
        work: the folder of all trials.
        data: datasets on disk, shared by all trials.
        reuse: keep the environment of an earlier run, to develop a trial; the table of a release is
            made without.

    Attributes:
        folder: ``work/<name>``, for everything that this trainer writes.
    """

    def __init__(
        self, name: str, title: str, work: Path, data: Data, reuse: bool = False
    ) -> None:
        self.name = name
        self.title = title
        self.data = data
        self.reuse = reuse
        self.folder = work / name
        self._wheel = work / "wheel"
        for old in () if not self.folder.exists() else self.folder.iterdir():
            if not (reuse and old.name == "venv"):
                shutil.rmtree(old) if old.is_dir() else old.unlink()
        (self.folder / "logs").mkdir(parents=True, exist_ok=True)
        self._began = time.monotonic()
        self._commands = 0

    def environment(
        self, *packages: str, extras: Sequence[str] = (), options: Sequence[str] = ()
    ) -> Path:
        """Make a virtual environment with torch, lidar_synth (a wheel of this checkout) and
        ``packages``.

        Args:
            packages: what to install from the package index, as for pip.
            extras: extras of lidar_synth.
            options: further options of pip for ``packages``, such as ``--no-deps``.

        Returns:
            Its Python. Call ``install`` for packages that need other options, or the trainer's own
            installer.
        """
        folder = self.folder / "venv"
        python = folder / "bin" / "python"
        wheel = wheel_of_checkout(self._wheel)
        if self.reuse and python.exists():
            self.install(python, str(wheel), options=["--force-reinstall", "--no-deps"])
            return python
        venv.create(folder, with_pip=True, clear=True)
        torch = next(
            line
            for line in (ROOT / "constraints.txt").read_text().splitlines()
            if line.startswith("torch==")
        )
        self.install(python, torch)
        self.install(python, f"{wheel}[{','.join(extras)}]" if extras else str(wheel))
        if packages:
            self.install(python, *packages, options=options)
        return python

    def install(
        self, python: Path, *packages: str, options: Sequence[str] = ()
    ) -> None:
        """``pip install`` into an environment."""
        self.run(
            "install",
            [
                python,
                "-m",
                "pip",
                "install",
                "--disable-pip-version-check",
                *options,
                *packages,
            ],
        )

    def tree(self, variable: str) -> Path:
        """A copy of the trainer's public source tree, whose folder an environment variable names.

        Raises:
            Failed: if the variable is not set.
        """
        given = os.environ.get(variable)
        if not given or not Path(given).is_dir():
            raise Failed(
                f"{variable}={given or ''} names no folder; expected: a clone of the trainer's "
                "public repository"
            )
        out = self.folder / "tree"
        if not out.exists():
            shutil.copytree(
                given, out, symlinks=True, ignore=shutil.ignore_patterns(".git")
            )
        return out

    def run(
        self,
        title: str,
        command: Sequence[object],
        *,
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
        expect: Iterable[str] = (),
        fails: bool = False,
        minutes: float = 40,
    ) -> str:
        """Run a command and keep its output in ``logs``.

        Args:
            title: name of the log.
            command: program and arguments.
            cwd: working directory; by default the trial's folder.
            env: further environment variables.
            expect: regular expressions, each of which the output has to contain.
            fails: whether the command has to fail (its message is then among ``expect``).
            minutes: limit of the command's time.

        Returns:
            The output, standard error included.

        Raises:
            Failed: with the log's path and last lines.
        """
        self._commands += 1
        log = (
            self.folder
            / "logs"
            / f"{self._commands:02d}-{re.sub(r'[^A-Za-z0-9]+', '-', title)}.log"
        )
        words = [str(word) for word in command]
        with log.open("w") as file:
            file.write(f"$ {' '.join(words)}\n")
            file.flush()
            try:
                code = subprocess.run(
                    words,
                    cwd=cwd or self.folder,
                    env=_environment(env or {}),
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=subprocess.STDOUT,
                    timeout=60 * minutes,
                    check=False,
                ).returncode
            except subprocess.TimeoutExpired:
                raise Failed(
                    f"{title}: not finished after {minutes:g} minutes; {log}"
                ) from None
        output = log.read_text(errors="replace")
        if (code != 0) != fails:
            raise Failed(f"{title}: exit status {code}; {_last_line(output)}; {log}")
        for pattern in expect:
            if not re.search(pattern, output):
                raise Failed(f"{title}: the output lacks {pattern!r}; {log}")
        return output

    def type_page(
        self,
        title: str,
        python: Path,
        page: str,
        names: Mapping[str, object],
        *,
        skip: str = "(?!)",
        **options: Any,
    ) -> str:
        """Type the blocks of a trainer's page as they stand, from top to bottom, in one shell; see
        ``commands_of``.

        Args:
            title: name of the log.
            python: of the environment, whose programs come first.
            page: name of a page of ``docs/how-to/trainers``.
            names: what the reader has in place of names in the page, such as ``{"/data/mix.yaml":
                file}``.
            skip: a regular expression of commands that the reader leaves out; see ``re.search``.
            options: of ``run``.

        Returns:
            The output.

        Raises:
            Failed: if the page lacks one of the names, or a command fails.
        """
        script = "\n".join(
            command for command in commands_of(page) if not re.search(skip, command)
        )
        for name, own in names.items():
            pattern = rf"(?<![\w./-]){re.escape(name)}(?![\w.-])"
            if not re.search(pattern, script):
                raise Failed(f"{title}: {page}.md has no {name!r} in {script!r}")
            script = re.sub(pattern, str(own).replace("\\", r"\\"), script)
        path = {"PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}"}
        return self.run(
            title,
            ["bash", "-euxc", script],
            env=path | dict(options.pop("env", {})),
            **options,
        )

    def row(
        self,
        script: str,
        ran: Sequence[str],
        left_out: str = "",
        *,
        failed: bool = False,
    ) -> Row:
        """A line of the table, with the minutes since the line before."""
        assert set(ran) <= set(STEPS), ran
        now = time.monotonic()
        minutes = (now - self._began) / 60
        self._began = now
        return Row(self.title, script, tuple(ran), left_out, minutes, failed)


def commands_of(page: str) -> list[str]:
    """What the reader of a page of ``docs/how-to/trainers`` types, as commands of a shell, without
    comments.

    Python and YAML whose first line names a file are saved under that name; other Python is run.
    """
    text = (ROOT / "docs" / "how-to" / "trainers" / f"{page}.md").read_text()
    commands: list[str] = []
    for language, code in re.findall(
        r"^```(sh|python|yaml)\n(.*?)^```$", text, re.S | re.M
    ):
        file = re.match(r"# ([\w./-]+\.(?:py|yaml))\b", code)
        if file:
            commands.append(f"cat > {file[1]} <<'END'\n{code}END")
        elif language == "python":
            commands.append(f"python - <<'END'\n{code}END")
        elif language == "sh":
            lines = code.replace("\\\n", " ").splitlines()
            commands += filter(
                None, (re.sub(r"(^|\s+)#.*", "", line) for line in lines)
            )
    return commands


def wheel_of_checkout(folder: Path) -> Path:
    """A wheel of this checkout, built from a copy so that the checkout stays clean, unless the
    folder has one."""
    if not list(folder.glob("lidar_synth-*.whl")):
        source = folder / "source"
        for name in ("lidar_synth", "integrations", "configs", "tools/backend"):
            shutil.copytree(
                ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(ROOT / name, source)
        pip = [
            sys.executable,
            "-m",
            "pip",
            "--disable-pip-version-check",
            "wheel",
            "--quiet",
            "--no-deps",
        ]
        subprocess.run([*pip, "--wheel-dir", folder, source], check=True)
    return next(folder.glob("lidar_synth-*.whl"))


def _environment(further: Mapping[str, str]) -> dict[str, str]:
    """The environment of a command: that of a user, without this interpreter's own variables."""
    own = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LIDAR_SYNTH_MIX")
    return {name: text for name, text in os.environ.items() if name not in own} | dict(
        further
    )


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1][:300] if lines else "no output"
