"""Figures with matplotlib: all views of one scan, several scans side by side, or histograms of many
scans.

Figures are created without pyplot, so they change no global state and need no screen.
"""

from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.datasets.classes import NAMES
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.viz.images import View, picture, views
from lidar_synth.viz.render import Camera, bird, render
from lidar_synth.viz.scales import DOMAINS, EMPTY, Rgb, Scale, make_scales

BACK = tuple(EMPTY / 255)
INK = "#e8eaf0"
DIM = "#9aa0ad"
_DPI = 100


def sheet(
    given: Scan | RangeImage, *, camera: Camera | None = None, extent: float = 50.0
) -> Figure:
    """All views of one scan: in perspective, from above, and every channel of its range image.

    Args:
        given: a scan, or a range image, which is unprojected to points.
        camera: the camera of the perspective view; by default that of ``Orbit()``.
        extent: metres on each side of the sensor that the view from above shows.

    Returns:
        A figure; write it with ``figure.savefig``.
    """
    [view] = views([given])
    colours = make_scales([view.scan])
    by = "label" if view.scan.label is not None else "height"
    legend = 0.5 if by == "label" else 0.1
    heights = [6.2, *[1.45] * len(view.channels), legend]
    height = sum(heights) + 0.7
    figure = new_figure(17.0, height)
    grid = figure.add_gridspec(
        len(heights),
        2,
        width_ratios=[2, 1],
        height_ratios=heights,
        hspace=0.34,
        wspace=0.1,
        left=0.045,
        right=0.945,
        bottom=0.01,
        top=1 - 0.75 / height,
    )
    _write_head(figure, caption(view.scan), 0.045, 1 - 0.28 / height)
    _perspective(figure.add_subplot(grid[0, 0]), view, by, colours[by], camera)
    _from_above(figure.add_subplot(grid[0, 1]), view, colours["height"], extent)
    for row, channel in enumerate(view.channels, 1):
        _image(figure.add_subplot(grid[row, :]), view, channel, colours[channel])
    if by == "label":
        _legend(figure, [view], colours[by].table)
    return figure


