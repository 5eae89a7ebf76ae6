"""PCD logs of a town, with the field names and types of the vendors' drivers."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar_synth.geometry.scan import Scan

NAMES = {"f": "F", "u": "U", "i": "I"}


def write_log(path: Path, columns: dict[str, np.ndarray]) -> None:
    """A binary PCD file with these fields, in these types."""
    kind = [(name, values.dtype) for name, values in columns.items()]
    records = np.empty(len(columns["x"]), kind)
    for name, values in columns.items():
        records[name] = values
    types = [values.dtype for values in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(t.itemsize) for t in types)}",
        f"TYPE {' '.join(NAMES[t.kind] for t in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {len(records)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        "DATA binary\n",
    ]
    path.write_bytes("\n".join(header).encode() + records.tobytes())


def turn_time(scan: Scan) -> np.ndarray:
    """Seconds since the seam behind the sensor, clockwise, at 10 turns a second."""
    return (
        -np.arctan2(*scan.points[:, 1::-1].T.astype(float)) / (2 * np.pi) + 0.5
    ) * 0.1


def axes(scan: Scan) -> dict[str, np.ndarray]:
    return dict(zip("xyz", scan.points.T, strict=True))


def velodyne(scan: Scan) -> dict[str, np.ndarray]:
    """Rings count from below."""
    ring = (scan.sensor.shape[0] - 1 - scan.ring).astype(np.uint16)
    intensity = np.round(255 * scan.reflectance).astype(np.float32)
    return {
        **axes(scan),
        "intensity": intensity,
        "ring": ring,
        "time": turn_time(scan).astype(np.float32),
    }


def hesai(scan: Scan) -> dict[str, np.ndarray]:
    """Times are those of the day, in float64."""
    intensity = np.round(255 * scan.reflectance).astype(np.float32)
    time = 1.7e9 + turn_time(scan)
    return {
        **axes(scan),
        "intensity": intensity,
        "timestamp": time,
        "ring": scan.ring.astype(np.uint16),
    }


def ouster(scan: Scan) -> dict[str, np.ndarray]:
    """Firings without a return are points at the origin; intensity counts photons."""
    lost = np.random.default_rng(0).random(len(scan)) < 0.18
    columns = {
        **axes(scan),
        "intensity": (1999 * scan.reflectance).astype(np.float32),
        "t": (1e9 * turn_time(scan)).astype(np.uint32),
        "reflectivity": np.round(255 * scan.reflectance).astype(np.uint16),
        "ring": scan.ring.astype(np.uint8),
        "ambient": np.full(len(scan), 7, np.uint16),
        "range": (1000 * np.linalg.norm(scan.points, axis=1)).astype(np.uint32),
    }
    for name in ("x", "y", "z", "range"):
        columns[name] = np.where(lost, 0, columns[name]).astype(columns[name].dtype)
    return columns


class Log(NamedTuple):
    """The preset that casts a town, and the fields of the driver."""

    sensor: str
    columns: Callable[[Scan], dict[str, np.ndarray]]


LOGS = {
    "velodyne": Log("vlp16", velodyne),
    "hesai": Log("pandar64", hesai),
    "ouster": Log("os1_64", ouster),
}
