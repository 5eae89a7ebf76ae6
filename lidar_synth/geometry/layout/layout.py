"""What stands where: oriented boxes with a class, the ground, and outlines of buildings, vegetation
and fences.

A layout is in the sensor frame, metres: x forward, y left, z up. It is the condition of a model
that generates the scan of it, and its boxes are the boxes of that scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.geometry.overlap import overlapping_pairs
from lidar_synth.geometry.scan import Boxes

OUTLINES = ("building", "vegetation", "fence")
"""Kinds of outlines."""

CLASSES = (
    "Car",
    "Van",
    "Truck",
    "Tram",
    "Misc",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Motorcyclist",
)
"""Classes of boxes as KITTI spells them; it counts motorcyclists as ``Misc``, of which narrow boxes
are theirs."""

CODES = {
    name: code for code, name in enumerate(("unknown", "ground", *OUTLINES, *CLASSES))
}
"""The code of each class in a layout's image."""

CHANNELS = ("class", "depth_high", "depth_low", "chord", "along")
"""Channels of a layout's image, uint8: see ``raster.layout_image``."""

DEPTH_STEP = 0.002
CHORD_STEP = 0.1
"""Metres per step of the depth (65,536 steps in two channels), and of the way of a ray through a
box."""

NARROW = 1.3
"""Maximum width of a motorcyclist's box, metres."""

_FAR = 1e3


@dataclass(frozen=True)
class Outline:
    """The visible side of a building, of vegetation or of a fence: an upright wall along a line.

    Args:
        kind: one of ``OUTLINES``.
        line: (K, 2) float32 x, y of the line's K >= 2 corners, metres.
        low, high: height of its lower and upper edge above the sensor's origin, metres: one number,
            or (K,) for the corners.

    Raises:
        DataError: on another kind, a line without length, or edges in the wrong order.
    """

    kind: str
    line: NDArray[np.float32]
    low: NDArray[np.float32] | float
    high: NDArray[np.float32] | float

    def __post_init__(self) -> None:
        line = np.asarray(self.line, np.float32)
        object.__setattr__(self, "line", line)
        if self.kind not in OUTLINES:
            raise DataError(
                f"an outline of {self.kind!r}", f"one of {', '.join(OUTLINES)}"
            )
        if (
            line.ndim != 2
            or line.shape[1] != 2
            or len(line) < 2
            or (line == line[0]).all()
            or not (np.abs(line) < _FAR).all()
        ):
            raise DataError(
                f"an outline of shape {line.shape}",
                "two or more corners x, y in metres, apart from each other",
            )
        for name in ("low", "high"):
            edge = np.asarray(getattr(self, name), np.float32)
            if edge.shape not in ((), (len(line),)):
                raise DataError(
                    f"an outline's {name} of shape {edge.shape}",
                    f"one number, or ({len(line)},)",
                )
            object.__setattr__(self, name, np.broadcast_to(edge, len(line)))
        low = np.asarray(self.low)
        high = np.asarray(self.high)
        if not ((low > -_FAR) & (low < high) & (high < _FAR)).all():
            raise DataError(
                f"an outline from {low.min()} to {high.max()} m",
                "low < high, metres above the sensor",
            )


@dataclass(frozen=True)
class Layout:
    """What stands where around the sensor.

    Args:
        boxes: of the objects, with names of ``CLASSES``.
        ground: (3,) height of the ground below the sensor, above its origin (metres, negative), and
            its rise per metre along x and y.
        outlines: of what stands still; where there is none, a model decides.
        reach: metres up to which the ground is known; a layout without outlines does not know what
            ends the ground.
        id: name of the layout.

    Raises:
        DataError: on a class that no model knows, a box around the sensor, boxes that overlap, or a
            ground that is above the sensor or steep.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Boxes, Layout, load_sensor
        >>> from lidar_synth.geometry.layout import layout_image
        >>> van = Boxes(np.array([[12, 1, -0.7, 5, 2, 2.1, 0]], np.float32), ("Van",))
        >>> layout_image(Layout(van), load_sensor("hdl64e_lasers")).shape
        (5, 64, 2048)
    """

    boxes: Boxes
    ground: tuple[float, float, float] = (-1.73, 0.0, 0.0)
    outlines: Sequence[Outline] = ()
    reach: float = 15.0
    id: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "outlines", tuple(self.outlines))
        if unknown := sorted(set(self.boxes.names) - set(CLASSES)):
            raise self._error(
                f"boxes of {', '.join(map(repr, unknown))}",
                f"classes of {', '.join(CLASSES)}",
            )
        height, rise, across = map(float, self.ground)
        if not -10 < height < -0.2 or not np.hypot(rise, across) <= 0.3:
            raise self._error(
                f"ground {tuple(self.ground)}",
                "-10 to -0.2 m, and a rise of at most 0.3 per metre",
            )
        if not 0 < self.reach < _FAR:
            raise self._error(f"ground up to {self.reach} m", "metres above 0")
        if (around := around_sensor(self.boxes)).any():
            raise self._error(
                f"box {int(around.argmax())} around the sensor",
                "boxes beside the sensor",
            )
        for i, j in overlapping_pairs(self.boxes):
            names = f"{self.boxes.names[i]} and {self.boxes.names[j]}"
            raise self._error(
                f"boxes {i} and {j} ({names}) that overlap",
                "boxes that stand apart",
                "Move one of them.",
            )

    def _error(self, given: str, expected: str, hint: str = "") -> DataError:
        return DataError(
            f"layout {self.id!r}: {given}" if self.id else f"a layout with {given}",
            expected,
            hint,
        )

    def codes(self) -> NDArray[np.uint8]:
        """(M,) the code of each box."""
        narrow = self.boxes.values[:, 4] < NARROW
        names = [
            "Motorcyclist" if n == "Misc" and s else n
            for n, s in zip(self.boxes.names, narrow, strict=True)
        ]
        return np.array([CODES[name] for name in names], np.uint8)


def around_sensor(boxes: Boxes) -> NDArray[np.bool_]:
    """(M,) whether the sensor is in, above or below a box."""
    level = replace(
        boxes, values=boxes.values * np.array([1, 1, 0, 1, 1, 1, 1], np.float32)
    )
    return level.contain(np.zeros((1, 3), np.float32))[:, 0]
