"""Panels of the HTML page: the samples of a mixture, and a table of classes.

Each function returns HTML for the argument ``panels`` of ``html_page``, whose style sheet it relies
on.
"""

import html
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import NAMES
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.viz.scales import DOMAINS


def mixture_panel(
    domains: Sequence[int], names: Sequence[str], notes: Sequence[str] = ()
) -> str:
    """The samples of an epoch in their order, each as a square in the colour of its domain.

    Args:
        domains: of the samples: 0 = real, 1 = synthetic.
        names: what the panel calls the two domains.
        notes: paragraphs below.
    """
    counts = [sum(domain == d for domain in domains) for d in (0, 1)]
    squares = "".join(
        _swatch(d, f"sample {i}: {names[d]}") for i, d in enumerate(domains)
    )
    share = 100 * counts[1] / max(len(domains), 1)
    text = (
        f"{len(domains)} samples in training order: {_swatch(0)}{counts[0]} "
        f"{html.escape(names[0])}, "
    )
    text += f"{_swatch(1)}{counts[1]} {html.escape(names[1])} ({share:.0f} %)."
    return _panel(
        "Samples of an epoch",
        f'<div class="samples">{squares}</div><p>{text}</p>',
        notes,
    )


def classes_panel(
    columns: Mapping[str, NDArray[np.floating]], notes: Sequence[str] = ()
) -> str:
    """A table with one row for each class and one column for each quantity.

    Args:
        columns: (19,) values in [0, 1] of each quantity, NaN = unknown. Classes for which all are 0
            or unknown are left out; the first column orders the rows.
        notes: paragraphs below.
    """
    values = np.stack(list(columns.values()))
    order = np.argsort(-np.nan_to_num(values[0]), kind="stable")
    head = "".join(f"<th>{html.escape(name)}</th>" for name in ["class", *columns])
    body = "".join(
        f'<tr><td><i style="background:rgb({",".join(map(str, COLOURS[i]))})"></i>{NAMES[i]}</td>'
        + "".join(f"<td>{_percent(value)}</td>" for value in values[:, i])
        + "</tr>"
        for i in order
        if np.nan_to_num(values[:, i]).any()
    )
    return _panel(
        "By class",
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>",
        notes,
    )


def _panel(title: str, body: str, notes: Sequence[str]) -> str:
    paragraphs = "".join(f'<p class="dim">{html.escape(note)}</p>' for note in notes)
    return f'<section class="panel"><h2>{html.escape(title)}</h2>{body}{paragraphs}</section>'


def _colour(domain: int) -> str:
    return f"rgb({','.join(map(str, list(DOMAINS.values())[domain]))})"


def _swatch(domain: int, title: str = "") -> str:
    shown = f' title="{html.escape(title)}"' if title else ""
    return f'<i style="background:{_colour(domain)}"{shown}></i>'


def _percent(share: float) -> str:
    if np.isnan(share):
        return "–"
    return "&lt;0.1" if 0 < share < 0.0005 else f"{100 * share:.1f}"
