"""Every block of code and every command of README.md and docs/ runs, or is checked and says why it
does not run.

The blocks of one page share a folder and, for Python, one namespace, from top to bottom.
``documents.py`` has the marks that a page may set. Pages find a small town where theirs would lie
(``DATASETS``), made once.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import NEVER_RUN, WrongCommand, check, parts_of
from documents import PAGES, Block, blocks_of, commands_of, name_of, reduced, spans_of
from pandaset_files import write_pandaset
from snippets import check_python, check_yaml

from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.cli import COMMANDS, main
from lidar_synth.lab.town import Town, export_town

NAMES = (
    *COMMANDS,
    "bank",
    "merge",
    "split",
    "head",
    "sensor",
    "skin",
    "fit",
    "show",
    "metrics",
    "setup",
)
FULL = os.environ.get("LIDAR_SYNTH_DOCS") == "full"
SCANS = 6

pytestmark = pytest.mark.usefixtures("one_thread")


def _town(layout: str) -> Callable[[Path], object]:
    """The town on the grid of the shipped models."""
    town = Town(0, "hdl64e_lasers", SCANS)
    return lambda out: export_town(town, out, layout, camera=False, progress=False)


def _semantic_kitti(out: Path) -> None:
    """A few real scans where there are some, otherwise the town in the same layout."""
    real = os.environ.get("LIDAR_SYNTH_LABELLED_SCANS")
    if not real:
        _town("semantic_kitti")(out)
        return
    for sequence in ("00", "01"):
        source = Path(real) / "semantic_kitti" / "sequences" / sequence
        target = out / "sequences" / sequence
        for folder in ("velodyne", "labels"):
            (target / folder).mkdir(parents=True)
            for path in sorted((source / folder).iterdir())[:2]:
                shutil.copy(path, target / folder)
        for path in source.glob("*.txt"):
            shutil.copy(path, target)


DATASETS: dict[str, Callable[[Path], object]] = {
    "demo_out/town": _town("semantic_kitti"),
    "demo_out/bank": lambda out: bake(
        make_plan(out, BakeJob(count=8, seed=1)), progress=False
    ),
    "SemanticKITTI": _semantic_kitti,
    "KITTI-360": _town("kitti360"),
    "KITTI": _town("kitti"),
    "PandaSet": write_pandaset,
}
"""What pages name without making it: town and bank as ``make demo`` leaves them, and a dataset in
each layout."""


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of one of ``DATASETS``, made at its first use."""
    root = tmp_path_factory.mktemp("documents")

    def make(name: str) -> Path:
        out = root / name
        if not out.exists():
            pytest.importorskip("embreex")
            out.parent.mkdir(exist_ok=True)
            DATASETS[name](out)
        return out

    return make


def named_in(blocks: list[Block]) -> list[str]:
    """The datasets that the blocks name, without those that a command among them writes."""
    code = "\n".join(block.code for block in blocks)
    words = {
        name
        for name in DATASETS
        if re.search(rf"(?<![\w./-]){re.escape(name)}(?![\w-])", code)
    }
    return sorted(
        name
        for name in words
        if not re.search(rf"lidar-synth (?:town|bake) +{re.escape(name)}\b", code)
    )


class Reader:
    """Someone who types the blocks of one page, in one folder, from top to bottom."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.monkeypatch = monkeypatch
        self.names: dict[str, Any] = {"__name__": "__main__"}
        monkeypatch.chdir(folder)
        monkeypatch.setenv(
            "PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        )

    def read(self, page: Path, block: Block) -> None:
        """Save or run a block; check it alone where it is not run."""
        code = reduced(block) if block.slow and not FULL else block.code
        if block.file:
            (self.folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / block.file).write_text(code)
        if block.kind == "yaml":
            check_yaml(code, self.folder / (block.file or "block.yaml"))
        elif block.kind == "python" and (block.not_run or block.file):
            check_python(code)
        elif block.kind == "python":
            exec(compile("\n" * (block.line - 1) + code, str(page), "exec"), self.names)
        elif block.kind == "shell":
            for command in commands_of(code):
                check(command, None if block.not_run else Path.cwd())
                if not block.not_run:
                    self.run(command)

    def run(self, command: str) -> None:
        """A command, in this process where it is ``lidar-synth`` and needs no shell: the same entry
        point."""
        parts = parts_of(command)
        words = shlex.split(command)
        if any(part[0] in NEVER_RUN for part in parts):
            return
        if words[0] == "cd":
            self.monkeypatch.chdir(os.path.expandvars(words[1]))
        elif words[0] == "export":
            self.monkeypatch.setenv(*words[1].split("=", 1))
        elif (
            parts == [words]
            and words[0] == "lidar-synth"
            and not set(command) & set("$*~`")
        ):
            self.monkeypatch.setattr(sys, "argv", words)
            with pytest.raises(SystemExit) as stop:
                main()
            assert not stop.value.code, f"{command}: exit status {stop.value.code}"
        else:
            subprocess.run(["bash", "-euo", "pipefail", "-c", command], check=True)


@pytest.fixture
def untouched() -> Any:
    """torch's global settings as they were, whatever a page does with them."""
    threads = torch.get_num_threads()
    state = torch.get_rng_state()
    yield
    torch.set_num_threads(threads)
    torch.set_rng_state(state)


def marked(page: Path) -> list[Block]:
    return [block for block in blocks_of(page.read_text()) if block.not_run]


NOT_RUN = [(page, block) for page in PAGES for block in marked(page)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```" in page.read_text()], ids=name_of
)
def test_the_blocks_of_a_page_run(
    page: Path,
    tmp_path: Path,
    made: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    untouched: None,
) -> None:
    blocks = blocks_of(page.read_text())
    for name in named_in([block for block in blocks if not block.not_run]):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copytree(made(name), tmp_path / name)
    read(page, blocks, Reader(tmp_path, monkeypatch))


def read(page: Path, blocks: list[Block], reader: Reader) -> None:
    """Read all blocks; an error says where it is on the page."""
    for block in blocks:
        try:
            reader.read(page, block)
        except Exception as error:
            raise AssertionError(
                f"{page.name}, line {block.line}: {error!r}"
            ) from error


@pytest.mark.parametrize(
    ("page", "block"),
    NOT_RUN,
    ids=[f"{name_of(page)}:{block.line}" for page, block in NOT_RUN],
)
def test_a_block_that_is_not_run_says_why(page: Path, block: Block) -> None:
    """The list of these blocks: ``pytest -rs`` prints it. The test of their page checks what can be
    checked."""
    pytest.skip(f"checked, not run: {block.not_run}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_commands_in_the_text_of_a_page_are_right(page: Path) -> None:
    for line, command in spans_of(page.read_text()):
        words = command.split()[1:]
        if words and all(word in NAMES for word in words):
            continue  # the command's name, not a call
        try:
            check(command)
        except WrongCommand as error:
            raise AssertionError(f"{name_of(page)}, line {line}: {error}") from error
