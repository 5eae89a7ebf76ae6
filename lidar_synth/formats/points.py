"""Points on disk as KITTI stores them, and what every format checks of points.

A ``.bin`` has no header, so its size and its values are the only signs that it holds what its name says.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import DataError
from lidar_synth.files.disk import SKIP_HINT, unreadable, write_file
from lidar_synth.formats.calibration import check_rigid
from lidar_synth.geometry.scan import Scan

FARTHEST = 1e5
"""Metres: a coordinate beyond this is not a LiDAR's."""

_bad_points_kept = ContextVar("bad points kept", default=False)


def read_points(path: Path, fields: int = 4, reflectance_max: float = 1.0) -> NDArray[np.float32]:
    """The points of a raw ``.bin``: little-endian float32, ``fields`` per point, no header.

    Args:
        path: the file.
        fields: floats per point; the first three are x, y, z in metres, the fourth is reflectance.
        reflectance_max: the upper end of the fourth field's interval; the lower is 0.

    Returns:
        (N, fields) float32, checked by ``check_points``.

    Raises:
        FileError: where the file cannot be read.
        DataError: on an empty or cut file, and on values that are no points.
    """
    try:
        values = np.fromfile(path, "<f4")
        size = path.stat().st_size
    except OSError as error:
        raise unreadable(path, error) from error
    if size == 0:
        raise DataError(f"{path} is empty", f"{4 * fields} bytes for each point", SKIP_HINT)
    if size % (4 * fields):
        fits = [n for n in (4, 5, 6) if size % (4 * n) == 0]
        hint = ""
        if fits:
            n = fits[0]
            hint = f"The size fits {n} floats per point: pass fields={n} (convert --fields {n}) if it holds them. "
        raise DataError(
            f"{path} is {size} bytes long",
            f"a multiple of {4 * fields}: {fields} float32 for each point",
            f"{hint}It may have been cut. {SKIP_HINT}",
        )
    points = values.reshape(-1, fields)
    check_points(points, points[:, 3], str(path), reflectance_max)
    return points


def write_points(path: Path, scan: Scan) -> None:
    """The points of a scan as KITTI's ``.bin``, four floats each; the inverse of ``read_points``.

    Raises:
        FileError: where it cannot be written.
    """
    write_file(path, np.column_stack([scan.points, scan.reflectance]).astype("<f4").tobytes())


def check_points(
    points: NDArray[np.float32], reflectance: NDArray[np.float32], where: str, reflectance_max: float = 1.0
) -> None:
    """Refuse values that no scan holds.

    Args:
        points: (N, F) float32, the first three x, y, z in metres.
        reflectance: (N,) float32.
        where: what to name in the error, usually the path.
        reflectance_max: the upper end of the reflectance's interval; the lower is 0.

    Raises:
        DataError: on no points, NaN, infinity, coordinates beyond ``FARTHEST`` or reflectance outside.
    """
    if _bad_points_kept.get():
        good = finite(points, reflectance)
        points, reflectance = points[good], reflectance[good]
    if len(points) == 0:
        raise DataError(f"{where} holds no points", "at least one point", SKIP_HINT)
    # One pass over the memory tells that all is well; which value is at fault is looked for only if it is not.
    flat = points.reshape(-1)
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = not float(np.dot(flat, flat)) < FARTHEST**2
    low, high = float(reflectance.min()), float(reflectance.max())
    if suspicious or not np.isfinite(high - low):
        _find_bad_value(points, reflectance, where)
    scale = 255 if high <= 255 else 65535
    if not 0 <= low <= high <= reflectance_max:
        raise DataError(
            f"{where}: its reflectance (the fourth value of a point) runs from {low:g} to {high:g}",
            f"values in [0, {reflectance_max:g}]",
            f"Either it holds intensities on another scale (convert --reflectance-max {scale}, in Python "
            f"reflectance_max={scale}), or another number of floats per point (convert --fields 5, fields=5; nuScenes "
            "has 5), or it is damaged.",
        )


def finite(points: NDArray[np.float32], reflectance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) which points are finite, with their reflectance."""
    kept: NDArray[np.bool_] = np.isfinite(points).all(axis=1) & np.isfinite(reflectance)
    return kept


def without_bad_points(scan: Scan) -> Scan:
    """The scan without its points that are NaN or infinite; their labels and all else that is known of them go too.

    Raises:
        DataError: where none is left.
    """
    good = finite(scan.points, scan.reflectance)
    if good.all():
        return scan
    if not good.any():
        raise DataError(f"scan {scan.id!r}: all {len(scan)} points are NaN or infinite", "some that are not", SKIP_HINT)
    return scan[good]


@contextmanager
def bad_points_kept() -> Iterator[None]:
    """Inside, readers hand out points that are NaN or infinite, for those who drop them."""
    before = _bad_points_kept.set(True)
    try:
        yield
    finally:
        _bad_points_kept.reset(before)


def check_scan(scan: Scan, where: str, reflectance_max: float = 1.0) -> None:
    """``check_points`` for a scan whose arrays stood apart in its file, and what else it holds.

    Raises:
        DataError: as ``check_points``; on labels that are no train ids, a confidence outside of [0, 1], and a pose that
            is not rigid.
    """
    check_points(scan.points, scan.reflectance, where, reflectance_max)
    if scan.label is not None and ((scan.label >= len(NAMES)) & (scan.label != IGNORE)).any():
        raise DataError(f"{where}: labels {np.unique(scan.label)[-8:].tolist()}", "train ids 0..18, or 255 = ignore")
    if scan.confidence is not None and not ((scan.confidence >= 0) & (scan.confidence <= 1)).all():
        raise DataError(f"{where}: confidence from {scan.confidence.min()} to {scan.confidence.max()}", "0 to 1")
    if scan.pose is not None:
        check_rigid(scan.pose, f"{where}: its pose")


def _find_bad_value(points: NDArray[np.float32], reflectance: NDArray[np.float32], where: str) -> None:
    bad = np.flatnonzero(~finite(points, reflectance))
    if len(bad):
        raise DataError(
            f"{where}: {len(bad)} of {len(points)} points are NaN or infinite, the first is point {bad[0]}",
            "finite float32 values",
            f"{SKIP_HINT} on_bad='drop-points' (convert --on-bad drop-points) leaves out such points only.",
        )
    farthest = np.abs(points[:, :3]).max()
    if farthest > FARTHEST:
        raise DataError(
            f"{where}: a coordinate of {farthest:g} m",
            f"coordinates within {FARTHEST:g} m of the sensor, little-endian float32",
            SKIP_HINT,
        )
