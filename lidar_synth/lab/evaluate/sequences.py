"""Consistency of sequences: does the world stand still between scans when the sensor moves as its
poses say?

LiDARCrafter (https://github.com/worldbench/lidarcrafter, ``lidargen/metrics/temporal.py``) measures
both errors: it registers scans three and four frames apart by ICP from the identity with matches
within 2 m, and compares the translation with that of the poses (mean of the three absolute
differences, metres); and it takes the mean of both mean squared nearest distances of scans one to
four frames apart in world coordinates. Its figures are for nuScenes, of points more than 0.2 m from
the sensor.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, LibraryError
from lidar_synth.geometry.scan import Scan

NEAR = 0.2
MATCH = 2.0
"""Distance from the sensor up to which points are left out, and that of two matching points;
metres."""

ROUNDS = 30
STILL = 1e-6
"""Most rounds of ICP, and the relative change of fitness and error at which it stops; Open3D's
defaults."""


def registration_error(scans: Sequence[Scan], apart: int = 3) -> float:
    """Mean over pairs of scans of the mean absolute difference between the translation that ICP
    finds and that of the poses, metres.

    Args:
        scans: consecutive ones with poses.
        apart: frames between the two scans of a pair.

    Raises:
        ConfigError: on ``apart`` < 1.
        DataError: on fewer than ``apart`` + 1 scans, scans without poses or points, or scans no
            part of which matches.
        LibraryError: without scipy.
    """
    errors = []
    for a, b in _pairs(scans, apart):
        expected = np.linalg.inv(_pose(b)) @ _pose(a)
        found = register(_cloud(a), _cloud(b))
        errors.append(np.abs(found[:3, 3] - expected[:3, 3]).mean())
    return float(np.mean(errors))


def chamfer_error(scans: Sequence[Scan], apart: int = 1) -> float:
    """Mean over pairs of scans, in world coordinates, of the mean of both mean squared nearest
    distances, m^2.

    Args, Raises: as ``registration_error``.
    """
    tree = _tree()
    errors = []
    for pair in _pairs(scans, apart):
        a, b = (_cloud(s) @ _pose(s)[:3, :3].T + _pose(s)[:3, 3] for s in pair)
        errors.append(((tree(b).query(a)[0] ** 2).mean() + (tree(a).query(b)[0] ** 2).mean()) / 2)
    return float(np.mean(errors))


def register(
    source: NDArray[np.float64], target: NDArray[np.float64], match: float = MATCH
) -> NDArray[np.float64]:
    """(4, 4) transform from one cloud to another by point-to-point ICP from the identity (Besl and
    McKay, PAMI 1992).

    Args:
        source, target: (N, 3) and (M, 3) metres.
        match: greatest distance of two matching points, metres.

    Raises:
        DataError: where fewer than three points match.
        LibraryError: without scipy.
    """
    tree = _tree()(target)
    transform = np.eye(4)
    before = (0.0, 0.0)
    for _ in range(ROUNDS):
        moved = source @ transform[:3, :3].T + transform[:3, 3]
        distance, index = tree.query(moved, distance_upper_bound=match)
        near = np.isfinite(distance)
        if near.sum() < 3:
            raise DataError(
                f"{int(near.sum())} of {len(source)} points match within {match:g} m",
                "at least three",
            )
        now = float(near.mean()), float(np.sqrt((distance[near] ** 2).mean()))
        transform = _rigid(moved[near], target[index[near]]) @ transform
        if all(abs(a - b) < STILL for a, b in zip(now, before, strict=True)):
            break
        before = now
    return transform


def _rigid(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) rotation and translation of least squares from points to points (Kabsch, 1976)."""
    mean_a = a.mean(0)
    mean_b = b.mean(0)
    u, _, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    flip = np.diag([1, 1, np.linalg.det(vt.T @ u.T)])
    result = np.eye(4)
    result[:3, :3] = vt.T @ flip @ u.T
    result[:3, 3] = mean_b - result[:3, :3] @ mean_a
    return result


def _pairs(scans: Sequence[Scan], apart: int) -> list[tuple[Scan, Scan]]:
    if apart < 1:
        raise ConfigError(f"scans {apart} frames apart", "at least 1")
    if len(scans) <= apart:
        raise DataError(f"{len(scans)} scans, compared {apart} frames apart", f"more than {apart}")
    return [(scans[i], scans[i + apart]) for i in range(len(scans) - apart)]


def _pose(scan: Scan) -> NDArray[np.float64]:
    if scan.pose is None:
        raise DataError(f"scan {scan.id!r} without a pose", "scans with poses")
    return scan.pose


def _cloud(scan: Scan) -> NDArray[np.float64]:
    far = np.linalg.norm(scan.points, axis=1) > NEAR
    points: NDArray[np.float64] = scan.points[far].astype(np.float64)
    if not len(points):
        raise DataError(f"scan {scan.id!r} without returns beyond {NEAR} m", "a scan with returns")
    return points


def _tree() -> Any:
    try:
        from scipy.spatial import cKDTree
    except ImportError as error:
        raise LibraryError(
            "sequences are compared with scipy, which is not installed",
            "scipy",
            "pip install 'lidar_synth[metrics]'",
        ) from error
    return cKDTree
