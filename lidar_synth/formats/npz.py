"""The package's own ``.npz`` files: a scan's points, or a range image, with all other fields.
Lossless.

Arrays of both (numpy's format, never pickled)::

    sensor                       JSON, the keys of sensors.yaml
    id, domain                   text; 0 real, 1 synthetic
    provenance                   JSON, what made the scan (``Scan.provenance``), if known
    pose                         (4, 4) float64, if known
    box_values, box_names ...    the fields of ``Boxes``, if there are any

A scan has ``points`` (N, 3) float32 and the fields of ``POINT_FIELDS`` that are known, (N,) each. A
range image has ``range`` (H, W) float32 metres, 0 = no return, and one (H, W) array per channel.
"""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, check_labels
from lidar_synth.errors import DataError, LidarSynthError, parsing, shorten
from lidar_synth.files.disk import SKIP_HINT, write_arrays
from lidar_synth.files.parsing import parse_json, read_arrays
from lidar_synth.formats.description import check_provenance
from lidar_synth.geometry import (
    POINT_FIELDS,
    REAL,
    SYNTHETIC,
    Boxes,
    RangeImage,
    Scan,
    Sensor,
    to_types,
)

FACTS = ("sensor", "id", "domain", "provenance", "pose")
"""Names in a file that are not channels of a range image, like those that begin with ``BOX``."""

BOX = "box_"


def read_stored_sensor(path: Path) -> Sensor | None:
    """The sensor that is stored in an ``.npz`` file, without reading its other arrays; None if
    there is none."""
    try:
        return _sensor(read_arrays(path, only=["sensor"]))
    except (LidarSynthError, KeyError):
        return None  # reading the scan will raise the error


def write_scan(path: Path, scan: Scan) -> None:
    """Write a scan as ``.npz``; ``decode_scan`` is the inverse.

    Raises:
        FileError: if it cannot be written.
    """
    write_arrays(path, {"points": scan.points, **scan.fields(), **_facts(scan)})


def decode_scan(
    arrays: dict[str, NDArray[Any]], where: str, sensor: Sensor | None = None
) -> Scan:
    """Make a scan from the arrays of an ``.npz`` file.

    Args:
        arrays: the result of ``read_arrays``.
        where: name of the file in the error.
        sensor: takes precedence over the file's own sensor.

    Raises:
        DataError: if points, reflectance or the sensor is missing, or has a wrong shape; as
            ``to_types``.
    """
    expected = "points, reflectance and sensor of a scan"
    if not {"points", "reflectance"} <= arrays.keys():
        raise DataError(f"{where} holds {shorten(', '.join(arrays), 100)}", expected)
    known: dict[str, Any] = to_types(
        {n: a for n, a in arrays.items() if n in ("points", *POINT_FIELDS)}, where
    )
    with parsing(where, expected):
        facts = _known(arrays, sensor) | ({} if sensor is None else {"sensor": sensor})
        return Scan(**known, **facts)


def write_range_image(path: Path, image: RangeImage, scan: Scan | None = None) -> None:
    """Write a range image as compressed ``.npz``, with the facts of its scan;
    ``decode_range_image`` is the inverse.

    Raises:
        FileError: if it cannot be written.
    """
    facts = (
        {"sensor": np.array(json.dumps(image.sensor.to_dict()))}
        if scan is None
        else _facts(scan, image.sensor)
    )
    arrays = {
        "range": image.range,
        **image.channels,
        **facts,
    }
    write_arrays(path, arrays, compressed=True)


def decode_range_image(
    arrays: dict[str, NDArray[Any]], where: str, sensor: Sensor | None = None
) -> tuple[RangeImage, dict[str, Any]]:
    """Make a range image from the arrays of an ``.npz`` file; also return the scan's facts that are
    not per cell.

    Raises:
        DataError: if range or sensor is missing, or a shape does not match the sensor.
    """
    channels = to_types(
        {
            n: a
            for n, a in arrays.items()
            if n not in ("range", *FACTS) and not n.startswith(BOX)
        },
        where,
    )
    with parsing(where, "range and sensor of a range image"):
        facts = _known(arrays, sensor)
        if sensor is not None and sensor.shape != facts["sensor"].shape:
            raise ValueError(
                f"it was made for sensor {facts['sensor'].name!r}, not for {sensor.name!r}"
            )
        return range_image(arrays["range"], facts["sensor"], channels, where), facts


