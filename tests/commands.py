"""The commands that documents print, checked without running them: options, recipes, modules,
extras, targets.

``check`` parses a command by the program's own parser wherever there is one.
"""

import argparse
import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import typer.main
from project import PYPROJECT, ROOT

from lidar_synth.bake import ENGINES, BakeJob
from lidar_synth.cli import app
from lidar_synth.formats import WRITERS
from lidar_synth.lab.evaluate import PROTOCOLS
from lidar_synth.lab.train import DistillConfig, TrainConfig, load_config, plan_model
from lidar_synth.lab.train.config import published_models, read_values, validate

PLAIN = (
    ".",
    "apt-get",
    "cat",
    "cd",
    "cp",
    "docker",
    "export",
    "git",
    "ln",
    "ls",
    "mkdir",
    "printf",
    "source",
    "sudo",
    "unzip",
    "wget",
)
"""Commands of the shell and of the system, whose arguments are not checked."""


class WrongCommand(AssertionError):
    """What is wrong with a command of a document."""


class _Parsed(BaseException):
    """Raised in place of the work of a script, once its arguments are parsed."""


def parts_of(command: str) -> list[list[str]]:
    """The words of each program that a line starts, without assignments before it and redirections
    behind it."""
    parts: list[list[str]] = [[]]
    lexer = shlex.shlex(command, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    lexer.commenters = ""
    words = iter(lexer)
    for word in words:
        if set(word) <= set("&|;") and word:
            parts.append([])
        elif set(word) <= set("<>") and word:
            next(words, None)
        elif parts[-1] or not re.match(r"[A-Z_0-9]+=", word):
            parts[-1].append(word)
    return [part for part in parts if part]


def check(command: str, folder: Path | None = None) -> None:
    """Refuse a command that cannot work.

    Args:
        command: one line, as a document prints it.
        folder: where it would run, with the files that the reader has saved; without it, files are
            not looked for.

    Raises:
        WrongCommand: on an unknown program, option, target, extra, recipe, module or script.
    """
    for program, *words in parts_of(command):
        if program in CHECKS:
            CHECKS[program](words, folder)
        elif program not in PLAIN:
            raise WrongCommand(
                f"{program!r} in {command!r} is none of {', '.join([*CHECKS, *PLAIN])}"
            )


def lidar_synth(words: list[str], folder: Path | None) -> None:
    """``lidar-synth``: by its own parser, and its settings by the model that reads them."""
    given: dict[str, dict[str, Any]] = {}
    root = typer.main.get_command(app)
    _record(root, "", given)
    try:
        root.main(args=list(words), prog_name="lidar-synth", standalone_mode=False)
        for name, values in given.items():
            VALUES.get(name, lambda values, folder: None)(values, folder)
    except Exception as error:
        said = error.format_message() if hasattr(error, "format_message") else error
        raise WrongCommand(f"lidar-synth {shlex.join(words)}: {said}") from error


def _record(command: Any, name: str, given: dict[str, dict[str, Any]]) -> None:
    """Make a command, and those below it, note their values under their name instead of working."""
    for word, below in getattr(command, "commands", {}).items():
        _record(below, f"{name} {word}".strip(), given)
    if not hasattr(command, "commands"):
        command.callback = lambda **values: given.update({name: values})


def _config(kind: Any) -> Callable[[dict[str, Any], Path | None], None]:
    def load(values: dict[str, Any], folder: Path | None) -> None:
        recipe = values["recipe"]
        if recipe.endswith((".yaml", ".yml")):
            if folder is None:
                return
            recipe = folder / recipe
        load_config(
            kind, recipe, [os.path.expandvars(o) for o in values["overrides"] or ()]
        )

    return load


def _train(values: dict[str, Any], folder: Path | None) -> None:
    if values["recipe"] in {one.name for one in published_models()}:
        plan_model(
            values["recipe"],
            values["overrides"] or (),
            values["minutes"],
            values["until"],
        )
    else:
        _config(TrainConfig)(values, folder)


def _bake(values: dict[str, Any], folder: Path | None) -> None:
    file = values["config"]
    settings = (
        {}
        if file is None
        else read_values(folder / file if folder and file.suffix else file, BakeJob)
    )
    settings |= {
        key: value
        for key, value in values.items()
        if key in BakeJob.model_fields and value is not None
    }
    validate(BakeJob, settings, "bake")
    if values["engine"] is not None:
        _one_of("engine", (*ENGINES,))(values, folder)


def _one_of(
    option: str, known: tuple[str, ...]
) -> Callable[[dict[str, Any], Path | None], None]:
    def compare(values: dict[str, Any], folder: Path | None) -> None:
        if values[option] not in known:
            raise WrongCommand(
                f"--{option} {values[option]!r} is none of {', '.join(known)}"
            )

    return compare


VALUES: dict[str, Callable[[dict[str, Any], Path | None], None]] = {
    "train": _train,
    "distill": _config(DistillConfig),
    "bake": _bake,
    "town": _one_of("layout", ("kitti360", "semantic_kitti", "kitti", "kitti_object")),
    "convert": _one_of("to", (*WRITERS,)),
    "sample": _one_of("to", (*WRITERS,)),
    "evaluate": _one_of("protocol", (*PROTOCOLS,)),
}
"""What a command reads from its options by itself."""


def python(words: list[str], folder: Path | None) -> None:
    """``python FILE``, ``python -m MODULE`` or ``python -c CODE``."""
    if not words or words[0] == "-c":
        compile(words[1] if words else "", "-c", "exec")
    elif words[:2] == ["-m", "lidar_synth"]:
        lidar_synth(words[2:], folder)
    elif words[0] == "-m":
        if importlib.util.find_spec(words[1]) is None:
            raise WrongCommand(f"python -m {words[1]}: there is no such module")
    elif (ROOT / words[0]).is_file():
        _script(ROOT / words[0], words[1:], folder)
    elif folder is not None and not (folder / words[0]).is_file():
        raise WrongCommand(
            f"python {words[0]}: neither a file of the repository nor one that the page shows"
        )


def _script(path: Path, words: list[str], folder: Path | None) -> None:
    """A script of the repository, by the parser in it; without one, that it compiles."""
    parse = argparse.ArgumentParser.parse_args

    def parsed(parser: argparse.ArgumentParser) -> None:
        parse(parser)
        raise _Parsed

    def called(program: typer.Typer) -> None:
        command = typer.main.get_command(program)
        _record(command, "", {})
        command.main(list(words), path.name)

    text = path.read_text()
    compile(text, str(path), "exec")
    if "from lidar_synth.cli import main" in text:
        lidar_synth([path.stem, *words], folder)
    elif "parse_args" in text or "typer" in text:
        with (
            mock.patch.object(argparse.ArgumentParser, "parse_args", parsed),
            mock.patch.object(typer.Typer, "__call__", called),
            mock.patch.object(sys, "argv", [str(path), *words]),
            mock.patch.object(sys, "path", [str(path.parent), *sys.path]),
        ):
            try:
                runpy.run_path(str(path), run_name="__main__")
            except SystemExit as stop:
                if stop.code:
                    raise WrongCommand(
                        f"{path.name} {shlex.join(words)}: wrong arguments"
                    ) from stop
                return
            except _Parsed:
                return
            raise WrongCommand(f"{path.name} has not parsed its arguments")


def torchrun(words: list[str], folder: Path | None) -> None:
    """``torchrun OPTIONS -m MODULE ...``: its own parser, then the module's."""
    from torch.distributed.run import get_args_parser

    try:
        given = get_args_parser().parse_args(words)
    except SystemExit as stop:
        raise WrongCommand(f"torchrun {shlex.join(words)}: wrong arguments") from stop
    python(
        ["-m"] * given.module + [given.training_script, *given.training_script_args],
        folder,
    )


def make(words: list[str], folder: Path | None) -> None:
    """``make TARGET VARIABLE=value``, against the Makefile."""
    text = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([\w-]+):", text, re.M))
    variables = set(re.findall(r"^(\w+) *(?:\?|:)?=", text, re.M))
    for word in words:
        name, equals, _ = word.partition("=")
        if name not in (variables if equals else targets):
            raise WrongCommand(
                f"make {word}: the Makefile has "
                f"{', '.join(sorted(variables if equals else targets))}"
            )


def pip(words: list[str], folder: Path | None) -> None:
    """``pip install ...``, the extras of this package against pyproject.toml."""
    if words[0] != "install":
        raise WrongCommand(f"pip {words[0]}: not known to the test")
    own = [
        found
        for word in words
        if (found := re.fullmatch(r"(?:\./)?(?:\.|lidar[-_]synth)(?:\[(.*)\])?", word))
    ]
    extras = {
        extra.strip() for found in own for extra in (found[1] or "").split(",")
    } - {""}
    if unknown := extras - set(PYPROJECT["project"]["optional-dependencies"]):
        raise WrongCommand(
            f"pip install: extras {sorted(unknown)} are not in pyproject.toml"
        )


def bash(words: list[str], folder: Path | None) -> None:
    """``bash SCRIPT``: a script of the repository that bash can read."""
    run = subprocess.run(
        ["bash", "-n", words[0]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if run.returncode:
        raise WrongCommand(f"bash {words[0]}: {run.stderr}")


CHECKS: dict[str, Callable[[list[str], Path | None], None]] = {
    "lidar-synth": lidar_synth,
    "python": python,
    "python3": python,
    "torchrun": torchrun,
    "make": make,
    "pip": pip,
    "bash": bash,
}
"""How the arguments of each program are checked."""

NEVER_RUN = (
    "make",
    "pip",
    "git",
    "apt-get",
    "sudo",
    "docker",
    "source",
    ".",
    "wget",
    "unzip",
)
"""Programs that a test never runs: they install, download, or run these tests themselves."""
