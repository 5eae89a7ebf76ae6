"""Labels of KITTI-360's scans, recovered from the accumulated clouds of one window.

A point of a scan takes the label on which its nearest neighbours agree: in the static clouds of the
window and of the ones before and after it, or among the moving objects of that very frame,
whichever is nearer. A scan that lies up to ``FARTHEST`` off the clouds, because its pose is wrong,
is laid onto them first (kitti360_registration.py). Clouds of other windows are left out, because
cars that are parked now may be gone when the drive comes by again. A point keeps no label (0) where
no neighbour lies within ``RADIUS``, or where less than ``AGREEMENT`` of their weight agrees.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.formats.kitti360_boxes import WorldBoxes
from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.kitti360.accumulated import Window, cloud_values, read_cloud
from lidar_synth.lab.kitti360.movers import FLOOR, MARGIN, Movers, find_inside
from lidar_synth.lab.kitti360.nearest import Chunk, index_cloud
from lidar_synth.lab.kitti360.registration import apply, find_surfaces, register

RADIUS = 0.3
"""Maximum distance of a neighbour, metres."""

AGREEMENT = 0.6
"""Minimum share of the neighbours' weight for a label."""

VIEW = 100.0
"""Distance from the car, metres, within which clouds are indexed."""

FIT = 0.6
"""Minimum share of a scan's upright points that lie on the clouds; below it, pose and clouds do not
fit.

In the town it is 0.97 to 0.99; with poses 0.5 m off, without registration, 0.3 to 0.43.
"""

NEAREST = (0.15, np.radians(0.4))
FARTHEST = (1.4, np.radians(4))
"""Metres and radians by which a scan may lie off the clouds as it is, and up to which it is
corrected.

Scans of the town whose poses are 2.1 m off were moved by 1.5 to 1.9 m, to wrong places.
"""

ON_SURFACE = 0.1
"""Distance, metres, up to which a point lies on a static surface, also inside a box of a moving
object."""

BOX_CONFIDENCE = 0.5
"""Confidence of a label that only a box of a moving object supports."""

_WIDEST = 3000.0  # metres around the frames of a window
_CHUNK = 1 << 20  # points of a cloud read at a time
_HEIGHTS = (-50.0, 60.0)  # metres relative to the car
# Points that measure the fit, and their distance from the sensor, metres.
_PROBES = 1000
_PROBED = (3.0, 25.0)
# Height in the sensor's frame, metres, above which a point does not lie on the road.
_UPRIGHT = -1.0
# metres: a probe on the clouds, and a probe that the clouds reach at all
_CLOSE = 0.2
_ABOUT = 1.0
_FEW = 50  # probes that the clouds reach, below which a frame has too little structure to be judged
_COVERED = 0.2  # minimum share of the points within reach that have neighbours, in such a frame


@dataclass(frozen=True)
class Recovered:
    """The labels of one scan of N points.

    Args:
        values: (N,) values of the label file; 0 = no label.
        confidence: (N,) float32 in [0, 1]; 0 without a label.
        far: number of points without a neighbour.
        disputed: number of points whose neighbours disagree.
        moving: number of points of moving objects.
        moved: metres by which the scan was laid onto the clouds; 0 if it lay there.
        fit: share of the scan's upright points that lie on the clouds.
        fits: whether that is enough; if not, the labels are worthless.
    """

    values: NDArray[np.uint32]
    confidence: NDArray[np.float32]
    far: int
    disputed: int
    moving: int
    moved: float
    fit: float
    fits: bool


def _find_bounds(places: Float64Array, name: str) -> tuple[Float64Array, Float64Array]:
    """The lowest and the highest coordinates in view of the places (N, 3) of a window's scans."""
    low = places.min(axis=0) + np.array([-VIEW, -VIEW, _HEIGHTS[0]])
    high = places.max(axis=0) + np.array([VIEW, VIEW, _HEIGHTS[1]])
    if (high - low)[:2].max() > _WIDEST or (high - low)[2] > _WIDEST / 4:
        raise DataError(
            f"the poses of window {name} and its neighbours spread over "
            f"{(high - low).max():.0f} m",
            f"at most {_WIDEST:.0f} m: a window of KITTI-360 covers about 200 m",
            "Check data_poses.",
        )
    return low, high


