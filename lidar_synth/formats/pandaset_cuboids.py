"""PandaSet's cuboids: a pickled table for each frame, in the world frame."""

from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.formats.pandas_table import read_table, require_numbers
from lidar_synth.geometry import Boxes
from lidar_synth.geometry.motion import from_world

BOXES = {
    "Car": "Car",
    "Pickup Truck": "Truck",
    "Medium-sized Truck": "Truck",
    "Semi-truck": "Truck",
    "Towed Object": "Misc",
    "Motorcycle": "Misc",
    "Other Vehicle - Construction Vehicle": "Misc",
    "Other Vehicle - Uncommon": "Misc",
    "Other Vehicle - Pedicab": "Misc",
    "Emergency Vehicle": "Misc",
    "Bus": "Misc",
    "Personal Mobility Device": "Misc",
    "Motorized Scooter": "Misc",
    "Bicycle": "Misc",
    "Train": "Tram",
    "Trolley": "Tram",
    "Tram / Subway": "Tram",
    "Pedestrian": "Pedestrian",
    "Pedestrian with Object": "Pedestrian",
    "Animals - Bird": None,
    "Animals - Other": None,
    "Pylons": None,
    "Road Barriers": None,
    "Signs": None,
    "Cones": None,
    "Construction Signs": None,
    "Temporary Construction Barriers": None,
    "Rolling Containers": None,
}
"""{PandaSet's class: KITTI's name; None = no box}. A bicycle with a rider is a ``Cyclist``."""


CYCLIST = ("Bicycle", "With Rider")


def read_cuboids(path: Path, pose: NDArray[np.float64], other_sensor: int) -> Boxes:
    """The boxes of one frame in the sensor frame; those that only the other sensor saw are left
    out.

    Args:
        path: the table.
        pose: (4, 4) sensor to world.
        other_sensor: 0 = Pandar64 or 1 = PandarGT. Of an object in the view of both, each sensor
            has a box of its own; -1 in the table stands for all other objects.

    Raises:
        FileError: if it cannot be read.
        DataError: on a class that PandaSet does not have, or impossible boxes.
    """
    numbers = (
        "position.x",
        "position.y",
        "position.z",
        "dimensions.y",
        "dimensions.x",
        "dimensions.z",
        "yaw",
    )
    table = read_table(
        path,
        (*numbers, "label", "uuid"),
        ("cuboids.sensor_id", "attributes.rider_status"),
    )
    require_numbers(table, numbers, path)
    labels = table["label"].tolist()
    if unknown := sorted({str(label) for label in labels} - BOXES.keys()):
        raise DataError(f"boxes of class {unknown[:5]}", "classes of PandaSet")
    riders = table.get("attributes.rider_status", np.full(len(labels), None)).tolist()
    pairs = zip(labels, riders, strict=True)
    names = ["Cyclist" if pair == CYCLIST else BOXES[pair[0]] for pair in pairs]
    kept = np.array([name is not None for name in names], bool)
    kept &= table.get("cuboids.sensor_id", np.full(len(labels), -1)) != other_sensor
    values = np.stack([table[name][kept] for name in numbers], -1).astype(np.float64)
    # PandaSet's yaw turns a box whose length is along y.
    with np.errstate(invalid="ignore"):  # Boxes refuses what is not finite
        across = np.stack([-np.sin(values[:, 6]), np.cos(values[:, 6])], -1)
        heading = across @ pose[:2, :3]
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    instance = list(map(track_number, table["uuid"][kept]))
    return Boxes(
        np.column_stack([from_world(values[:, :3], pose), values[:, 3:6], yaw]),
        tuple(np.array(names, object)[kept]),
        instance=np.array(instance),
    )


def track_number(name: object) -> int:
    """The instance of a track by its name, the same in every frame."""
    return crc32(str(name).encode("utf-8", "replace")) >> 1
