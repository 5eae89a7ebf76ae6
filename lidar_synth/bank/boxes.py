"""Encoding of a scan's boxes: one row of nine integers for each.

=========== ===========================================================
column      value
=========== ===========================================================
0           1 + the position of the class in ``NAMES``; 0 = no box
1           instance of the box's points in ``instance``, from 1 on
2 to 7      x, y, z, length, width, height in steps of 0.1 mm
8           yaw in steps of 10 microradians
=========== ===========================================================
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes

NAMES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
    "Motorcyclist",
    "Bicycle",
    "Motorcycle",
)
"""Classes in the order of their codes; new ones are appended."""

MOST = 256
"""Maximum number of boxes of a scan."""

SHAPE = (MOST, 9)
_STEPS = np.array([*6 * [1e-4], 1e-5])
_LARGEST = 2e5 - 1  # metres that int32 can hold


def encode_boxes(boxes: Boxes) -> NDArray[np.int32]:
    """The rows (``SHAPE``) of boxes; unused ones are zero.

    Raises:
        DataError: on too many boxes, an unknown class, or an instance below 1.
    """
    _check_given(boxes)
    rows = np.zeros(SHAPE, np.int32)
    rows[: len(boxes), 0] = [1 + NAMES.index(name) for name in boxes.names]
    rows[: len(boxes), 1] = boxes.instance
    steps = np.rint(boxes.values.astype(np.float64) / _STEPS).astype(np.int32)
    steps[:, 3:6] = np.maximum(steps[:, 3:6], 1)
    rows[: len(boxes), 2:] = steps
    return rows


def _check_given(boxes: Boxes) -> None:
    if len(boxes) > MOST or not set(boxes.names) <= set(NAMES):
        unknown = sorted(set(boxes.names) - set(NAMES))
        raise DataError(
            f"{len(boxes)} boxes of a scan, unknown classes {unknown}",
            f"at most {MOST} of {NAMES}",
        )
    if len(boxes) and (
        boxes.instance.min() < 1 or np.abs(boxes.values).max() > _LARGEST
    ):
        raise DataError(
            "boxes without instance, or far away", "instances from 1 on, and metres"
        )


def decode_boxes(rows: NDArray[np.int32]) -> Boxes:
    """The inverse of ``encode_boxes``, to 0.05 mm."""
    used = rows[rows[:, 0] > 0]
    values = (used[:, 2:] * _STEPS).astype(np.float32)
    return Boxes(
        values,
        tuple(NAMES[code - 1] for code in used[:, 0]),
        instance=used[:, 1].astype(np.int32),
    )


def check_boxes(rows: NDArray[np.int32]) -> None:
    """Refuse rows that ``encode_boxes`` never writes.

    Raises:
        DataError: on them.
    """
    used = rows[:, 0] != 0
    count = int(used.sum())
    sound = (
        used[:count].all() and not rows[count:].any() and (rows[:count, 1] > 0).all()
    )
    if not (
        sound and (rows[:count, 0] > 0).all() and (rows[:count, 0] <= len(NAMES)).all()
    ):
        raise DataError(
            "rows of boxes with an unknown class or instance",
            f"classes 1 to {len(NAMES)}, then zeros",
        )
    if (rows[:count, 5:8] <= 0).any():
        raise DataError("boxes with a size that is not positive", "metres")