class Recovery:
    """The clouds around the frames of one window, ready to label its scans.

    Args:
        windows: the window, and those before and after it.
        boxes: the boxes of the drive.
        poses: {frame: (4, 4)} sensor to world of the drive.
        frames: the frames to label; each has a pose.

    Raises:
        DataError, FileError: if a cloud cannot be read.
    """

    def __init__(
        self,
        windows: Sequence[Window],
        boxes: WorldBoxes | None,
        poses: Mapping[int, Float64Array],
        frames: Sequence[int],
    ) -> None:
        places = np.array([poses[f][:3, 3] for f in frames])
        self._poses = poses
        self._static = index_cloud(
            _chunks(windows), *_find_bounds(places, windows[0].name)
        )
        dynamic = [read_cloud(w.dynamic) for w in windows if w.dynamic is not None]
        span = range(min(w.first for w in windows), max(w.last for w in windows) + 100)
        self.movers = Movers(dynamic, boxes, span)
        self.turns = True
        self._surfaces = find_surfaces(self._static)
        self._moves: dict[int, Float64Array] = {}

    def choose_motion(self, scans: Mapping[int, NDArray[np.float32]]) -> None:
        """Find out whether scans were measured while the car moved, or are compensated, by what
        fits the clouds.

        Args:
            scans: {frame: points (N, 3)} of some frames.
        """
        fits = []
        for turns in (True, False):
            self.turns = turns
            for frame, points in scans.items():
                self._lay(points, frame)
            fits.append(
                sum(
                    self._on_clouds(self.place(points, f), points)[0]
                    for f, points in scans.items()
                )
            )
        self.turns = fits[0] >= fits[1]

    def place(self, points: NDArray[np.float32], frame: int) -> Float64Array:
        """(N, 3) the points of a scan in the world."""
        pose = self._poses[frame]
        local = (
            undo_ego_motion(points, ego_motion(self._poses, frame))
            if self.turns
            else points
        )
        placed = np.asarray(local @ pose[:3, :3].T + pose[:3, 3])
        return apply(self._moves[frame], placed) if frame in self._moves else placed

    def _lay(self, points: NDArray[np.float32], frame: int) -> float:
        """Lay a scan onto the clouds, if it lies off; metres by which it was moved, infinite if it
        would be too far."""
        self._moves.pop(frame, None)
        probes = points[_probes(points)]
        if not len(probes):
            return 0.0
        move = register(self.place(probes, frame), self._surfaces)
        local = np.linalg.inv(self._poses[frame]) @ move @ self._poses[frame]
        metres = float(np.linalg.norm(local[:3, 3]))
        cosine = (np.trace(local[:3, :3]) - 1) / 2
        angle = float(np.arccos(np.clip(cosine, -1, 1)))
        if metres <= NEAREST[0] and angle <= NEAREST[1]:
            return 0.0
        self._moves[frame] = move
        return metres if metres <= FARTHEST[0] and angle <= FARTHEST[1] else np.inf

    def label(self, points: NDArray[np.float32], frame: int) -> Recovered:
        """The labels of a scan: (N, 3) points in the sensor's frame, as measured."""
        moved = self._lay(points, frame)
        placed = self.place(points, frame)
        vote = self._static.vote(placed, RADIUS)
        values, share, trust, distance = vote
        moving = self._vote_of_movers(placed, frame, *vote)
        far = ~np.isfinite(distance)
        disputed = share < AGREEMENT
        confidence = (
            share * trust * (1 - np.minimum(distance, RADIUS) / (2 * RADIUS))
        ).astype(np.float32)
        values[far | disputed] = 0
        confidence[values == 0] = 0
        boxed = self._label_boxed(placed, frame, values, confidence, distance)
        close, about = self._on_clouds(placed, points)
        fits = (
            close >= FIT * about if about >= _FEW else bool((~far).mean() >= _COVERED)
        )
        return Recovered(
            values,
            confidence,
            far=int((far & ~boxed).sum()),
            disputed=int((disputed & ~far & ~boxed).sum()),
            moving=int((moving | boxed).sum()),
            moved=moved,
            fit=close / max(about, 1),
            fits=fits and np.isfinite(moved),
        )

    def _vote_of_movers(
        self,
        placed: Float64Array,
        frame: int,
        values: NDArray[np.uint32],
        share: NDArray[np.float32],
        trust: NDArray[np.float32],
        distance: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Replace the vote for points that are nearer to a moving object, and mark them."""
        nearer = np.zeros(len(placed), bool)
        cloud, labels = self.movers.at(frame)
        if len(cloud):
            low = cloud.min(axis=0) - RADIUS
            high = cloud.max(axis=0) + RADIUS
            near = np.flatnonzero(((placed > low) & (placed < high)).all(axis=1))
            index = index_cloud(
                [(cloud, labels, np.ones(len(cloud), np.float32))], low, high
            )
            vote = index.vote(placed[near], RADIUS)
            closer = vote.distance < distance[near]
            chosen = near[closer]
            values[chosen], share[chosen], trust[chosen], distance[chosen] = (
                v[closer] for v in vote
            )
            nearer[chosen] = True
        return nearer

    def _label_boxed(
        self,
        placed: Float64Array,
        frame: int,
        values: NDArray[np.uint32],
        confidence: NDArray[np.float32],
        distance: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Give points off the clouds the class of the moving object in whose box they lie, and mark
        them.

        An object without accumulated points has no other evidence; its points may be near to static
        ones.
        """
        boxed = np.zeros(len(placed), bool)
        for track in self.movers.present(frame):
            own = find_inside(track.boxes[frame], placed, MARGIN / 2, FLOOR)
            own = own[distance[own] > (RADIUS if len(track.points) else ON_SURFACE)]
            values[own] = track.semantic | track.instance << 16
            confidence[own] = BOX_CONFIDENCE
            boxed[own] = True
        return boxed

    def _on_clouds(
        self, placed: Float64Array, points: NDArray[np.float32]
    ) -> tuple[int, int]:
        """Of some upright points, the numbers of those on the clouds, and of those that the clouds
        reach."""
        distance = np.linalg.norm(points, axis=1)
        upright = np.flatnonzero(
            (points[:, 2] > _UPRIGHT)
            & (distance > _PROBED[0])
            & (distance < _PROBED[1])
        )
        probes = placed[upright[:: max(1, len(upright) // _PROBES)]]
        nearest = self._static.vote(probes, _ABOUT).distance
        return int((nearest < _CLOSE).sum()), int(np.isfinite(nearest).sum())


def _probes(points: NDArray[np.float32]) -> NDArray[np.intp]:
    """Some points that show how a scan lies: upright ones and ones on the road."""
    distance = np.linalg.norm(points, axis=1)
    near = (distance > _PROBED[0]) & (distance < _PROBED[1])
    upright = points[:, 2] > _UPRIGHT
    parts = (np.flatnonzero(near & upright), np.flatnonzero(near & ~upright))
    return np.concatenate([part[:: max(1, len(part) // _PROBES)] for part in parts])


def _chunks(windows: Sequence[Window]) -> Iterator[Chunk]:
    for window in windows:
        cloud = read_cloud(window.static)
        for start in range(0, len(cloud), _CHUNK):
            part = cloud[start : start + _CHUNK]
            points = np.column_stack([part[axis] for axis in "xyz"]).astype(np.float64)
            trust = np.clip(np.nan_to_num(part["confidence"]), 0, 1).astype(np.float32)
            yield points, cloud_values(part, str(window.static)), trust


def ego_motion(poses: Mapping[int, Float64Array], frame: int) -> Float64Array:
    """(4, 4) the sensor of the frame before, in the frame of the sensor at ``frame``.

    Without a pose of the frame before, the motion to the next frame is taken; without both, the car
    stood still.
    """
    if frame - 1 in poses:
        return np.asarray(np.linalg.inv(poses[frame]) @ poses[frame - 1])
    if frame + 1 in poses:
        return np.asarray(np.linalg.inv(poses[frame + 1]) @ poses[frame])
    return np.eye(4)


def undo_ego_motion(points: NDArray[np.floating], motion: Float64Array) -> Float64Array:
    """Points of one revolution as seen from the sensor's place at the moment of the pose.

    The sensor turns clockwise once per frame and looks ahead at the moment of the pose, so a point
    at azimuth a (counter-clockwise from ahead) was measured a / 2 pi of a frame earlier. This is
    the rule by which the dataset's own tool (kitti360Scripts, accumuLaser) accumulated its clouds.

    Args:
        points: (N, 3) metres, as measured.
        motion: (4, 4) from ``ego_motion``.
    """
    share = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi))[:, None].astype(
        np.float64
    )
    skew = (motion[:3, :3] - motion[:3, :3].T) / 2
    sine = np.sqrt((skew**2).sum() / 2)
    moved: Float64Array = points + share * motion[:3, 3]
    if sine > 0:  # Rodrigues' formula
        angle = share * np.arcsin(min(sine, 1.0))
        turned = points @ (skew.T / sine)
        moved += np.sin(angle) * turned + (1 - np.cos(angle)) * (
            turned @ (skew.T / sine)
        )
    return moved
