"""Markdown pages as the test of the documents sees them: blocks of code, with the comments that say
how they run.

A comment on the line before a block:

- ``<!-- not run: REASON -->``: the block is checked only; ``REASONS`` has the reasons that count.
- ``<!-- slow: --count 8 for --count 20000 -->``: the block runs with the first text in place of the
  second; several replacements are separated by ``;``. With ``LIDAR_SYNTH_DOCS=full`` it runs as it
  is printed.

Anywhere between two blocks, ``<!-- setup: COMMAND -->`` runs a command that the page does not show.
"""

import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

from project import ROOT

TRAINERS = (
    "MMDetection3D|OpenPCDet|Pointcept|RangeNet\\+\\+|SalsaNext|Cylinder3D|Open3D-ML|"
    "WaffleIron|FRNet"
)

REASONS = (
    f"needs the source tree of ({TRAINERS})",
    "needs the trainer's source tree",
    "needs (KITTI-360|SemanticKITTI|KITTI|nuScenes)",
    "needs a (GPU|cluster|network connection|package that is not installed for tests)",
    "needs (released weights|a model of your own)",
    "takes hours",
    "compiles for half an hour",
    "a configuration of the trainer",
    "make target",
)
"""Why a block cannot run in a test; each is a pattern that the whole reason has to match."""

LANGUAGES = {
    "python": "python",
    "py": "python",
    "sh": "shell",
    "bash": "shell",
    "console": "shell",
    "yaml": "yaml",
    "text": "text",
    "bibtex": "text",
    "json": "text",
}
"""Kinds of blocks by the language of the fence. Whatever is neither code nor settings is
``text``."""

STARTS = (
    "lidar-synth ",
    "make ",
    "python tools/",
    "python -m lidar_synth",
    "pip install ",
    "bash tools/",
    "torchrun ",
)
"""How a command in the text begins."""

_PARTS = re.compile(
    r"<!--\s*(?P<mark>not run|slow|setup):\s*(?P<said>.*?)\s*-->"
    r"|^(?P<indent>[ \t]*)(?P<fence>```+)(?P<info>[^\n`]*)\n(?P<code>.*?)^[ \t]*(?P=fence)[ \t]*$",
    re.S | re.M,
)
_NAMED = re.compile(r"\A# ([\w./-]+\.(?:ya?ml|py|sh))\b.*\n")
_TITLE = re.compile(r"title=[\"']([^\"']+)[\"']")


@dataclass(frozen=True)
class Block:
    """One block of code: ``kind`` is a value of ``LANGUAGES``, ``line`` the number of the first
    line of code.

    ``file`` is the name under which the reader saves it: the title of the fence, or a comment in
    the first line.
    """

    kind: str
    code: str
    line: int
    file: str | None = None
    not_run: str | None = None
    slow: str | None = None


def reduced(block: Block) -> str:
    """The code of a slow block in its reduced form; raises ValueError where it does not contain
    what is replaced."""
    code = block.code
    for replacement in (block.slow or "").split(";"):
        new, given, old = replacement.partition(" for ")
        if not given or old.strip() not in code:
            raise ValueError(
                f"line {block.line}: slow: {block.slow!r}, expected NEW for OLD, with OLD in the "
                "block"
            )
        code = code.replace(old.strip(), new.strip())
    return code


def blocks_of(text: str) -> list[Block]:
    """The blocks of a page in order, hidden commands among them.

    Raises:
        ValueError: on a block of no known language, an unknown reason, or a mark that is followed
            by no block.
    """
    blocks = []
    marks = {}
    for part in _PARTS.finditer(text):
        line = text.count("\n", 0, part.start()) + 1
        if part["mark"] == "setup":
            blocks.append(Block("shell", part["said"], line))
        elif part["mark"]:
            marks[part["mark"]] = part["said"]
            if not re.match(r"\s*(<!--|```)", text[part.end() :]):
                raise ValueError(f"line {line}: {part[0]} stands before no block")
        else:
            blocks.append(_block(part, line + 1, marks))
            marks = {}
    return blocks


def _block(part: re.Match[str], line: int, marks: dict[str, str]) -> Block:
    language, _, rest = part["info"].strip().partition(" ")
    if language not in LANGUAGES:
        raise ValueError(
            f"line {line - 1}: a block of {language or 'no language'!r}, none of "
            f"{', '.join(LANGUAGES)}"
        )
    reason = marks.get("not run")
    if reason is not None and not any(re.fullmatch(known, reason) for known in REASONS):
        raise ValueError(
            f"line {line - 1}: not run: {reason!r} is none of the reasons of tests/documents.py"
        )
    code = textwrap.dedent(part["code"])
    if language == "console":
        code = "\n".join(
            said[2:] for said in code.splitlines() if said.startswith("$ ")
        )
    name = _TITLE.search(rest) or _NAMED.match(code)
    return Block(
        LANGUAGES[language],
        code,
        line,
        name[1] if name else None,
        reason,
        marks.get("slow"),
    )


def commands_of(code: str) -> list[str]:
    """The commands of a shell block: lines without comments, joined where a line ends in a
    backslash."""
    lines = re.sub(r"\s*\\\n\s*", " ", code).splitlines()
    return [
        line
        for line in (re.sub(r"(^|\s+)#.*", "", line).strip() for line in lines)
        if line
    ]


def spans_of(text: str) -> list[tuple[int, str]]:
    """(line, command) of every command that stands in the text as `code`."""
    prose = _PARTS.sub(lambda part: "\n" * part[0].count("\n"), text)
    spans = (
        (prose.count("\n", 0, found.start()) + 1, found[1])
        for found in re.finditer(r"`([^`]+)`", prose)
    )
    return [
        (line, " ".join(said.split()))
        for line, said in spans
        if said.startswith(STARTS)
    ]


def words_of(command: str) -> list[str]:
    return shlex.split(command)


PAGES = [
    ROOT / "README.md",
    *(
        page
        for page in sorted(ROOT.glob("docs/**/*.md"))
        if "research" not in page.parts
    ),
]
"""README.md and the pages of docs/ outside docs/research."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()
