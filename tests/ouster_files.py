"""Metadata of an invented Ouster sensor, in the two forms that the SDK and its firmware have
written."""

from typing import Any

LIFT = 36.18
"""Millimetres of the lasers above the base."""


def ouster_metadata(
    flat: bool = False, rows: int = 8, profile: str = "RNG19_RFL8_SIG16_NIR16"
) -> dict[str, Any]:
    """The keys that describe the beams, and a few others.

    Args:
        flat: whether all keys are in one object, as in firmware before 3 and in the SDK's legacy
            form.
        rows: number of beams, in a staggered pattern of four azimuths.
        profile: of the UDP packets.
    """
    beams = {
        "beam_altitude_angles": [
            round(21.4 - 42.8 * i / (rows - 1) + 0.01 * (i % 3), 3) for i in range(rows)
        ],
        "beam_azimuth_angles": [(4.23, 1.41, -1.41, -4.22)[i % 4] for i in range(rows)],
        "lidar_origin_to_beam_origin_mm": 15.806,
    }
    transform = {
        "lidar_to_sensor_transform": [
            -1,
            0,
            0,
            0,
            0,
            -1,
            0,
            0,
            0,
            0,
            1,
            LIFT,
            0,
            0,
            0,
            1,
        ]
    }
    config = {"lidar_mode": "1024x10", "udp_port_lidar": 7502}
    data_format = {
        "pixels_per_column": rows,
        "columns_per_frame": 1024,
        "columns_per_packet": 16,
        "udp_profile_lidar": profile,
    }
    info = {"prod_line": "OS-1-8", "prod_sn": "1"}
    if flat:
        return beams | transform | config | info | {"data_format": data_format}
    return {
        "beam_intrinsics": beams,
        "lidar_intrinsics": transform,
        "config_params": config,
        "lidar_data_format": data_format,
        "sensor_info": info,
    }
