"""Agreement of generated scans with the layouts that they were generated for: do boxes hold what
they should, and does nothing of their classes lie elsewhere?"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import BOXED, GROUND
from lidar_synth.errors import DataError
from lidar_synth.generate.boxed import TOLERANCE
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.layout import CODES, Layout, layout_image
from lidar_synth.geometry.layout.raster import depth_of

LEAST_RAYS = 20
LEAST_POINTS = 10
"""A box that so many rays meet first should hold so many points."""

_SURFACE = 0.005  # metres; the depth of an image has steps of 2 mm


class LayoutAgreement(NamedTuple):
    """Sums over scans.

    Args:
        points: points of boxed classes.
        inside: those in a box, with a tolerance of 0.1 m.
        boxes: boxes that 20 rays or more meet first. An object fills about half of its box.
        filled: those that hold 10 points or more.
        seen: boxes in which the scan of the layout has 20 points or more.
        kept: those that hold 10 points or more.
    """

    points: int
    inside: int
    boxes: int
    filled: int
    seen: int
    kept: int

    @property
    def inside_share(self) -> float:
        """Share of the points of boxed classes that lie in a box."""
        return self.inside / max(self.points, 1)

    @property
    def filled_share(self) -> float:
        """Share of the boxes that rays meet that hold points."""
        return self.filled / max(self.boxes, 1)

    @property
    def kept_share(self) -> float:
        """Share of the boxes with points in the scan of the layout that hold points."""
        return self.kept / max(self.seen, 1)


def rays_of_boxes(layout: Layout, sensor: Sensor) -> NDArray[np.int64]:
    """(M,) number of rays that meet each box first."""
    image = layout_image(layout, sensor)
    seen = image[0] >= CODES["Car"]
    points = depth_of(image)[seen][:, None] * sensor.ray_directions()[seen]
    if len(sensor.starts):
        points[:, 2] += sensor.starts[np.nonzero(seen)[0]]
    near = layout.boxes.enlarged(_SURFACE).contain(points)
    return np.asarray(near.sum(1), np.int64)


def layout_agreement(
    scans: Iterable[Scan], layouts: Iterable[Layout], own: Iterable[Scan]
) -> LayoutAgreement:
    """Compare generated scans with labels with their layouts, and with the scans ``own`` that the
    layouts are of.

    Example:
        >>> from lidar_synth import Town, layout_of
        >>> from lidar_synth.lab.evaluate.layouts import layout_agreement
        >>> scan = Town(seed=0, scans=1, motion=False)[0]
        >>> layout_agreement([scan], [layout_of(scan)], [scan]).inside_share > 0.99
        True
    """
    total = np.zeros(6, np.int64)
    for scan, layout, real in zip(scans, layouts, own, strict=True):
        inside, boxed, points = _inside(layout, scan)
        full = points >= LEAST_POINTS
        visible = rays_of_boxes(layout, scan.sensor) >= LEAST_RAYS
        seen = _inside(layout, real)[2] >= LEAST_RAYS
        boxes = (visible.sum(), (visible & full).sum(), seen.sum(), (seen & full).sum())
        total += (boxed.sum(), inside[boxed].sum(), *boxes)
    return LayoutAgreement(*total.tolist())


def _inside(
    layout: Layout, scan: Scan
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]:
    """(N,) points in a box, with the tolerance; (N,) points of boxed classes; (M,) number of points
    in each box, without those of the ground."""
    if scan.label is None:
        raise DataError(
            f"scan {scan.id!r} has no labels", "labels, to compare it with its layout"
        )
    inside = layout.boxes.enlarged(TOLERANCE).contain(scan.points)
    points: NDArray[np.int64] = (inside & ~GROUND[scan.label]).sum(1)
    return np.asarray(inside.any(0)), np.isin(scan.label, BOXED), points
