"""A plot of a fitted sensor: how close the points of each beam lie to it, and what is known of the
firings."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lidar_synth.lab.fitting import SensorFit
from lidar_synth.viz.sheet import BACK, DIM, INK, new_figure, style_axes

_LINE = "#5ad1c8"
_POINT = "#ffb454"


def fit_figure(fit: SensorFit) -> Figure:
    """The elevations of all points beside the fitted beams, the distance of points from beams, and
    azimuth offsets.

    Args:
        fit: the result of ``fit_sensor``.

    Returns:
        A figure; write it with ``figure.savefig``.
    """
    figure = new_figure(15.0, 8.2)
    grid = figure.add_gridspec(
        2, 2, hspace=0.36, wspace=0.16, left=0.055, right=0.985, bottom=0.075, top=0.87
    )
    title = (
        f"{fit.sensor.name}   ·   {len(fit.points)} beams   ·   {fit.share:.1%} of points within "
        "0.05 degrees"
    )
    figure.text(0.055, 0.955, title, color=INK, fontsize=15, va="center")
    figure.text(
        0.055, 0.92, " ".join(fit.uncertain), color=_POINT, fontsize=9, va="center"
    )
    _elevations(figure.add_subplot(grid[0, :], facecolor=BACK), fit)
    _distances(figure.add_subplot(grid[1, 0], facecolor=BACK), fit)
    _offsets(figure.add_subplot(grid[1, 1], facecolor=BACK), fit)
    return figure


def _beams(fit: SensorFit) -> Any:
    return np.asarray(fit.sensor.elevations)


def _elevations(axes: Any, fit: SensorFit) -> None:
    beams = _beams(fit)
    seen = np.concatenate(
        [
            (beams[ring] + off)[ring >= 0]
            for ring, off in zip(fit.rings, fit.off, strict=True)
        ]
    )
    low = beams[-1] - 1
    high = beams[0] + 1
    axes.hist(
        seen, bins=np.arange(low, high, 0.02), histtype="step", color=_LINE, log=True
    )
    axes.vlines(beams, 0.6, 1.0, color=_POINT, linewidth=0.8)
    axes.set_xlim(high, low)
    style_axes(
        axes, "Elevations of the points; fitted beams below", "degrees", "points"
    )


def _distances(axes: Any, fit: SensorFit) -> None:
    ring = np.concatenate(fit.rings)
    off = np.concatenate(fit.off)
    rows = np.arange(len(fit.points) + 1) - 0.5
    bins = [rows, np.linspace(-0.15, 0.15, 121)]
    axes.hist2d(
        ring, np.clip(off, -0.149, 0.149), bins=bins, norm=LogNorm(), cmap="viridis"
    )
    for limit in (-0.05, 0.05):
        axes.axhline(limit, color=DIM, linewidth=0.6)
    style_axes(
        axes, "Distance of each point from its beam", "beam, 0 = highest", "degrees"
    )


def _offsets(axes: Any, fit: SensorFit) -> None:
    known = fit.azimuths
    if known.offsets is None:
        axes.text(
            0.5, 0.5, "not known", color=DIM, ha="center", transform=axes.transAxes
        )
    else:
        axes.plot(
            known.offsets,
            np.arange(len(known.offsets)),
            ".",
            color=_POINT,
            markersize=4,
        )
        axes.invert_yaxis()
    title = (
        f"Azimuth offsets, by {known.known or 'nothing'}; {known.firings or 'unknown'} firings "
        "per turn"
    )
    style_axes(axes, title, "degrees, clockwise", "beam")
