"""Two drawings in SVG: differences with their intervals, and curves of the trainings."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

WIDTH = 980
LEFT = 300
RIGHT = 40
ROW = 30
COLOURS = (
    "#7a8494",
    "#1f6feb",
    "#11733a",
    "#b3261e",
    "#8a4fd3",
    "#c77700",
    "#0b7285",
    "#a1286a",
    "#5c6f00",
    "currentColor",
)


def differences(arms: Sequence[Mapping[str, Any]]) -> str:
    """A line for each arm but the first: the mean difference, and its interval."""
    shown = [row for row in arms if row["difference"] is not None]
    if not shown:
        return ""
    ends = [v for row in shown for v in (row["difference"], *(row["interval"] or ()))]
    low = min(-1.0, *ends)
    high = max(1.0, *ends)
    margin = 0.06 * (high - low)
    low = low - margin
    high = high + margin

    def x(value: float) -> float:
        return float(LEFT + (WIDTH - LEFT - RIGHT) * (value - low) / (high - low))

    height = ROW * len(shown) + 30
    parts = [
        f'<div class="scroll"><svg viewBox="0 0 {WIDTH} {height}" '
        'role="img" aria-label="differences">'
    ]
    for tick in ticks(low, high):
        colour, width = ("var(--ink)", 1.4) if tick == 0 else ("var(--line)", 1)
        parts.append(
            f'<line x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="4" y2="{height - 22}" '
            f'stroke="{colour}" stroke-width="{width}"/><text x="{x(tick):.1f}" '
            f'y="{height - 6}" text-anchor="middle" fill="var(--dim)">{tick:+g}</text>'
        )
    for number, row in enumerate(shown):
        y = 4 + ROW * (number + 0.5)
        colour = "#1f6feb" if row["synthetic"] else "#7a8494"
        parts.append(
            f'<text x="{LEFT - 14}" y="{y + 4:.1f}" text-anchor="end">'
            f"{html.escape(row['title'])}</text>"
        )
        if row["interval"] is not None:
            a, b = row["interval"]
            parts.append(
                f'<line x1="{x(a):.1f}" x2="{x(b):.1f}" y1="{y:.1f}" y2="{y:.1f}" '
                f'stroke="{colour}" stroke-width="5" stroke-opacity=".35" stroke-linecap="round"/>'
            )
        parts += [
            f'<circle cx="{x(v):.1f}" cy="{y:.1f}" r="2.5" fill="{colour}" fill-opacity=".45"/>'
            for v in row["by_place"].values()
            if v is not None and low <= v <= high
        ]
        parts.append(
            f'<circle cx="{x(row["difference"]):.1f}" cy="{y:.1f}" r="6" fill="{colour}"/>'
        )
    return "".join([*parts, "</svg></div>"])


def curves(arms: Sequence[Mapping[str, Any]]) -> str:
    """The mean mIoU over the iterations, a line for each arm; dashed with real scans only."""
    shown = [row for row in arms if len(row["curve"]) > 1]
    if not shown:
        return ""
    last = max(step for row in shown for step, _ in row["curve"])
    top = max(value for row in shown for _, value in row["curve"]) * 1.08
    left = 46
    bottom = 300
    width = 560
    height = 280

    def at(step: float, value: float) -> str:
        return f"{left + width * step / last:.1f},{bottom - height * value / top:.1f}"

    legend = 24 * len(shown)
    parts = [
        f'<div class="scroll"><svg viewBox="0 0 {WIDTH} {max(bottom + 34, legend + 20)}" '
        'role="img" aria-label="mIoU by iterations">'
    ]
    for tick in ticks(0, top):
        y = bottom - height * tick / top
        parts.append(
            f'<line x1="{left}" x2="{left + width}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="var(--line)"/><text x="{left - 8}" y="{y + 4:.1f}" '
            f'text-anchor="end" fill="var(--dim)">{tick:g}</text>'
        )
    for tick in ticks(0, last):
        x = left + width * tick / last
        parts.append(
            f'<text x="{x:.1f}" y="{bottom + 18}" text-anchor="middle" '
            f'fill="var(--dim)">{tick:g}</text>'
        )
    parts.append(
        f'<text x="{left + width / 2}" y="{bottom + 33}" text-anchor="middle" '
        'fill="var(--dim)">iterations</text>'
    )
    for number, row in enumerate(shown):
        colour = COLOURS[number % len(COLOURS)]
        dash = "" if row["synthetic"] else ' stroke-dasharray="5 4"'
        line = " ".join(at(step, value) for step, value in row["curve"])
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"{dash}/>'
        )
        y = 18 + 24 * number
        parts.append(
            f'<line x1="{left + width + 24}" x2="{left + width + 50}" y1="{y}" y2="{y}" '
            f'stroke="{colour}" stroke-width="2"{dash}/>'
        )
        words = html.escape(
            row["title"] if len(row["title"]) < 48 else row["title"][:46] + " …"
        )
        parts.append(f'<text x="{left + width + 58}" y="{y + 4}">{words}</text>')
    return "".join([*parts, "</svg></div>"])


def ticks(low: float, high: float) -> list[float]:
    """About six round numbers from ``low`` to ``high``."""
    step = 10.0 ** np.floor(np.log10((high - low) / 5))
    step *= next(k for k in (1, 2, 5, 10) if (high - low) / (k * step) <= 7)
    first = int(np.ceil(low / step))
    return [
        round(float(k * step), 6) for k in range(first, int(np.floor(high / step)) + 1)
    ]
