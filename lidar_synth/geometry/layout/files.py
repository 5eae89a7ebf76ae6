"""Layouts as YAML files that people write.

::

    ground: -1.73                     # metres; 0 is the height of the sensor
    reach: 15                         # metres up to which the ground is known
    objects:
      # x forward, y left, metres; default: the size of its class, on the ground
      - {class: Van, at: [12, 0]}
      # degrees counter-clockwise from x
      - {class: Cyclist, at: [16.5, 0.4], heading: 180, size: [1.8, 0.6, 1.7]}
    outlines:
      - {kind: building, line: [[-10, 9], [40, 9]], height: 8}
      - {kind: vegetation, line: [[5, -7], [12, -7]], from: 2, height: 6}  # metres above the ground
"""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lidar_synth.errors import ConfigError, choose
from lidar_synth.files.parsing import read_yaml
from lidar_synth.geometry.layout.layout import Layout, Outline
from lidar_synth.geometry.scan import Boxes, wrap_angle

SIZES = {
    "Car": (4.3, 1.8, 1.5),
    "Van": (5.0, 2.0, 2.2),
    "Truck": (7.2, 2.5, 3.2),
    "Bus": (11.8, 2.55, 3.05),
    "Tram": (26.0, 2.4, 3.5),
    "Trailer": (3.5, 2.0, 1.8),
    "Pedestrian": (0.6, 0.6, 1.75),
    "Person_sitting": (0.8, 0.6, 1.25),
    "Cyclist": (1.8, 0.65, 1.75),
    "Motorcyclist": (2.1, 0.8, 1.7),
}
"""Length, width and height of each class of objects, metres."""

NAMES = {"Bus": "Misc", "Trailer": "Misc"}
"""The class of a box, where it is not the object's own."""

Metres = Annotated[float, Field(gt=-1000, lt=1000)]
Size = Annotated[float, Field(gt=0, lt=100)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Object(_Part):
    kind: Annotated[str, Field(alias="class")]
    at: tuple[Metres, Metres]
    heading: float = 0.0
    size: tuple[Size, Size, Size] | None = None
    above: Metres = 0.0


class _Wall(_Part):
    kind: Literal["building", "vegetation", "fence"]
    line: Annotated[list[tuple[Metres, Metres]], Field(min_length=2)]
    height: Metres
    low: Annotated[Metres, Field(alias="from")] = 0.0


class _File(_Part):
    ground: Metres = -1.73
    reach: Size = 15.0
    objects: list[_Object] = []
    outlines: list[_Wall] = []


_KEYS = {
    "": "ground, reach, objects and outlines",
    "objects": "class and at, and maybe heading, size and above",
    "outlines": "kind, line and height, and maybe from",
}
"""The keys of a file, and those of the entries of its lists."""


def load_layout(path: str | Path) -> Layout:
    """Read a layout from a YAML file; the module's docstring shows one.

    Raises:
        FileError: if it cannot be read.
        ConfigError: if it is not YAML, or has an unknown key or class, or an invalid value.
        DataError: on boxes that overlap or stand around the sensor, or another ground.

    Example:
        >>> from lidar_synth import load_layout
        >>> with open("behind.yaml", "w") as f:
        ...     _ = f.write("objects: [{class: Van, at: [12, 0]}, {class: Cyclist, at: [17, 0.5]}]")
        >>> load_layout("behind.yaml").boxes.names
        ('Van', 'Cyclist')
    """
    path = Path(path)
    values = read_yaml(path, "a layout")
    try:
        content = _File.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        place = first["loc"]
        where = ".".join(map(str, place)) or "its top level"
        fault = first["msg"].partition(" or instance of")[0]
        entry = str(place[0]) if len(place) > 1 else ""
        raise ConfigError(f"{path}: {where}: {fault}", _KEYS[entry]) from error
    ground = content.ground
    rows = [_box(item, ground, path) for item in content.objects]
    boxes = Boxes(
        np.array(rows, np.float32).reshape(-1, 7),
        tuple(NAMES.get(item.kind, item.kind) for item in content.objects),
    )
    walls = [
        Outline(
            wall.kind,
            np.array(wall.line, np.float32),
            ground + wall.low,
            ground + wall.height,
        )
        for wall in content.outlines
    ]
    return Layout(boxes, (ground, 0.0, 0.0), walls, content.reach, path.stem)


def _box(item: _Object, ground: float, path: Path) -> tuple[float, ...]:
    """The box (7,) of an object, see ``Boxes``."""
    usual = choose(f"{path}: an object of class", item.kind, SIZES)
    length, width, height = item.size or usual
    yaw = wrap_angle(np.radians(item.heading))
    return (
        *item.at,
        ground + item.above + height / 2,
        length,
        width,
        height,
        float(yaw),
    )
