"""Hook of mkdocs: text that follows from the code is generated when the site is built.

A page has a line ``<!-- generated: NAME -->``; the function of that name in ``GENERATED`` returns what replaces it.
"""

import re
from collections.abc import Callable
from typing import Any

import typer

from lidar_synth.cli import COMMANDS, app
from lidar_synth.train.config import published


def command_line() -> str:
    """The help of every command, in the order of the program's own help."""
    group = typer.main.get_command(app)
    context = typer.Context(group, info_name="lidar-synth")
    parts = []
    for name in COMMANDS:
        command = group.get_command(context, name)  # type: ignore[attr-defined]
        text = command.get_help(typer.Context(command, info_name=name, parent=context))
        parts.append(f"## {name}\n\n```text\n{text.strip()}\n```\n")
    return "\n".join(parts)


def recipes() -> str:
    """The table of ``lidar-synth recipes``."""
    rows = [f"| `{one.name}` | {one.command} | {one.data} | {one.size} | {one.time} |" for one in published()]
    return "\n".join(["| recipe | command | data | parameters | time |", "|---|---|---|---|---|", *rows])


GENERATED: dict[str, Callable[[], str]] = {"command-line": command_line, "recipes": recipes}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs with the Markdown of a page."""
    return re.sub(r"^<!-- generated: (.*?) -->$", lambda found: GENERATED[found[1]](), markdown, flags=re.M)
