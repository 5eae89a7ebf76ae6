"""A checkpoint with random weights, to measure what training does not change."""

from pathlib import Path

import torch

from lidar_synth.generate.checkpoint import (
    VELOCITY,
    Header,
    NetworkSpec,
    save_checkpoint,
)
from lidar_synth.generate.models import build_network
from lidar_synth.geometry import load_sensor
from lidar_synth.geometry.normalize import CHANNELS, NORMALISATIONS


def write_untrained(path: Path) -> Path:
    """Write a small, fast network of one step for 64 x 1024 scans with reflectance and labels;
    returns its path."""
    sensor = load_sensor("hdl64e_kitti360")
    arguments = {
        "resolution": sensor.shape,
        "channels": sum(CHANNELS.values()),
        "width": 16,
        "time_width": 16,
        "depths": (1, 1),
        "heads": (2, 2),
        "patch": (8, 8),
        "window": (3, 3),
    }
    torch.manual_seed(0)
    network = build_network(
        "hdit", arguments | {"angles": torch.from_numpy(sensor.ray_angles())}
    )
    for parameter in network.parameters():
        # the output of a fresh network is zero
        torch.nn.init.normal_(parameter, std=0.2)
    header = Header(
        networks={VELOCITY: NetworkSpec("hdit", arguments)},
        sensor=sensor,
        normalisation=NORMALISATIONS["r2flow"],
        channels=tuple(CHANNELS),
        time_grid=(1.0, 0.0),
        provenance={"data": "none", "data_licence": "none", "licence": "MIT"},
    )
    save_checkpoint(path, header, {VELOCITY: network})
    return path
