"""Other sweeps of the same drive as seen from one scan: by the poses, and moving objects by their
boxes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import DataError
from lidar_synth.geometry.scan import Boxes, Scan

MOVABLE = np.isin(np.arange(256), range(TRAIN_ID["motorcyclist"] + 1))
"""(256,) whether a train id is a class of vehicles or people."""

MARGIN = 0.15
"""Metres by which boxes are widened to hold their objects' returns."""


def moved(sweep: Scan, scan: Scan) -> NDArray[np.float64]:
    """The returns of a sweep in the frame of a scan, each object where the scan has it.

    Returns in a box of the sweep move with the box to the one of the same ``instance`` in the scan.
    Returns of other vehicles and people are left out, because they may have moved: those in a box
    that the scan does not have, and those outside all boxes with a movable class. All returns are
    left out if the poses are farther apart than the ranges of both sensors together: the same
    instance may be another object there.

    Args:
        sweep: N returns, with a pose.
        scan: the scan, with a pose.

    Returns:
        (N, 3) metres; NaN for returns that are left out.

    Raises:
        DataError: on a scan without a pose.
    """
    for one in (sweep, scan):
        if one.pose is None:
            raise DataError(
                f"scan {one.id!r} without a pose",
                "poses, to aggregate sweeps",
                "Add poses.txt to the dataset, or transfer without sweeps.",
            )
    assert scan.pose is not None and sweep.pose is not None
    change = np.linalg.inv(scan.pose) @ sweep.pose
    points = sweep.points.astype(np.float64)
    if np.linalg.norm(change[:3, 3]) > sweep.sensor.range_max + scan.sensor.range_max:
        return np.full_like(points, np.nan)
    out = points @ change[:3, :3].T + change[:3, 3]
    if sweep.label is not None:
        out[MOVABLE[sweep.label]] = np.nan
    if sweep.boxes is None:
        return out
    inside = _widened(sweep.boxes).contain(sweep.points)
    boxes = {} if scan.boxes is None else dict(_numbered(scan))
    for held, instance, box in zip(
        inside, sweep.boxes.instance, sweep.boxes.values, strict=True
    ):
        out[held] = (
            np.nan
            if int(instance) not in boxes
            else _carried(points[held], box, boxes[int(instance)])
        )
    return out


def _numbered(scan: Scan) -> list[tuple[int, NDArray[np.float32]]]:
    """(instance, box (7,)) of the boxes of a scan with a known instance."""
    assert scan.boxes is not None
    return [
        (int(n), box)
        for n, box in zip(scan.boxes.instance, scan.boxes.values, strict=True)
        if n >= 0
    ]


def _widened(boxes: Boxes) -> Boxes:
    values = boxes.values.copy()
    values[:, 3:5] += 2 * MARGIN
    return replace(boxes, values=values)


def _carried(
    points: NDArray[np.float64], box: NDArray[np.float32], to: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Points (n, 3) fixed to one box, where that box (7,) is at ``to`` (7,)."""
    turn = float(to[6]) - float(box[6])
    c = np.cos(turn)
    s = np.sin(turn)
    offset = points - box[:3].astype(np.float64)
    return np.asarray(
        offset @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)]) + to[:3], np.float64
    )
