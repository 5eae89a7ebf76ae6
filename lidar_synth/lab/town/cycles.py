"""Meshes of a bicycle and a motorcycle without riders."""

from functools import cache

import numpy as np

from lidar_synth.lab.town.bodywork import HEAD, PAINT, PLATE, RIM, TRIM, TYRE
from lidar_synth.lab.town.meshes import (
    Mesh,
    boxes,
    disc,
    loft,
    merge,
    quads,
    tube,
    tubes,
)


def _ring(x: float, radius: float, thick: float, slot: int) -> Mesh:
    """The tyre of an upright wheel that touches the ground at x."""
    angle = np.linspace(0, 2 * np.pi, 15)[:-1]
    hub = np.stack(
        [x + radius * np.cos(angle), 0 * angle, radius + radius * np.sin(angle)], -1
    )
    out = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    across = np.array([0.0, 1.0, 0.0])
    sections = np.stack(
        [
            hub - thick * out,
            hub + thick * across - thick * out,
            hub,
            hub - thick * across - thick * out,
        ],
        1,
    )
    return loft(np.concatenate([sections, sections[:1]]), slot, closed=True)


@cache
def bicycle_mesh() -> Mesh:
    """A city bicycle."""
    hub = (-0.53, 0, 0.34)
    seat = (-0.22, 0, 0.92)
    head = (0.40, 0, 0.85)
    pedal = (-0.08, 0, 0.30)
    frame: list[tuple[list[tuple[float, float, float]], float]] = [
        ([hub, pedal], 0.018),
        ([pedal, seat], 0.02),
        ([pedal, head], 0.022),
        ([(-0.18, 0, 0.70), head], 0.022),
        ([(-0.18, 0, 0.70), hub], 0.014),
        ([(0.53, 0, 0.34), head, (0.34, 0, 1.02)], 0.02),
        ([(0.30, -0.28, 1.02), (0.36, 0, 1.04), (0.30, 0.28, 1.02)], 0.016),
        ([(-0.08, -0.12, 0.18), (-0.08, 0.12, 0.42)], 0.02),
    ]
    saddle = boxes(
        [(-0.36, -0.08, 0.92), (-0.70, -0.07, 0.70)],
        [(-0.10, 0.08, 0.98), (-0.32, 0.07, 0.73)],
        TRIM,
    )
    guard = loft(
        [
            [
                (-0.53 + 0.37 * np.cos(a), y, 0.34 + 0.37 * np.sin(a))
                for y in (-0.03, 0.03)
            ]
            for a in np.linspace(0.3, 2.6, 6)
        ],
        PAINT,
    )
    rings = [_ring(x, 0.34, 0.022, TYRE) for x in (-0.53, 0.53)]
    return merge([tubes(frame, 5, PAINT), saddle, guard, *rings])


@cache
def motorcycle_mesh() -> Mesh:
    """A motorcycle with a fairing."""
    wheels = [
        tube([(x, -0.07, 0.31), (x, 0.07, 0.31)], 0.31, 12, TYRE) for x in (-0.72, 0.72)
    ]
    rims = [
        tube([(x, -0.08, 0.31), (x, 0.08, 0.31)], 0.19, 10, RIM) for x in (-0.72, 0.72)
    ]
    bars: list[tuple[list[tuple[float, float, float]], float]] = [
        ([(0.72, 0, 0.31), (0.45, 0, 0.95)], 0.05),
        ([(0.42, -0.36, 1.0), (0.47, 0, 1.02), (0.42, 0.36, 1.0)], 0.02),
        ([(-0.5, -0.18, 0.35), (0.1, -0.16, 0.35)], 0.05),
        ([(-0.72, 0, 0.31), (-0.1, 0, 0.45)], 0.05),
    ]
    stations = (
        (-0.95, 0.06, 0.72, 0.84),
        (-0.5, 0.14, 0.60, 0.84),
        (-0.1, 0.15, 0.48, 0.82),
        (0.1, 0.18, 0.45, 0.98),
        (0.40, 0.14, 0.55, 0.98),
        (0.56, 0.09, 0.75, 0.95),
    )
    outlines = [
        [(x, y * w, z) for y, z in ((-1, low), (-0.9, high), (0.9, high), (1, low))]
        for x, w, low, high in stations
    ]
    plate = [
        (-0.97, -0.1, 0.55),
        (-0.97, 0.1, 0.55),
        (-0.96, 0.1, 0.70),
        (-0.96, -0.1, 0.70),
    ]
    return merge(
        [
            *wheels,
            *rims,
            tubes(bars, 6, RIM),
            loft(outlines, PAINT, closed=True),
            boxes([(-0.25, -0.16, 0.22)], [(0.30, 0.16, 0.52)], TRIM),
            disc((0.58, 0, 0.86), (1, 0, 0), 0.09, 8, HEAD),
            quads([plate], PLATE),
        ]
    )