def range_image(
    distance: NDArray[Any],
    sensor: Sensor,
    channels: dict[str, NDArray[Any]],
    where: str,
) -> RangeImage:
    """Make a range image, after checking the values of all cells.

    Raises:
        DataError: on text, NaN, infinite or negative ranges, which would silently become cells
            without a return; if most ranges exceed the sensor's, as in another unit; on a shape
            that does not match the sensor; on labels that are not train ids, and on reflectance or
            confidence outside [0, 1]. Values of cells without a return are ignored, and set as
            ``RangeImage`` defines.
    """
    check_numbers(distance, f"{where}: range")
    image = RangeImage(distance, sensor, channels)
    bad = ~(np.isfinite(image.range) & (image.range >= 0))
    if bad.any():
        raise DataError(
            f"{where}: {bad.sum()} cells whose range is negative or not finite",
            "metres, 0 = no return",
        )
    far = np.count_nonzero(image.range > sensor.range_max)
    if 2 * far > np.count_nonzero(image.mask):
        raise DataError(
            f"{where}: {far} ranges exceed the {sensor.range_max:g} m of {sensor.name!r}, up to "
            f"{image.range.max():g}",
            "metres, 0 = no return",
            "Divide the files' values if they are in another unit.",
        )
    for name in [n for n in image.channels if n in POINT_FIELDS]:
        values = image.channels[name].copy()
        values[~image.mask] = IGNORE if name == "label" else 0
        image.channels[name] = values
        _check_channel(name, values, where)
    return image


def _check_channel(name: str, values: NDArray[Any], where: str) -> None:
    if (
        name in ("reflectance", "confidence")
        and not ((values >= 0) & (values <= 1)).all()
    ):
        raise DataError(
            f"{where}: {name} from {values.min()} to {values.max()}", "0 to 1"
        )
    if name == "label":
        check_labels(values, where)


def check_numbers(array: NDArray[Any], where: str) -> None:
    """Refuse text instead of numbers.

    Raises:
        DataError: on text.
    """
    if array.dtype.kind not in "biuf":
        raise DataError(f"{where} holds {array.dtype}", "numbers", SKIP_HINT)


def _sensor(arrays: Mapping[str, NDArray[Any]]) -> Sensor:
    """The sensor stored in the arrays; raises KeyError if there is none."""
    return Sensor.from_dict(
        parse_json(str(arrays["sensor"]), "its sensor", "the keys of sensors.yaml")
    )


def _facts(scan: Scan, sensor: Sensor | None = None) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "sensor": np.array(json.dumps((sensor or scan.sensor).to_dict())),
        "id": np.array(scan.id),
        "domain": np.array(scan.domain),
    }
    if scan.provenance:
        facts["provenance"] = np.array(json.dumps(dict(scan.provenance)))
    if scan.pose is not None:
        facts["pose"] = scan.pose
    if scan.boxes is not None:
        facts |= {
            BOX + f.name: np.asarray(getattr(scan.boxes, f.name)) for f in fields(Boxes)
        }
        facts[BOX + "names"] = np.array(scan.boxes.names, np.str_)
    return facts


def _known(arrays: dict[str, NDArray[Any]], sensor: Sensor | None) -> dict[str, Any]:
    """The inverse of ``_facts``, with the given sensor if the file has none."""
    known: dict[str, Any] = {
        "sensor": _sensor(arrays) if "sensor" in arrays else sensor
    }
    if known["sensor"] is None:
        raise ValueError(
            "it has no sensor: give one, --sensor NAME|FILE.yaml (sensor=...)"
        )
    for name, kinds in (("id", "U"), ("domain", "iu")):
        if name in arrays:
            if arrays[name].shape or arrays[name].dtype.kind not in kinds:
                raise ValueError(
                    f"{name} is {arrays[name].dtype} of shape {arrays[name].shape}"
                )
            known[name] = arrays[name].item()
    if known.get("domain", REAL) not in (REAL, SYNTHETIC):
        raise ValueError(
            f"domain is {known['domain']}, not {REAL} (real) or {SYNTHETIC} (synthetic)"
        )
    if "provenance" in arrays:
        known["provenance"] = check_provenance(
            parse_json(str(arrays["provenance"]), "its provenance")
        )
    if "pose" in arrays:
        known["pose"] = check_pose(arrays["pose"])
    if BOX + "values" in arrays:
        known["boxes"] = _make_boxes(arrays)
    return known


def _make_boxes(arrays: dict[str, NDArray[Any]]) -> Boxes:
    values = {f.name: arrays[BOX + f.name] for f in fields(Boxes)}
    names = values.pop("names")
    if names.ndim != 1 or (names.size and names.dtype.kind != "U"):
        raise ValueError(f"the boxes' names are {names.dtype} of shape {names.shape}")
    return Boxes(**values, names=tuple(names.tolist()))


def check_pose(values: Any) -> NDArray[np.float64]:
    """Check a pose, and return it as (4, 4) float64.

    Raises:
        ValueError: on another shape, or values that are not finite numbers.
    """
    pose = np.asarray(values)
    if (
        pose.shape != (4, 4)
        or pose.dtype.kind not in "iuf"
        or not np.isfinite(pose).all()
    ):
        raise ValueError(
            f"pose is {pose.dtype} of shape {pose.shape}, not (4, 4) finite numbers"
        )
    return pose.astype(np.float64, copy=False)
