"""MCAP files as recorders of ROS 2 write them."""

from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.formats.mcap import DEFINITION, MESSAGE, TYPES

OUSTER = {
    "x": ("f4", 0),
    "y": ("f4", 4),
    "z": ("f4", 8),
    "intensity": ("f4", 16),
    "t": ("u4", 20),
    "reflectivity": ("u2", 24),
    "ring": ("u2", 26),
    "ambient": ("u2", 28),
    "range": ("u4", 32),
}
"""The fields of Ouster's driver, {name: (type, offset)}, in 48 bytes a point."""


def cloud(
    number: int, rows: int = 8, columns: int = 64, order: str = "<", **changes: Any
) -> dict[str, Any]:
    """A message as a driver sends it: an image of points, a tenth of them without return."""
    rng = np.random.default_rng(number)
    kinds = {name: order + kind for name, (kind, _) in OUSTER.items()}
    layout: Any = {"names": list(kinds), "formats": list(kinds.values())}
    layout |= {"offsets": [at for _, at in OUSTER.values()], "itemsize": 48}
    points = np.zeros((rows, columns), np.dtype(layout))
    for axis in "xyz":
        points[axis] = rng.uniform(1, 20, points.shape)
    points["reflectivity"] = rng.integers(2, 256, points.shape)
    points["ring"] = np.arange(rows)[:, None]
    points["t"] = np.arange(columns) * 1_000_000
    lost = rng.random(points.shape) < 0.1
    for axis in "xyz":
        points[axis][lost] = 0 if changes.get("is_dense", True) else np.nan
    codes = {kind: code for code, kind in TYPES.items()}
    fields = [
        {"name": name, "offset": at, "datatype": codes[kind], "count": 1}
        for name, (kind, at) in OUSTER.items()
    ]
    return {
        "header": {"stamp": {"sec": number, "nanosec": 0}, "frame_id": "os_lidar"},
        "height": rows,
        "width": columns,
        "fields": fields,
        "is_bigendian": order == ">",
        "point_step": 48,
        "row_step": 48 * columns,
        "data": points.tobytes(),
        "is_dense": True,
    } | changes


def record(
    path: Path, messages: list[tuple[str, int, dict[str, Any]]], **options: Any
) -> Path:
    """Write messages (topic, time in ns, message) as a recorder does."""
    from mcap_ros2.writer import Writer

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as out, Writer(out, **options) as file:
        schema = file.register_msgdef(MESSAGE, DEFINITION)
        text = file.register_msgdef("std_msgs/msg/String", "string data")
        for number, (topic, time, message) in enumerate(messages):
            file.write_message("/rosout", text, {"data": f"line {number}"}, time)
            file.write_message(topic, schema, message, time)
    return path


def some_record(root: Path, count: int = 5, **options: Any) -> Path:
    messages = [("/points", 10 * n, cloud(n)) for n in range(count)]
    return record(root / "drive.mcap", messages, **options)
