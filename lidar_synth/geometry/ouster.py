"""Ouster's sensors from the metadata JSON that their SDK and ROS driver write beside a recording.

The file (https://static.ouster.dev/sensor-docs/, "sensor metadata") has the calibrated beams of one
sensor. Firmware before 3 and the SDK's "legacy" form have all keys in one object; the newer form
groups them::

    beam_intrinsics.beam_altitude_angles        degrees, one per row of the image, highest first
    beam_intrinsics.beam_azimuth_angles         degrees, clockwise seen from above, away from the
                                                direction of the firing
    lidar_intrinsics.lidar_to_sensor_transform  4 x 4, millimetres, row by row: the lasers above the
                                                sensor's base
    lidar_data_format.columns_per_frame         firings of a turn ("data_format" in the legacy form)
    lidar_data_format.udp_profile_lidar         resolution of range and reflectance
    config_params.lidar_mode                    1024x10: firings of a turn, turns a second
    sensor_info.prod_line                       OS-1-128

The turn is complete in ``Sensor``, whatever window of azimuths the recording was limited to.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.errors import parsing
from lidar_synth.files.disk import read_text
from lidar_synth.files.parsing import parse_json

EXPECTED = (
    "the metadata JSON of an Ouster sensor, with beam_altitude_angles and lidar_mode"
)

LONGEST = 1 << 20
"""Maximum size of a metadata file in bytes; the SDK's have 10 to 40 thousand."""

RANGES = {
    "OS-0": (0.5, 100.0),
    "OS-1": (0.5, 200.0),
    "OS-2": (1.0, 400.0),
    "OS-DOME": (0.5, 45.0),
}
"""{start of the product line: minimum and maximum range in metres}, which the metadata does not
have."""

RANGE_STEPS = {"RNG19": 0.001, "RNG15": 0.008}
"""{part of the UDP profile: step of ranges in metres} (low data rate profiles count in 8 mm)."""


def read_metadata(path: Path) -> dict[str, Any]:
    """The arguments of ``Sensor`` for the sensor of a metadata file.

    Rows whose altitude and azimuth are both 0 are channels that the sensor does not have, and are
    left out. Rows are sorted by their altitude, highest first.

    Raises:
        FileError: if the file cannot be read.
        DataError: if it is not metadata of an Ouster sensor.
    """
    content = parse_json(read_text(path, EXPECTED, LONGEST), str(path), EXPECTED)
    with parsing(path, EXPECTED):
        return _arguments(content, path.stem)


def _arguments(content: dict[str, Any], name: str) -> dict[str, Any]:
    groups = {key: value for key, value in content.items() if isinstance(value, dict)}
    beams = groups.get("beam_intrinsics", content)
    data_format = groups.get("lidar_data_format") or groups.get("data_format") or {}
    mode = groups.get("config_params", content).get("lidar_mode", "")
    product = groups.get("sensor_info", content).get("prod_line") or "Ouster"
    lasers = np.array(
        [beams["beam_altitude_angles"], beams["beam_azimuth_angles"]], np.float64
    )
    if lasers.ndim != 2:
        raise ValueError(
            "beam_altitude_angles and beam_azimuth_angles are not two lists of numbers"
        )
    lasers = lasers[:, (lasers != 0).any(axis=0)]
    lasers = lasers[:, np.argsort(-lasers[0], kind="stable")]
    columns = data_format.get("columns_per_frame")
    if not columns:
        by_mode = re.fullmatch(r"(\d{1,5})x\d{1,3}", mode)
        if by_mode is None:
            raise ValueError(f"lidar_mode is {mode!r}, not such as '1024x10'")
        columns = int(by_mode[1])
    profile = data_format.get("udp_profile_lidar") or ""
    range_min, range_max = next(
        (r for start, r in RANGES.items() if product.startswith(start)), (0.5, 400.0)
    )
    transform = groups.get("lidar_intrinsics", content).get("lidar_to_sensor_transform")
    height = 0.0 if transform is None else float(transform[11]) / 1000
    values: dict[str, Any] = {
        "name": name,
        "description": f"{product}, {mode or columns}, from {name}.json",
        "elevations": lasers[0].tolist(),
        "azimuths": lasers[1].tolist(),
        "columns": columns,
        "range_min": range_min,
        "range_max": range_max,
        "range_step": next(
            (step for part, step in RANGE_STEPS.items() if part in profile), 0.001
        ),
    }
    if height:
        values["heights"] = [height] * lasers.shape[1]
    if "RFL8" in profile:
        values["reflectance_levels"] = 256
    return values
