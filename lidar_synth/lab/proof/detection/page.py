"""The page of a comparison of detectors, and its table as text."""

from collections.abc import Mapping
from html import escape
from typing import Any

from lidar_synth.lab.proof.detection.summary import CRITERIA, MAIN
from lidar_synth.lab.proof.drawing import differences
from lidar_synth.lab.proof.page import (
    format_number,
    make_cell,
    make_grid,
    make_list,
    make_section,
)
from lidar_synth.lab.proof.summary import format_signed, span

Values = Mapping[str, Any]
NOTE = (
    "Percentage points of the average precision at an overlap of 0.5, against GT sampling. A dot "
    "is the mean over seeds, the bar its 95 % interval (bootstrap over the tested places of "
    "each seed)."
)


def body(values: Values) -> str:
    """The HTML of the page's content."""
    parts = [f"<p>{escape(describe(values))}</p>"]
    for name, found in values["classes"].items():
        drawn = [
            {**found["arms"][arm["arm"]], **arm, "synthetic": True}
            for arm in values["arms"]
        ]
        places = _places(drawn)
        drawn = [{**row, "by_place": _changes(row, drawn[0])} for row in drawn]
        boxes = " and ".join(map(str, found["boxes"]))
        title = f"{name.capitalize()}, {boxes} boxes by seed"
        parts += [
            make_section(title, differences(drawn), NOTE),
            make_section("Average precision, %", _table(drawn)),
            make_section("By place: average precision at an overlap of 0.5, %", places),
        ]
    parts.append(make_section("How it was measured", make_list(protocol(values))))
    return "\n".join(parts)


def describe(values: Values) -> str:
    """One paragraph for a reader who has never seen such a comparison."""
    return (
        f"The same small detector was trained in {len(values['arms'])} ways on the same "
        f"{values['labelled']} with boxes, and tested on places that it had not seen. "
        "Each seed leaves out one half of the places, so that two seeds test on all."
    )


def protocol(values: Values) -> list[str]:
    """The facts that another person needs to repeat it."""
    settings = values["settings"]
    places = [f"{name} ({count})" for name, count in values["places"].items()]
    budgets = [f"{arm['title']}: {arm['budget']}" for arm in values["arms"]]
    return [
        f"Tested places and their scans: {', '.join(places)}.",
        f"Label budget: {values['labelled']} with boxes; besides them, {'; '.join(budgets)}.",
        f"{settings['iterations']} iterations of {settings['batch']} scans, {settings['seeds']} "
        "seeds; boxes with 5 returns have to be found, others may be.",
        f"Sensor: {values['sensor']}. Machine: {values['machine']}. Date: {values['date']}.",
        f"Command: {values['command']}",
    ]


def _table(rows: list[dict[str, Any]]) -> str:
    made = []
    for row in rows:
        cells = [make_cell(row["title"])]
        cells += [make_cell(format_number(row[name])) for name in CRITERIA]
        made.append(f"<tr>{''.join(cells)}</tr>")
    return make_grid(["training", *CRITERIA], made)


def _places(rows: list[dict[str, Any]]) -> str:
    made = []
    for place in rows[0]["by_place"]:
        cells = [make_cell(place)]
        cells += [make_cell(format_number(row["by_place"][place])) for row in rows]
        made.append(f"<tr>{''.join(cells)}</tr>")
    return make_grid(["place", *(row["title"] for row in rows)], made)


def _changes(row: Values, base: Values) -> dict[str, float | None]:
    """{place: change of the average precision}; None without a box."""
    there = base["by_place"]
    return {
        place: None if value is None else value - there[place]
        for place, value in row["by_place"].items()
    }


def format_table(values: Values) -> str:
    """The main figures as Markdown."""
    lines = []
    for name, found in values["classes"].items():
        lines += [
            f"| {name} ({sum(found['boxes'])} boxes) | AP by seed | AP, {MAIN} | difference "
            "| 95 % interval |",
            "|---|---|---:|---:|---|",
        ]
        for arm in values["arms"]:
            row = found["arms"][arm["arm"]]
            cells = [
                arm["title"],
                ", ".join(map(format_number, row["by_seed"])),
                format_number(row[MAIN]),
                format_signed(row["difference"]),
                span(row["interval"]) if row["difference"] is not None else "",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
