"""Published figures beside one's own: ``leaderboard.yaml`` has them with their protocol and
source."""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict

from lidar_synth.lab.evaluate.metric import SIDES, Score


class PublishedTable(BaseModel):
    """Figures that one paper reports together.

    Args:
        protocol: a name of ``PROTOCOLS``.
        task: what was generated.
        dataset: that the scans are compared with.
        source: a key of the sources.
        note: what else is known of them.
        rows: {"method": name, "steps": network evaluations if known, name of a figure: its value in
            the table}.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    protocol: str
    task: str
    dataset: str
    source: str
    note: str = ""
    rows: tuple[Mapping[str, Any], ...]


@cache
def leaderboard() -> tuple[tuple[PublishedTable, ...], Mapping[str, str]]:
    """All tables, and {source: what it is}."""
    text = (
        files("lidar_synth.lab.evaluate")
        .joinpath("leaderboard.yaml")
        .read_text(encoding="utf-8")
    )
    values = yaml.safe_load(text)
    return tuple(PublishedTable(**table) for table in values["tables"]), values[
        "sources"
    ]


def compare_published(scores: Sequence[Score]) -> str:
    """The published figures of the scores' protocol as tables in Markdown, each with the scores as
    its last row, which says how many scans they are of."""
    named = {score.table: score for score in scores if score.table}
    tables, sources = leaderboard()
    counts = ", ".join(
        f"{max((getattr(s, side) for s in scores), default=0)} {side}" for side in SIDES
    )
    parts = []
    for table in (t for t in tables if scores and t.protocol == scores[0].protocol):
        longest_first = sorted(table.rows, key=len, reverse=True)
        columns = list(
            dict.fromkeys(
                key
                for row in longest_first
                for key in row
                if key not in ("method", "steps")
            )
        )
        head = [
            f"| method | steps | {' | '.join(columns)} |",
            f"|---|---:|{'---:|' * len(columns)}",
        ]
        rows = [
            f"| {row['method']} | {row.get('steps', '')} | "
            f"{' | '.join(str(row.get(c, '')) for c in columns)} |"
            for row in table.rows
        ]
        own = " | ".join(_shown(named[c]) if c in named else "" for c in columns)
        where = f"{table.dataset}, {table.task}. {sources[table.source]}. {table.note}".rstrip(
            ". "
        )
        parts.append(
            "\n".join(
                [
                    f"{where}.",
                    "",
                    *head,
                    *rows,
                    f"| **these scans** ({counts}) | | {own} |",
                ]
            )
        )
    return "\n\n".join(parts) or "No published figures of this protocol are known."


def _shown(score: Score) -> str:
    value = f"{score.value * score.times:.4g}"
    if score.low is None or score.high is None:
        return value
    return f"{value} [{score.low * score.times:.4g}, {score.high * score.times:.4g}]"
