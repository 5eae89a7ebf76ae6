"""The page of a comparison: one HTML file that needs no network, for a reader who decides and does
not train."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from lidar_synth.files.disk import write_file
from lidar_synth.lab.proof.arms import BASE
from lidar_synth.lab.proof.drawing import curves, differences
from lidar_synth.lab.proof.summary import format_signed, span

Values = Mapping[str, Any]


def write_body(path: Path, content: str) -> None:
    """Write a page with some HTML as its content.

    Raises:
        FileError: if it cannot be written.
    """
    template = (
        files("lidar_synth.lab.proof").joinpath("page.html").read_text(encoding="utf-8")
    )
    page = template.replace("@body@", content)
    write_file(path, page.encode(errors="replace"))


def body(values: Values) -> str:
    """The HTML of the page's content."""
    first, *rest = re.split(r"(?<=\.) (?=[A-Z])", values["headline"], maxsplit=1)
    parts = [
        f'<p class="headline">{escape(first)}</p>',
        *(f'<p class="more">{escape(text)}</p>' for text in rest),
        f"<p>{escape(what_was_done(values))}</p>",
        make_section(
            "Change of the mIoU against real scans only",
            differences(values["arms"]),
            _DIFFERENCE,
        ),
        make_section("Table", _table(values)),
        make_section(
            "During the training",
            curves(values["arms"]),
            "Mean mIoU on the tested places.",
        )
        if any(len(row["curve"]) > 1 for row in values["arms"])
        else "",
        make_section(
            "IoU by class, %",
            _classes(values),
            "Over all tested scans together. – : no label of this class.",
        ),
        make_section("By place: change of the mIoU", _places(values)),
        make_section("What was not tested", make_list(values["limits"])),
        make_section("How it was measured", make_list(protocol(values))),
    ]
    return "\n".join(filter(None, parts))


_USES = "what it uses"
_DIFFERENCE = (
    "Percentage points. A dot is the mean over places and seeds, the bar its 95 % interval "
    "(bootstrap over places and seeds). Where the bar crosses 0, the difference may be chance."
)


def what_was_done(values: Values) -> str:
    """One paragraph for a reader who has never seen such a comparison."""
    count = len(values["tested_places"])
    if values["left_out"]:
        where = f"each of {count} places was left out in turn"
    else:
        where = f"scans of {count} places that were recorded apart"
    return (
        f"The same network was trained in {len(values['arms'])} ways on the same "
        f"{values['labelled']}, and tested on places that it had not seen: {where}, "
        f"with {values['seeds']} seed{'s' * (values['seeds'] != 1)}. All trainings have the same "
        "iterations and augmentation, unless the table says otherwise. mIoU is the mean over "
        "classes of the share of correctly labelled returns (intersection over union)."
    )


def protocol(values: Values) -> list[str]:
    """The facts that another person needs to repeat it."""
    how = ""
    if values["trainer"] == "reference":
        how = (
            f", grid of {values['settings']['columns']} columns, {values['precision']}; turned and "
            "mirrored at random in all arms"
        )
    used = [
        f"{name} ({facts['scans']} scans, {facts['tested']} tested)"
        for name, facts in values["places"].items()
    ]
    return [
        f"Places: {', '.join(used)}. Tested: {', '.join(values['tested_places'])}.",
        f"Label budget: {values['labelled']} in each training, from as many places "
        "as possible; another "
        "choice with each place and seed. The table says what else an arm uses.",
        f"Trainer: {values['trainer']}; {values['iterations']} iterations of {values['batch']} "
        f"scans{how}.",
        f"Classes: {', '.join(values['classes'])}."
        + (
            f" Not in your labels: {', '.join(values['absent'])}."
            if values["absent"]
            else ""
        ),
        f"Sensor: {values['sensor']}. Machine: {values['machine']}. Date: {values['date']}.",
        f"Command: {values['command']}",
    ]


def _table(values: Values) -> str:
    head = (
        "training",
        "mIoU, %",
        "change",
        "95 % interval",
        "better in",
        "iterations",
        "minutes",
        _USES,
    )
    gains = [
        row["difference"]
        for row in values["arms"]
        if row["difference"] is not None and row["synthetic"]
    ]
    rows = []
    for row in values["arms"]:
        best = bool(gains) and row["synthetic"] and row["difference"] == max(gains)
        cells = [
            make_cell(row["title"]),
            make_cell(f"{row['miou']:.1f}"),
            make_cell(format_signed(row["difference"]), _sign(row)),
            make_cell(span(row["interval"]) if row["arm"] != BASE else ""),
            make_cell(row["better_in"]),
            make_cell(str(row["iterations"])),
            make_cell(f"{row['minutes']:.1f}"),
            make_cell(row["budget"], "text"),
        ]
        rows.append(f"<tr{' class=best' * best}>{''.join(cells)}</tr>")
    return make_grid(head, rows)


def _classes(values: Values) -> str:
    arms = values["arms"]
    rows = []
    for name in arms[0]["iou"]:
        cells = [make_cell(name)]
        cells += [make_cell(format_number(row["iou"][name])) for row in arms]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return make_grid(["class", *(row["title"] for row in arms)], rows)


def _places(values: Values) -> str:
    arms = [row for row in values["arms"] if row["difference"] is not None]
    base = values["arms"][0]
    rows = []
    for place in values["tested_places"]:
        miou = format_number(base["miou_by_place"][place])
        cells = [make_cell(place), make_cell(miou)]
        cells += [make_cell(format_signed(row["by_place"][place])) for row in arms]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return make_grid(
        ["place", f"{base['title']}, mIoU", *(row["title"] for row in arms)], rows
    )


def format_number(value: float | None) -> str:
    """A figure for a reader; – where there is none."""
    return "–" if value is None else f"{value:.1f}"


def make_grid(head: Sequence[str], rows: Sequence[str]) -> str:
    """The HTML of a table."""
    names = "".join(
        f"<th{' class=text' * (name == _USES)}>{escape(name)}</th>" for name in head
    )
    return (
        f'<div class="scroll"><table><thead><tr>{names}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def make_section(title: str, content: str, note: str = "") -> str:
    """The HTML of a part with its title."""
    below = f'<p class="dim">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(title)}</h2>{content}{below}</section>"


def make_list(sentences: Sequence[str]) -> str:
    """The HTML of some sentences."""
    return (
        f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"
    )


def make_cell(text: str, kind: str = "") -> str:
    """The HTML of a cell of a table."""
    return f"<td{f' class={kind}' if kind else ''}>{escape(text)}</td>"


def _sign(row: Values) -> str:
    ends = row["interval"]
    if ends is None or ends[0] <= 0 <= ends[1]:
        return ""
    return "plus" if ends[0] > 0 else "minus"
