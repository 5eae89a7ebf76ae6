"""Objects taken out of a scan, and the surfaces behind them in their place.

The hole consists of the rays that the object returned or absorbed. They are continued from the same
rings beside it (``fill``), and drawn again by a generator if there is one (``redraw``).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, IGNORE, has_ground
from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels.boxes import grow_box, widen_boxes
from lidar_synth.labels.edit.compose import replace_returns
from lidar_synth.labels.edit.fill import continue_surfaces
from lidar_synth.labels.edit.rays import ScanRays, rays_of_scan
from lidar_synth.labels.edit.redraw import Model, open_model, redraw_hole
from lidar_synth.labels.ground import CLEARANCE, FLOOR, ground_of, standing
from lidar_synth.labels.objects import NOISE, THINGS, find_returns

if TYPE_CHECKING:
    from lidar_synth.generate.generator import Generator

Which = int | Sequence[int] | Boxes | NDArray[np.float32]
"""Boxes: by their numbers in the scan, or by their values; seven whole numbers, each once, are
seven boxes."""

MARGIN = 0.05
"""Metres around an object within which a ray without a return is taken for one that the object
absorbed."""


def remove(
    scan: Scan,
    box: Which,
    *,
    model: "Generator | str | Path | None" = None,
    seed: int = 0,
) -> Scan:
    """Remove objects from a scan, with their boxes, and fill the holes with what is behind them.

    Args:
        scan: N points.
        box: number of a box of the scan, several numbers, or a box (7,) or ``Boxes`` in the sensor
            frame.
        model: an unconditional generator on the scan's grid, its name or file, that draws the
            holes; None, the default, fills them by geometry alone.
        seed: of the model's noise.

    Returns:
        A new scan without a camera image. All other points, labels, boxes and instances are
        unchanged; without boxes to remove, it is the scan as it was given.

    Raises:
        DataError: on a box that the scan does not have, that is out of the sensor's range or that
            holds no return; on seven whole numbers with repeats, which may be a box or boxes; with
            a model, on a scan of another sensor.
        ConfigError: on an unknown or a conditional model.

    Example:
        >>> from lidar_synth import Town
        >>> from lidar_synth.labels import edit
        >>> scan = Town(seed=0, scans=1)[0]
        >>> number = scan.boxes.names.index("Car")
        >>> emptied = edit.remove(scan, number)
        >>> len(scan.boxes) - len(emptied.boxes)
        1
    """
    boxes, numbers = select_boxes(scan, box)
    if not len(boxes):
        return scan
    parts = [(returns_of(scan, boxes[[i]]), boxes.values[i]) for i in range(len(boxes))]
    if numbers is None and not any(mine.any() for mine, _ in parts):
        raise DataError(
            f"box {_text(boxes.values[0])} of scan {scan.id!r} without a return",
            "a box with an object",
        )
    result = remove_returns(scan, parts, open_model(model), seed)
    if scan.boxes is None:
        return result
    gone = (scan.boxes.values[:, None] == boxes.values).all(2).any(1)
    return replace(result, boxes=scan.boxes[~gone])


def select_boxes(scan: Scan, box: Which) -> tuple[Boxes, list[int] | None]:
    """The boxes that an argument names, and their numbers in the scan, None for boxes of its own.

    Raises:
        DataError: on a number or a place that the scan does not have, or seven whole numbers with
            repeats.
    """
    given = np.asarray(box.values if isinstance(box, Boxes) else box)
    if not given.size:
        return Boxes(np.zeros((0, 7), np.float32), ()), None
    if given.dtype.kind in "iu" and given.shape == (7,) and len(np.unique(given)) < 7:
        raise DataError(
            f"seven whole numbers {given.tolist()}",
            "each number once, or a box (7,) as floats",
        )
    if given.dtype.kind in "iu" and given.ndim < 2:
        numbers = np.atleast_1d(given).tolist()
        count = 0 if scan.boxes is None else len(scan.boxes)
        if scan.boxes is None or not set(numbers) <= set(range(count)):
            given_text = f"box {given.tolist()} of scan {scan.id!r} with {count} boxes"
            raise DataError(
                given_text,
                "numbers of its boxes, from 0",
                "A scan without boxes takes a box (7,): x, y, z, length, width, height, yaw.",
            )
        return scan.boxes[numbers], numbers
    if given.ndim == 0 or given.shape[-1] != 7 or given.dtype.kind not in "iuf":
        raise DataError(
            f"a box of shape {given.shape}", "(7,): x, y, z, length, width, height, yaw"
        )
    boxes = (
        box
        if isinstance(box, Boxes)
        else Boxes(given.astype(np.float32), ("Misc",) * (given.size // 7))
    )
    for values in boxes.values:
        if (distance := float(np.linalg.norm(values[:3]))) > scan.sensor.range_max:
            raise DataError(
                f"a box {_text(values)}, {distance:.1f} m away",
                f"at most {scan.sensor.range_max:g} m, the range of {scan.sensor.name!r}",
            )
    return boxes, None


def _text(values: NDArray[np.float32]) -> str:
    return f"at ({values[0]:.1f}, {values[1]:.1f}, {values[2]:.1f})"


def returns_of(scan: Scan, box: Boxes) -> NDArray[np.bool_]:
    """(N,) the returns of the object in one box, with those of its mirrors and aerials just
    outside."""
    mine = find_returns(scan, box)
    around = box.enlarged(NOISE).contain(scan.points)[0] & ~mine
    ground = ground_of(scan, box.values[0])
    if ground is not None:
        around[around] = ground.above(scan.points[around], box.values[0]) > FLOOR
    else:
        around &= scan.points[:, 2] > box.values[0, 2] - box.values[0, 5] / 2 + FLOOR
    # in the box, also returns at the object's edge whose label is another one
    if scan.label is not None:
        same = np.isin(scan.label, np.unique(scan.label[mine])) & (scan.label < THINGS)
        around &= same | (box.contain(scan.points)[0] & ~GROUND[scan.label])
    if scan.instance is not None and mine.any():
        around &= np.isin(scan.instance, [0, *np.unique(scan.instance[mine])])
    if scan.boxes is not None:
        others = ~(scan.boxes.values == box.values).all(1)
        around &= ~scan.boxes[others].contain(scan.points).any(0)
    return np.asarray(mine | around)


def remove_returns(
    scan: Scan,
    parts: Sequence[tuple[NDArray[np.bool_], NDArray[np.float32]]],
    model: Model,
    seed: int,
) -> Scan:
    """Remove returns from a scan and fill the hole.

    Args:
        scan: N points.
        parts: for each object, (N,) True for its returns, and its box (7,).
        model: draws the hole; None for the estimate from its surroundings alone.
        seed: of the model's noise.

    Returns:
        The scan with its remaining points unchanged and in order. Points of the hole take the place
        of removed ones; those on rays that had no return come after their neighbour in the ring.
        Boxes stay as they are.
    """
    removed = np.any([mine for mine, _ in parts], 0)
    if not removed.any():
        return scan
    rays = rays_of_scan(scan)
    hole = rays.hitting(removed)
    near = np.full(len(hole), np.inf)
    far = np.zeros(len(hole))
    # In a direction without a return of any ring nothing was recorded, as after a crop to the
    # camera's view.
    degree = np.rint(np.degrees(rays.azimuth)).astype(np.int64) % 360
    silent = (rays.point < 0) & np.isin(degree, degree[rays.point >= 0])
    near[hole] = rays.rho[hole]
    for mine, box in parts:
        if mine.any():
            absorbed = silent & rays.through(box, MARGIN)
            near[absorbed] = np.minimum(
                near[absorbed], np.hypot(*scan.points[mine, :2].T).min()
            )
            hole |= absorbed
            place = widen_boxes(grow_box(box, scan.points[mine]), CLEARANCE + MARGIN)
            far = np.maximum(far, rays.leaving(place))
    donor, rho = continue_surfaces(
        rays, hole, near, far, _ground(scan, rays), _things(scan, rays)
    )
    which = np.flatnonzero(hole & (donor >= 0))
    filled = _copies(scan, rays, which, donor[which], rho[which])
    if model is not None:
        filled = redraw_hole(scan[~removed], filled, rays, which, model, seed)
    seen = np.linalg.norm(filled.points, axis=1) > 0
    return replace_returns(scan, removed, rays, which[seen], filled[seen])


def _ground(scan: Scan, rays: ScanRays) -> NDArray[np.bool_]:
    """(E,) True for returns of the ground: by their labels, or, without labels of the ground, by
    their height."""
    if has_ground(scan.label):
        return rays.hitting(GROUND[scan.label])
    height = scan.points[:, 2]
    return rays.hitting(height < np.percentile(height, 10) + 0.5)


def _things(scan: Scan, rays: ScanRays) -> NDArray[np.bool_]:
    """(E,) True for returns of objects: by their labels, or in boxes."""
    thing = np.zeros(len(scan), bool)
    if scan.label is not None:
        thing |= scan.label < THINGS
    if scan.boxes is not None:
        thing |= standing(scan, scan.boxes).any(0)
    return rays.hitting(thing)


def _copies(
    scan: Scan,
    rays: ScanRays,
    which: NDArray[np.intp],
    donor: NDArray[np.int64],
    rho: NDArray[np.float64],
) -> Scan:
    """One point for each ray (n,) of the hole, with the fields of the ray that it is copied from,
    labels 255 = ignore if that has no return. Points at the origin are no returns."""
    finite = np.isfinite(rho)
    points = np.where(
        finite[:, None], rays.points(which, np.where(finite, rho, 0.0)), np.float32(0)
    )
    distance = np.linalg.norm(points, axis=1)
    near = distance < scan.sensor.range_min
    points[near | (distance > scan.sensor.range_max)] = 0
    source = rays.point[donor]
    copies = scan[np.maximum(source, 0)]
    fields: dict[str, Any] = {"points": points.astype(np.float32)}
    if scan.instance is not None:
        fields["instance"] = np.zeros(len(which), np.int32)
    # Also for points without a return, as a model may draw one there.
    unknown = {"label": IGNORE, "raw_label": 0, "confidence": 0, "cause": 0}
    for name in unknown.keys() & scan.fields().keys():
        values = getattr(copies, name)
        fields[name] = np.where(source < 0, unknown[name], values).astype(values.dtype)
    return replace(copies, **fields)
