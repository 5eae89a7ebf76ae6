"""Moving objects of KITTI-360 at any frame: their accumulated points, moved with their boxes.

The points of an object that were measured in different frames are gathered in the frame of its box.
At each frame with a box, also at one whose points were not accumulated, they are put back where the
box is then.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import MAX_INSTANCES
from lidar_synth.formats.kitti360_boxes import WorldBoxes
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.kitti360.accumulated import cloud_values

MARGIN = 0.2
"""Distance, metres, up to which points outside a box belong to it."""

FLOOR = 0.25
"""Height above a box's bottom, metres, below which a point may be the road."""

MOVED = 0.5
"""Distance, metres, by which a box without points has to move to count as moving."""

_SPACING = 0.03  # of the points of one object, metres
# Frames, and metres per frame, above which the same instance number is another object.
_GAP = 10
_JUMP = 15.0


@dataclass
class MovingTrack:
    """One moving object.

    Args:
        instance: its instance number, id * 1000 + n.
        boxes: {frame: (4, 4) transform from the unit cube to the world}.
        points: (N, 3) in the frame of the box, metres.
        values: (N,) label values.
    """

    instance: int
    boxes: dict[int, Float64Array]
    points: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    values: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))

    @property
    def moves(self) -> bool:
        """Whether it has points of moving objects, or its box moves."""
        centres = np.array([box[:3, 3] for box in self.boxes.values()])
        return len(self.points) > 0 or bool(
            np.linalg.norm(centres - centres[0], axis=1).max() > MOVED
        )

    @property
    def semantic(self) -> int:
        """The class of its box."""
        return self.instance // MAX_INSTANCES


class Movers:
    """The moving objects of some windows.

    Args:
        clouds: the dynamic points of the windows, as ``read_cloud`` returns them.
        boxes: the boxes of the drive; None = none, so that only points measured in the same frame
            count.
        frames: the frames of the windows.
    """

    def __init__(
        self,
        clouds: Iterable[NDArray[np.void]],
        boxes: WorldBoxes | None,
        frames: range,
    ) -> None:
        found = [
            (_points(cloud), cloud_values(cloud), cloud["timestamp"].astype(np.int64))
            for cloud in clouds
        ]
        empty = np.zeros((0, 3)), np.zeros(0, np.uint32), np.zeros(0, np.int64)
        points, values, frame = (
            np.concatenate(parts) for parts in zip(empty, *found, strict=True)
        )
        tracks = [] if boxes is None else _tracks(boxes, frames)
        free = np.ones(len(points), bool)
        for track in tracks:
            _gather(track, points, values, frame, free)
        self.tracks = [track for track in tracks if track.moves]
        self._rest = points[free], values[free], frame[free]

    def at(self, frame: int) -> tuple[Float64Array, NDArray[np.uint32]]:
        """(N, 3) points in the world and (N,) label values of all moving objects at a frame."""
        now = self._rest[2] == frame
        points = [self._rest[0][now]]
        values = [self._rest[1][now]]
        for track in self.present(frame):
            box = track.boxes[frame]
            points.append(track.points @ _rigid(box)[:3, :3].T + box[:3, 3])
            values.append(track.values)
        return np.concatenate(points), np.concatenate(values)

    def present(self, frame: int) -> list[MovingTrack]:
        """The objects that have a box at a frame."""
        return [track for track in self.tracks if frame in track.boxes]


def find_inside(
    box: Float64Array,
    points: Float64Array,
    margin: float = 0.0,
    floor: float = 0.0,
) -> NDArray[np.intp]:
    """The indices of the points in a box.

    Args:
        box: (4, 4) transform from the unit cube to the world.
        points: (N, 3) in the world.
        margin: metres added on all sides.
        floor: metres above the box's bottom, below which points are outside.
    """
    size = np.linalg.norm(box[:3, :3], axis=0)
    reach = np.linalg.norm(size) / 2 + margin
    beside = np.abs(points[:, :2] - box[:2, 3])
    near = np.flatnonzero((beside < reach).all(axis=1))
    local = (points[near] - box[:3, 3]) @ (box[:3, :3] / size)
    kept = (np.abs(local) <= size / 2 + margin).all(axis=1)
    if floor:
        kept &= local[:, 2] > floor - size[2] / 2
    return np.asarray(near[kept])


def _points(cloud: NDArray[np.void]) -> Float64Array:
    return np.column_stack([cloud[axis] for axis in "xyz"]).astype(np.float64)


def _rigid(box: Float64Array) -> Float64Array:
    """(4, 4) from the frame of a box, in metres, to the world."""
    rigid = box.copy()
    rigid[:3, :3] /= np.linalg.norm(box[:3, :3], axis=0)
    return rigid


def _sort_boxes(boxes: WorldBoxes, frames: range) -> NDArray[np.intp]:
    """The boxes of one frame each, object by object, by frame."""
    stamped = (boxes.windows[:, 0] == boxes.windows[:, 1]) & np.isin(
        boxes.windows[:, 0], frames
    )
    order = np.flatnonzero(stamped)
    return order[np.lexsort((boxes.windows[order, 0], boxes.instances[order]))]


def _tracks(boxes: WorldBoxes, frames: range) -> list[MovingTrack]:
    """The objects with one box per frame; an instance number that is used again is another
    object."""
    order = _sort_boxes(boxes, frames)
    instance = boxes.instances[order]
    frame = boxes.windows[order, 0]
    place = boxes.transforms[order, :3, 3]
    gap = np.diff(frame)
    way = np.linalg.norm(np.diff(place, axis=0), axis=1)
    jump = way > _JUMP * np.maximum(gap, 1)
    parts = np.split(
        order, np.flatnonzero((np.diff(instance) != 0) | (gap > _GAP) | jump) + 1
    )
    return [
        MovingTrack(
            int(boxes.instances[part[0]]),
            {int(boxes.windows[i, 0]): boxes.transforms[i] for i in part},
        )
        for part in parts
        if len(part)
    ]


def _gather(
    track: MovingTrack,
    points: Float64Array,
    values: NDArray[np.uint32],
    frame: NDArray[np.int64],
    free: NDArray[np.bool_],
) -> None:
    """Move the points that lie in a track's boxes into its own frame, thinned, and mark them as
    taken."""
    local = [track.points]
    own = [track.values]
    for moment, box in track.boxes.items():
        candidates = np.flatnonzero(free & (frame == moment))
        taken = candidates[find_inside(box, points[candidates], MARGIN)]
        free[taken] = False
        local.append((points[taken] - box[:3, 3]) @ _rigid(box)[:3, :3])
        own.append(values[taken])
    gathered = np.concatenate(local)
    _, first = np.unique(
        np.floor(gathered / _SPACING).astype(np.int64), axis=0, return_index=True
    )
    track.points = gathered[first]
    track.values = np.concatenate(own)[first]
