"""KITTI's ``.bin`` files of points, and checks of points for all formats.

A ``.bin`` file has no header, so only its size and its values show whether it holds points.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import check_labels
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import SKIP_HINT, reading, refuse_special, write_file
from lidar_synth.formats.calibration import check_rigid
from lidar_synth.geometry import FARTHEST, Scan
from lidar_synth.geometry.arrays import Float32Array

LONGEST = 60.0
"""Maximum time of a point from the moment of its scan's pose, seconds."""

_FOR_ALL = ", or the largest value of all scans: all are divided by it"

_FOURTH = " (the fourth value of a point)"
_FIELDS = (
    ", or another number of floats per point (--fields 5, fields=5; nuScenes has 5)"
)

_bad_points_kept = ContextVar("bad points kept", default=False)


def read_points(
    path: Path, fields: int = 4, reflectance_max: float | None = None
) -> Float32Array:
    """Read the points of a raw ``.bin`` file: little-endian float32, ``fields`` per point, no
    header.

    Args:
        path: the file.
        fields: floats per point; the first three are x, y, z in metres, the fourth is reflectance.
        reflectance_max: maximum of the fourth field, by default 1; the minimum is 0.

    Returns:
        (N, fields) float32, checked by ``check_points``; the fourth divided by its maximum.

    Raises:
        FileError: if the file cannot be read.
        DataError: on an empty or truncated file, and on values that cannot be points.
    """
    with reading(path):
        refuse_special(path)
        values = np.fromfile(path, "<f4")
        size = path.stat().st_size
    if size == 0:
        raise DataError(
            f"{path} is empty", f"{4 * fields} bytes for each point", SKIP_HINT
        )
    if size % (4 * fields):
        fits = [n for n in (4, 5, 6) if size % (4 * n) == 0]
        hint = ""
        if fits:
            n = fits[0]
            hint = (
                f"The size fits {n} floats per point: pass fields={n} (--fields {n}) if it holds "
                "them. "
            )
        raise DataError(
            f"{path} is {size} bytes long",
            f"a multiple of {4 * fields}: {fields} float32 for each point",
            f"{hint}It may be truncated. {SKIP_HINT}",
        )
    points = values.reshape(-1, fields)
    check_points(points, points[:, 3], str(path), reflectance_max or 1.0)
    points[:, 3] /= np.float32(reflectance_max or 1)
    return points


def check_scale(reflectance_max: float | None) -> float | None:
    """The maximum of the reflectance, if there can be such a one.

    Raises:
        ConfigError: on one that is not above 0 and finite.
    """
    if not (reflectance_max is None or 0 < reflectance_max < np.inf):
        raise ConfigError(f"reflectance_max={reflectance_max}", "above 0")
    return reflectance_max


def write_points(path: Path, scan: Scan) -> None:
    """Write the points of a scan as KITTI's ``.bin``, four floats each; the inverse of
    ``read_points``.

    Raises:
        FileError: if it cannot be written.
    """
    write_file(
        path, np.column_stack([scan.points, scan.reflectance]).astype("<f4").tobytes()
    )


def check_points(
    points: Float32Array,
    reflectance: Float32Array,
    where: str,
    reflectance_max: float = 1.0,
) -> None:
    """Refuse impossible values of points.

    Args:
        points: (N, F) float32, the first three x, y, z in metres.
        reflectance: (N,) float32.
        where: name of the points in the error, usually the path.
        reflectance_max: maximum of the reflectance; the minimum is 0.

    Raises:
        DataError: on no points, NaN, infinity, coordinates beyond ``FARTHEST``, or reflectance out
            of its interval.
    """
    if _bad_points_kept.get():
        good = finite(points, reflectance)
        points = points[good]
        reflectance = reflectance[good]
    if len(points) == 0:
        raise DataError(f"{where} holds no points", "at least one point", SKIP_HINT)
    # One pass over the memory detects bad values; they are searched only if there are any.
    flat = points.reshape(-1)
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = not float(np.dot(flat, flat)) < FARTHEST**2
    low = float(reflectance.min())
    high = float(reflectance.max())
    if suspicious or not np.isfinite(high - low):
        _find_bad_value(points, reflectance, where)
    scale = 255 if high <= 255 else int(np.ceil(high))
    if not 0 <= low <= high <= reflectance_max:
        plain = where.endswith((".bin", ".npy"))
        raise DataError(
            f"{where}: its reflectance{_FOURTH * plain} runs from {low:g} to {high:g}",
            f"values in [0, {reflectance_max:g}]",
            f"Either it holds intensities on another scale (--reflectance-max {scale}, in Python "
            f"reflectance_max={scale}{_FOR_ALL if scale > 255 else ''}){_FIELDS * plain}, or it is "
            "damaged.",
        )


def finite(points: Float32Array, reflectance: Float32Array) -> NDArray[np.bool_]:
    """(N,) True for points whose coordinates and reflectance are finite."""
    good: NDArray[np.bool_] = np.isfinite(points).all(axis=1) & np.isfinite(reflectance)
    return good


def drop_bad_points(scan: Scan) -> Scan:
    """Drop the points of a scan that are NaN or infinite, with their labels and other fields.

    Raises:
        DataError: if no point is left.
    """
    good = finite(scan.points, scan.reflectance)
    if good.all():
        return scan
    if not good.any():
        raise DataError(
            f"scan {scan.id!r}: all {len(scan)} points are NaN or infinite",
            "finite points",
            SKIP_HINT,
        )
    return scan[good]


@contextmanager
def bad_points_kept() -> Iterator[None]:
    """Let readers return points that are NaN or infinite within this context, for callers that drop
    them."""
    before = _bad_points_kept.set(True)
    try:
        yield
    finally:
        _bad_points_kept.reset(before)


def check_scan(scan: Scan, where: str, reflectance_max: float = 1.0) -> None:
    """Check the points of a scan, and its labels, confidence, times and pose.

    Raises:
        DataError: as ``check_points``; on labels that are not train ids, a confidence outside [0,
            1], times beyond ``LONGEST``, and a pose that is not rigid.
    """
    check_points(scan.points, scan.reflectance, where, reflectance_max)
    if scan.label is not None:
        check_labels(scan.label, where)
    if (
        scan.confidence is not None
        and not ((scan.confidence >= 0) & (scan.confidence <= 1)).all()
    ):
        raise DataError(
            f"{where}: confidence from {scan.confidence.min()} to {scan.confidence.max()}",
            "0 to 1",
        )
    if (
        scan.time is not None
        and not (
            np.abs(scan.time[finite(scan.points, scan.reflectance)]) <= LONGEST
        ).all()
    ):
        raise DataError(
            f"{where}: times from {scan.time.min():g} to {scan.time.max():g}",
            f"seconds from the moment of the pose, within {LONGEST:g}",
        )
    if scan.pose is not None:
        check_rigid(scan.pose, f"{where}: its pose")


def _find_bad_value(
    points: Float32Array, reflectance: Float32Array, where: str
) -> None:
    bad = np.flatnonzero(~finite(points, reflectance))
    if len(bad):
        raise DataError(
            f"{where}: {len(bad)} of {len(points)} points are NaN or infinite, the first is "
            f"point {bad[0]}",
            "finite float32 values",
            f"{SKIP_HINT} on_bad='drop-points' (--on-bad drop-points) drops only these points.",
        )
    farthest = np.abs(points[:, :3]).max()
    if farthest > FARTHEST:
        raise DataError(
            f"{where}: a coordinate of {farthest:g} m",
            f"coordinates within {FARTHEST:g} m of the sensor, little-endian float32",
            SKIP_HINT,
        )
