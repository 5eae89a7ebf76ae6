"""Objects of a synthetic scan that have no box: a detector would learn that they are background.

Points of classes that detectors find are joined to clusters. Clusters outside all boxes are
counted, and removed with their holes filled.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import BOXED, GROUND, NAMES
from lidar_synth.errors import DataError
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels.edit.redraw import Model
from lidar_synth.labels.edit.removal import remove_returns
from lidar_synth.labels.ground import FLOOR, standing
from lidar_synth.labels.objects import enclose

LEAST = 20
"""Minimum number of points of an unboxed object; smaller ones are too small for a detector, too."""

TOLERANCE = 0.2
"""Metres outside a box within which a point still belongs to it."""

_REACH = 0.5  # metres; side of the cubes of which neighbours are joined


class Unboxed(NamedTuple):
    """The unboxed objects of a scan, or the sums over several.

    Args:
        scans: number of scans.
        objects: number of clusters outside all boxes.
        points: number of points of boxed classes.
        outside: number of those outside all boxes.
    """

    scans: int
    objects: int
    points: int
    outside: int

    @property
    def share(self) -> float:
        """Share of the points of boxed classes that lie outside all boxes."""
        return self.outside / max(self.points, 1)

    def __str__(self) -> str:
        rate = self.objects / max(self.scans, 1)
        return (
            f"{rate:.1f} objects without a box a scan ({self.share:.0%} of the points of their "
            "classes)"
        )


def clusters(
    scan: Scan, classes: Iterable[int] = BOXED, least: int = LEAST
) -> NDArray[np.int64]:
    """(N,) number of the unboxed object of each point, from 1 on; 0 = none.

    Args:
        scan: N points; without labels there is nothing to find, without boxes every object is
            unboxed.
        classes: train ids of the classes that have boxes.
        least: minimum number of points of an object.
    """
    number = np.zeros(len(scan), np.int64)
    outside = np.flatnonzero(_outside(scan, classes))
    if len(outside):
        group = join_cubes(scan.points[outside], _REACH)
        large = np.bincount(group) >= least
        number[outside] = (np.cumsum(large) * large)[group]
    return number


def join_cubes(points: NDArray[np.floating], side: float) -> NDArray[np.int64]:
    """(N,) number of the group of each point, from 0 on in the order of x: points in the same or in
    touching cubes are of one group, so that two groups are at least ``side`` from each other.

    Args:
        points: (N, 3) metres, N > 0; they span less than 10^6 cubes.
        side: of the cubes, metres.
    """
    cube = np.floor(points / side).astype(np.int64)
    cube -= cube.min(0) - 1
    keys, of = np.unique(
        (cube[:, 0] << 40) | (cube[:, 1] << 20) | cube[:, 2], return_inverse=True
    )
    root = np.arange(len(keys))
    _join(keys, _NEIGHBOURS, root)
    group: NDArray[np.int64] = np.unique(root, return_inverse=True)[1]
    return group[of]


def measure(
    scans: Iterable[Scan], classes: Iterable[int] = BOXED, least: int = LEAST
) -> Unboxed:
    """Count the unboxed objects of scans.

    Example:
        >>> from lidar_synth import load_generator
        >>> from lidar_synth.labels.edit import measure
        >>> found = measure(load_generator("town").scans(seed=0, indices=[0]))
        >>> found.scans, found.share  # the model generates no boxes
        (1, 1.0)
    """
    total = Unboxed(0, 0, 0, 0)
    for scan in scans:
        counts = (
            1,
            int(clusters(scan, classes, least).max(initial=0)),
            int(_outside(replace(scan, boxes=None), classes).sum()),
            int(_outside(scan, classes).sum()),
        )
        total = Unboxed(*(a + b for a, b in zip(total, counts, strict=True)))
    return total


def remove_unboxed(
    scan: Scan,
    model: Model = None,
    seed: int = 0,
    classes: Iterable[int] = BOXED,
    least: int = LEAST,
) -> Scan:
    """Remove the unboxed objects of a scan, and fill the holes with what is behind them.

    Args:
        scan: N points with labels; without labels the scan is returned as it is.
        model: draws the holes; None fills them by geometry.
        seed: of the model's noise.
        classes, least: see ``clusters``.
    """
    number = clusters(scan, classes, least)
    parts = [
        _with_rim(scan, number == k) for k in range(1, int(number.max(initial=0)) + 1)
    ]
    return remove_returns(scan, parts, model, seed) if parts else scan


@dataclass(frozen=True)
class Refusal:
    """Refuses scans with unboxed objects."""

    def __call__(self, scan: Scan) -> Scan:
        if count := int(clusters(scan).max(initial=0)):
            raise DataError(
                f"synthetic scan {scan.id!r} with {count} objects without a box",
                "a box for every object of " + ", ".join(NAMES[c] for c in BOXED),
                "unboxed='close' removes them and fills the holes; unboxed='keep' keeps them.",
            )
        return scan


def _keep(scan: Scan) -> Scan:
    return scan


HANDLING: dict[str, Callable[[Scan], Scan]] = {
    "close": remove_unboxed,
    "keep": _keep,
    "error": Refusal(),
}
"""What is done to unboxed objects of scans with boxes, by name."""


def _outside(scan: Scan, classes: Iterable[int]) -> NDArray[np.bool_]:
    """(N,) True for points of some classes outside all boxes."""
    if scan.label is None:
        return np.zeros(len(scan), bool)
    outside: NDArray[np.bool_] = np.isin(scan.label, list(classes))
    if scan.boxes is not None and len(scan.boxes) and outside.any():
        inside = scan.boxes.enlarged(TOLERANCE).contain(scan.points[outside])
        outside[outside] = ~inside.any(0)
        if scan.instance is not None:
            outside &= ~(
                (scan.instance > 0) & np.isin(scan.instance, scan.boxes.instance)
            )
    return outside


def _with_rim(
    scan: Scan, mine: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """The returns of a cluster with those at its rim that have another label, and the box (7,)
    around it."""
    box = enclose(scan.points[mine])
    around = Boxes(box, ("Misc",)).contain(scan.points, above_floor=FLOOR)[0]
    if scan.label is not None:
        around &= ~GROUND[scan.label]
    if scan.boxes is not None:
        around &= ~standing(scan, scan.boxes).any(0)
    return mine | around, box


_NEIGHBOURS = np.array(
    [
        (x << 40) + (y << 20) + z
        for x in (0, 1)
        for y in (-1, 0, 1)
        for z in (-1, 0, 1)
        if (x, y, z) > (0, 0, 0)
    ],
    np.int64,
)
"""Differences of the keys of a cube and of the half of its neighbours that come after it."""


@numba.njit(cache=True)
def _join(keys, neighbours, root):  # type: ignore[no-untyped-def]
    """Fill ``root`` (K,) with the first of all cubes that each is connected with; keys (K,) are
    sorted."""
    for i in range(len(keys)):
        for step in neighbours:
            j = np.searchsorted(keys, keys[i] + step)
            if j < len(keys) and keys[j] == keys[i] + step:
                a = i
                b = j
                while root[a] != a:
                    a = root[a]
                while root[b] != b:
                    b = root[b]
                root[max(a, b)] = min(a, b)
    for i in range(len(keys)):
        root[i] = root[root[i]]  # roots come before their cubes
