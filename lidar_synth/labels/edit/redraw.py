"""The content of a hole drawn by a generator, on the rays of the scan."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.geometry.projection import carry, locate
from lidar_synth.labels.edit.rays import ScanRays
from lidar_synth.labels.objects import THINGS

if TYPE_CHECKING:  # importing it takes seconds, and most edits need no model
    from lidar_synth.generate.generator import Generator

Model: TypeAlias = "Generator | None"
"""What draws the content of a hole; None for the geometric estimate alone."""

FAR = 30.0
"""Metres at which a ray without a return is assigned to a cell of the range image."""

BEND = 0.2
"""Largest relative change of distance by which a return on the ground is moved within its cell."""


def open_model(model: "Generator | str | Path | None") -> Model:
    """The generator that an argument names; a name or file is loaded once per process.

    Raises:
        ConfigError, FileError, DataError: as ``load_generator``.
    """
    return _load(str(model)) if isinstance(model, str | Path) else model


@lru_cache(maxsize=2)
def _load(model: str) -> "Generator":
    from lidar_synth.generate.loading import load_generator

    return load_generator(model)


def redraw_hole(
    kept: Scan,
    filled: Scan,
    rays: ScanRays,
    which: NDArray[np.intp],
    model: "Generator",
    seed: int,
) -> Scan:
    """Replace the estimated content of a hole by that of a model.

    Args:
        kept: the scan without the hole.
        filled: (n) points of the hole, at the origin where the estimate has no return.
        rays: of the scan before.
        which: (n,) ray of each point.
        model: an unconditional generator.
        seed: of its noise.

    Raises:
        ConfigError: on a conditional model.
        DataError: on a scan of another sensor than the model's.
    """
    from lidar_synth.generate.inpaint import check_model, inpaint

    check_model(model, kept.sensor)
    returned = np.linalg.norm(filled.points, axis=1) > 0
    far = rays.points(which, np.full(len(which), FAR))
    points = np.where(returned[:, None], filled.points, far)
    everything = locate(
        np.concatenate([kept.points, filled.points]).astype(np.float32), kept.sensor
    )
    cell = locate(points.astype(np.float32), kept.sensor).cell
    known = everything.point >= 0
    distance = np.where(known, everything.range[everything.point], 0).astype(np.float32)
    both = _joined(kept, filled)
    image = RangeImage(
        distance,
        kept.sensor,
        carry(both, everything.point, _CARRIED & both.fields().keys()),
    )
    hole = np.zeros(distance.shape, bool)
    hole.reshape(-1)[cell[cell >= 0]] = True
    hole &= ~known | (everything.point >= len(kept))
    [drawn] = inpaint(model, [image], [hole], seed, [0])
    inside = (cell >= 0) & hole.reshape(-1)[np.maximum(cell, 0)]
    return _on_rays(filled, rays, which, drawn, cell, inside)


_CARRIED = {"reflectance", "label"}


def _joined(kept: Scan, filled: Scan) -> Scan:
    names = _CARRIED & kept.fields().keys()
    fields: dict[str, Any] = {
        n: np.concatenate([getattr(kept, n), getattr(filled, n)]) for n in names
    }
    points = np.concatenate([kept.points, filled.points])
    return Scan(points, sensor=kept.sensor, **fields)


def _on_rays(
    filled: Scan,
    rays: ScanRays,
    which: NDArray[np.intp],
    drawn: RangeImage,
    cell: NDArray[np.int32],
    inside: NDArray[np.bool_],
) -> Scan:
    """The points of the hole at the distances of their cells; on the ground, where their ray meets
    its height."""
    row = np.maximum(cell, 0) // drawn.sensor.columns
    elevation = drawn.sensor.row_elevations()[row].astype(np.float64)
    distance = drawn.range.reshape(-1)[cell].astype(np.float64)
    rho = distance * np.cos(elevation)
    z = distance * np.sin(elevation)
    if len(starts := drawn.sensor.starts):
        z += starts[row]  # ranges of such rows are measured from where their rays start
    label = drawn.channels.get("label")
    if label is not None:
        slope = rays.slope[which]
        meets = (z - rays.height[which]) / np.where(np.abs(slope) < 1e-3, -1e-3, slope)
        # The model may draw a new object, which is not taken.
        inside = inside & ~(label.reshape(-1)[cell] < THINGS)
        level = GROUND[label.reshape(-1)[cell]] & (np.abs(meets - rho) < BEND * rho)
        rho = np.where(level, meets, rho)
    points = np.where(distance[:, None] > 0, rays.points(which, rho), np.float32(0))
    fields: dict[str, Any] = {
        "points": np.where(inside[:, None], points, filled.points).astype(np.float32)
    }
    for name in (
        {"reflectance", "label", "confidence"}
        & filled.fields().keys()
        & drawn.channels.keys()
    ):
        values = drawn.channels[name].reshape(-1)[cell]
        fields[name] = np.where(inside, values, getattr(filled, name)).astype(
            values.dtype
        )
    return replace(filled, **fields)
