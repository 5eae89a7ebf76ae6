"""Published figures beside one's own: ``published.yaml`` has them with their protocol and
source."""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict

from lidar_synth.lab.evaluate.loop_metric import SIDES, Score


class PublishedTable(BaseModel):
    """Figures that one paper reports together.

    Args:
        protocol: a name of ``PROTOCOLS``.
        task: what was generated.
        dataset: that the scans are compared with.
        source: a key of the sources.
        note: what else is known of them.
        beside: whether it is printed beside one's own figures by ``compare_published``.
        key: "TABLE/TASK" of ``lab.reproduce`` for the paper's own.
        rows: {"method": name, "steps": network evaluations if known, name of a figure: its value in
            the table}.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    protocol: str
    task: str
    dataset: str
    source: str
    note: str = ""
    beside: bool = True
    key: str = ""
    rows: tuple[Mapping[str, Any], ...]


@cache
def read_published() -> tuple[tuple[PublishedTable, ...], Mapping[str, str]]:
    """All tables, and {source: what it is}."""
    text = (
        files("lidar_synth.lab.evaluate")
        .joinpath("published.yaml")
        .read_text(encoding="utf-8")
    )
    values = yaml.safe_load(text)
    tables = tuple(PublishedTable(**table) for table in values["tables"])
    return tables, values["sources"]


def compare_published(scores: Sequence[Score]) -> str:
    """The published figures of the scores' protocol as tables in Markdown, each with the scores as
    its last row, which says how many scans they are of."""
    counts = ", ".join(
        f"{max((getattr(s, side) for s in scores), default=0)} {side}" for side in SIDES
    )
    own = {f"**these scans** ({counts}) |": scores}
    parts = [
        show_table(table, own)
        for table in read_published()[0]
        if scores and table.beside and table.protocol == scores[0].protocol
    ]
    return "\n\n".join(parts) or "No published figures of this protocol are known."


def _list_columns(table: PublishedTable) -> list[str]:
    """The metrics of a table, in the order of its rows of most metrics."""
    longest_first = sorted(table.rows, key=len, reverse=True)
    names = dict.fromkeys(key for row in longest_first for key in row)
    return [name for name in names if name not in ("method", "steps")]


def show_table(table: PublishedTable, own: Mapping[str, Sequence[Score]]) -> str:
    """A published table in Markdown, with rows of one's own below: {"method | steps": scores}."""
    columns = _list_columns(table)
    source = read_published()[1][table.source]
    where = f"{table.dataset}, {table.task}. {source}. {table.note}".rstrip(". ")
    lines = [
        f"{where}.",
        "",
        f"| method | steps | {' | '.join(columns)} |",
        f"|---|---:|{'---:|' * len(columns)}",
    ]
    for row in table.rows:
        cells = [row["method"], row.get("steps", "")]
        cells += [row.get(column, "") for column in columns]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    for name, scores in own.items():
        named = {
            score.table: score.shown(score.times) for score in scores if score.table
        }
        figures = " | ".join(named.get(column, "") for column in columns)
        lines.append(f"| {name} | {figures} |")
    return "\n".join(lines)