def contact_sheet(
    given: Sequence[Scan | RangeImage],
    *,
    columns: int | None = None,
    by: str | None = None,
    title: str = "",
) -> Figure:
    """Several scans side by side: each one in perspective above its range image (and its label
    image, if labels colour the points).

    Args:
        given: scans or range images, at least one.
        columns: tiles per row; by default the sheet is about square.
        by: the quantity that colours the points, one of ``scales.VALUES``; by default labels if all
            scans have them, otherwise heights.
        title: the title line.

    Raises:
        ConfigError: without scans, or if a scan does not have the quantity.
        DataError: as ``images.views``.
    """
    all_views = views(given)
    colours = make_scales([view.scan for view in all_views])
    by = by or (
        "label" if all(view.scan.label is not None for view in all_views) else "height"
    )
    columns = columns or int(np.ceil(np.sqrt(len(given))))
    rows = -(-len(given) // columns)
    width = 4.6 * columns
    legend = (
        0.25 + 0.22 * -(-(len(NAMES) + 1) // _per_row(width)) if by == "label" else 0.1
    )
    strips = ("range", "label") if by == "label" else ("range",)
    height = (3.2 + 0.6 * len(strips)) * rows + 0.5 + legend
    figure = new_figure(width, height)
    grid = figure.add_gridspec(
        rows,
        columns,
        hspace=0.11,
        wspace=0.03,
        left=0.01,
        right=0.99,
        bottom=legend / height,
        top=1 - 0.72 / height,
    )
    _write_head(figure, title, 0.01, 1 - 0.25 / height)
    for place, view in enumerate(
        tqdm(all_views, "drawing", unit="scan", leave=False, disable=len(given) < 4)
    ):
        tile = grid[place].subgridspec(
            1 + len(strips), 1, height_ratios=[5, *[1] * len(strips)], hspace=0.02
        )
        panels: Any = tile.subplots()
        above, *below = panels
        _show_pixels(above, render(view.scan, by, size=(900, 540), scale=colours[by]))
        for axes, channel in zip(below, strips, strict=True):
            _show_pixels(axes, picture(view.image, channel, colours[channel]))
        above.set_title(
            caption(view.scan, short=True),
            color=DIM,
            fontsize=9,
            loc="left",
            pad=3,
            parse_math=False,
        )
    if by == "label":
        _legend(figure, all_views, colours[by].table)
    return figure


def histograms(
    values: Mapping[str, NDArray[np.floating]],
    meanings: Mapping[str, str],
    marked: NDArray[np.bool_],
    title: str = "",
) -> Figure:
    """Histograms of measures of many scans, with some of the scans highlighted.

    Args:
        values: {name of a measure: (N,)}, at least one.
        meanings: {name of a measure: what it means}, shown below its histogram.
        marked: (N,) the scans to show in a second colour, stacked on top.
        title: the title line.
    """
    columns = min(len(values), 4)
    rows = -(-len(values) // columns)
    height = 3.1 * rows + 0.6
    figure = new_figure(4.6 * columns, height)
    grid = figure.add_gridspec(
        rows,
        columns,
        hspace=0.55,
        wspace=0.14,
        left=0.2 / columns,
        right=0.99,
        bottom=0.7 / height,
        top=1 - 0.9 / height,
    )
    _write_head(figure, title, 0.01, 1 - 0.3 / height)
    for place, (name, numbers) in enumerate(values.items()):
        axes = figure.add_subplot(grid[place], facecolor=BACK)
        colours = [
            tuple((np.array(colour) / 255).tolist()) for colour in DOMAINS.values()
        ]
        axes.hist(
            [numbers[~marked], numbers[marked]], bins=60, stacked=True, color=colours
        )
        # A logarithmic scale keeps a single scan among thousands visible.
        axes.set_yscale("symlog", linthresh=1)
        style_axes(
            axes,
            name,
            "\n".join(wrap(meanings[name], 52)),
            "" if place % columns else "scans",
        )
    return figure


def caption(scan: Scan, short: bool = False) -> str:
    """A caption for a scan: id, sensor, domain, number of points; ``short``: id, domain and
    augmentations, in at most 55 characters."""
    domain = list(DOMAINS)[scan.domain]
    if short:
        augmented = [name for step in scan.augmented for name in step]
        text = "  ·  ".join([scan.id or "scan", domain, *augmented])
        if len(text) > 55:
            text = f"{text[:26]}…{text[-28:]}"
        return text
    return f"{scan.id or 'scan'}   ·   {scan.sensor.name}   ·   {domain}   ·   {len(scan):,} points"


def new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor=BACK)
    FigureCanvasAgg(figure)
    return figure


def _write_head(figure: Figure, text: str, x: float, y: float) -> None:
    """Write a heading without formulas, because names of scans may contain "$"."""
    figure.text(x, y, text, color=INK, fontsize=15, va="center", parse_math=False)


def _show_pixels(axes: Any, pixels: Any) -> None:
    axes.imshow(pixels, aspect="auto", interpolation="antialiased")
    axes.set_axis_off()


def style_axes(axes: Any, title: str, xlabel: str, ylabel: str) -> None:
    axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.set_xlabel(xlabel, color=DIM, fontsize=9)
    axes.set_ylabel(ylabel, color=DIM, fontsize=9)
    axes.tick_params(colors=DIM, labelsize=8, length=3)
    for spine in axes.spines.values():
        spine.set_color("#3a3f4b")


def _colour_bar(axes: Any, scale: Scale) -> None:
    """A colour bar at the right edge of the axes."""
    values = ScalarMappable(
        PowerNorm(scale.gamma, scale.low, scale.high), ListedColormap(scale.table / 255)
    )
    bar = axes.figure.colorbar(
        values, cax=axes.inset_axes((1.008, 0, 0.011, 1), transform=axes.transAxes)
    )
    bar.ax.tick_params(colors=DIM, labelsize=8, length=2)
    bar.outline.set_edgecolor("#3a3f4b")


def _perspective(
    axes: Any, view: View, by: str, scale: Scale, camera: Camera | None
) -> None:
    _show_pixels(
        axes, render(view.scan, by, camera=camera, size=(1020, 620), scale=scale)
    )
    axes.set_title(
        f"3-D, coloured by {scale.title}; circles every 10 m",
        color=INK,
        fontsize=11,
        loc="left",
    )


def _from_above(axes: Any, view: View, scale: Scale, extent: float) -> None:
    pixels = render(
        view.scan, "height", camera=bird(extent), size=(600, 600), scale=scale
    )
    axes.imshow(
        pixels, extent=(extent, -extent, -extent, extent), interpolation="antialiased"
    )
    style_axes(
        axes,
        f"from above, coloured by {scale.title}",
        "y, to the left (m)",
        "x, ahead (m)",
    )
    _colour_bar(axes, scale)


def _image(axes: Any, view: View, channel: str, scale: Scale) -> None:
    sensor = view.image.sensor
    axes.imshow(
        picture(view.image, channel, scale),
        aspect="auto",
        interpolation="nearest",
        extent=(-180, 180, sensor.shape[0], 0),
    )
    style_axes(axes, scale.title, "", "row")
    names = "behind -135° left -45° ahead 45° right 135° behind"
    axes.set_xticks(range(-180, 181, 45), names.split())
    if not scale.classes:
        _colour_bar(axes, scale)


def _legend(figure: Figure, all_views: Sequence[View], table: Rgb) -> None:
    """A legend at the bottom: colour and share of each class that occurs in the scans."""
    counts = np.sum([view.classes for view in all_views], axis=0)
    entries = [
        Patch(
            color=tuple((table[i] / 255).tolist()),
            label=f"{name} {count / counts.sum():.1%}",
        )
        for i, (name, count) in enumerate(
            zip((*NAMES, "unlabelled"), counts, strict=True)
        )
        if count
    ]
    columns = min(max(1, len(entries)), _per_row(figure.get_figwidth()))
    figure.legend(
        handles=entries,
        loc="lower center",
        ncols=columns,
        frameon=False,
        labelcolor=INK,
        fontsize=9,
    )


def _per_row(width: float) -> int:
    """The number of classes per row in a legend that is ``width`` inches wide."""
    return max(1, min(10, int(width / 1.65)))
