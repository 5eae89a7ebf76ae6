"""The package's own ``.npz`` files: a scan's points, or a range image, with all that is known about it. Lossless.

Arrays of both (numpy's format, never pickled)::

    sensor                       JSON, the keys of sensors.yaml
    id, domain                   text; 0 real, 1 synthetic
    pose                         (4, 4) float64, if known
    box_values, box_names ...    the fields of ``Boxes``, if there are any

A scan has ``points`` (N, 3) float32 and the fields of ``POINT_FIELDS`` that are known, (N,) each. A range image has
``range`` (H, W) float32 metres, 0 = no return, and one (H, W) array per channel.
"""

import json
import zipfile
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files import SKIP_HINT, STRAY, read_file, write_arrays
from lidar_synth.geometry.scan import POINT_FIELDS, Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor

FACTS = ("sensor", "id", "domain", "pose")
"""Names in a file that are no channels of a range image; so are those that begin with ``BOX``."""

BOX = "box_"

TYPES = {
    "points": "f4", "reflectance": "f4", "label": "u1", "raw_label": "u4", "instance": "i4", "ring": "i2",
    "confidence": "f4",
}  # fmt: skip
"""numpy's types of a scan's fields."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz``, or the one of an ``.npy`` under the name ``array``.

    Raises:
        FileError: where it cannot be read.
        DataError: where it is no such file, is damaged, or holds Python objects.
    """
    content = BytesIO(read_file(path))
    try:
        loaded = np.load(content, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"array": loaded}
        return {name: loaded[name] for name in loaded.files if name != STRAY}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: {error}", "arrays written by numpy, none of them pickled", SKIP_HINT) from error


def told_sensor(path: Path) -> Sensor | None:
    """The sensor that an ``.npz`` file of ours tells, without a look at the rest; None where it tells none."""
    try:
        with np.load(path, allow_pickle=False) as loaded:
            return Sensor.from_dict(json.loads(str(loaded["sensor"])))
    except (ValueError, OSError, EOFError, KeyError, TypeError, zipfile.BadZipFile):
        return None  # whoever reads the scan will say what is wrong with it


def write_scan(path: Path, scan: Scan) -> None:
    """A scan as ``.npz``; ``decode_scan`` is the inverse.

    Raises:
        FileError: where it cannot be written.
    """
    arrays = {"points": np.ascontiguousarray(scan.points), **scan.fields(), **_facts(scan)}
    write_arrays(path, arrays)


def decode_scan(arrays: dict[str, NDArray[Any]], where: str, sensor: Sensor | None = None) -> Scan:
    """The scan of an ``.npz``'s arrays.

    Args:
        arrays: as ``read_arrays`` gives them.
        where: what to name in the error, usually the path.
        sensor: for a file that does not tell its own.

    Raises:
        DataError: where points, reflectance or the sensor is missing or has another shape or type.
    """
    try:
        facts = _known(arrays, sensor)
        known: dict[str, Any] = {name: arrays[name] for name in POINT_FIELDS if name in arrays}
        scan = Scan(arrays["points"], **known, **facts)
        for name, values in {"points": scan.points, **scan.fields()}.items():
            if values.dtype != TYPES[name]:
                raise ValueError(f"{name} is {values.dtype}, not {TYPES[name]}")
        return scan
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where}: {error}", "points, reflectance and sensor of a scan") from error


def write_range_image(path: Path, image: RangeImage, scan: Scan | None = None) -> None:
    """A range image as compressed ``.npz``, with what is known of the scan that it shows; ``decode_range_image`` is
    the inverse.

    Raises:
        FileError: where it cannot be written.
    """
    facts = {"sensor": np.array(json.dumps(image.sensor.to_dict()))} if scan is None else _facts(scan, image.sensor)
    arrays = {"range": image.range, **image.channels, **facts}
    write_arrays(path, arrays, compressed=True)


def decode_range_image(
    arrays: dict[str, NDArray[Any]], where: str, sensor: Sensor | None = None
) -> tuple[RangeImage, dict[str, Any]]:
    """The range image of an ``.npz``'s arrays, and the fields of a ``Scan`` that belong to no cell.

    Raises:
        DataError: where range or sensor is missing, or a shape is not the sensor's.
    """
    try:
        facts = _known(arrays, sensor)
        channels = {n: a for n, a in arrays.items() if n not in ("range", *FACTS) and not n.startswith(BOX)}
        return RangeImage(arrays["range"], facts["sensor"], channels), facts
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where}: {error}", "range and sensor of a range image") from error


def _facts(scan: Scan, sensor: Sensor | None = None) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "sensor": np.array(json.dumps((sensor or scan.sensor).to_dict())),
        "id": np.array(scan.id),
        "domain": np.array(scan.domain),
    }
    if scan.pose is not None:
        facts["pose"] = scan.pose
    if scan.boxes is not None:
        facts |= {BOX + f.name: np.asarray(getattr(scan.boxes, f.name)) for f in fields(Boxes)}
        facts[BOX + "names"] = np.array(scan.boxes.names, np.str_)
    return facts


def _known(arrays: dict[str, NDArray[Any]], sensor: Sensor | None) -> dict[str, Any]:
    """The inverse of ``_facts``; a file's own sensor goes before the given one, and has to be the same."""
    known: dict[str, Any] = {"sensor": sensor}
    if "sensor" in arrays:
        known["sensor"] = Sensor.from_dict(json.loads(str(arrays["sensor"])))
        if sensor is not None and sensor.shape != known["sensor"].shape:
            raise ValueError(f"it was made for sensor {known['sensor'].name!r}, not for {sensor.name!r}")
    if known["sensor"] is None:
        raise KeyError("it does not tell its sensor: pass one")
    known |= {name: kind(arrays[name].item()) for name, kind in (("id", str), ("domain", int)) if name in arrays}
    if "pose" in arrays:
        known["pose"] = arrays["pose"]
    if BOX + "values" in arrays:
        boxes = {f.name: arrays[BOX + f.name] for f in fields(Boxes) if f.name != "names"}
        known["boxes"] = Boxes(**boxes, names=tuple(arrays[BOX + "names"].tolist()))
    return known
