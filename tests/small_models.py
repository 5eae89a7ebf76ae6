"""Small pixel models with random weights, for several tests."""

from dataclasses import replace
from pathlib import Path

import torch

from lidar_synth.generate.checkpoint import (
    ENCODER,
    VELOCITY,
    Header,
    NetworkSpec,
    save_checkpoint,
)
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import CHANNELS, NORMALISATIONS
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)


GRID = (1.0, 0.8, 0.5, 0.0)


def write(
    path: Path,
    channels: tuple[str, ...] = tuple(CHANNELS),
    dropout: float | None = None,
    condition: str = "semantic",
) -> Path:
    """Write a checkpoint with random weights; with a ``dropout``, it is conditioned on semantic
    maps or layouts."""
    condition_channels = 0 if dropout is None else 3
    arguments = {
        "resolution": SENSOR.shape,
        "channels": sum(CHANNELS[c] for c in channels),
        "width": 16,
        "time_width": 16,
        "depths": (1, 1),
        "heads": (2, 2),
        "patch": (2, 2),
        "window": (3, 3),
        "condition_channels": condition_channels,
    }
    torch.manual_seed(0)
    network = build_network(
        "hdit", arguments | {"angles": torch.from_numpy(SENSOR.ray_angles())}
    )
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)  # a fresh network returns zero
    header = Header(
        networks={VELOCITY: NetworkSpec("hdit", arguments)},
        sensor=SENSOR,
        normalisation=NORMALISATIONS["r2flow"],
        channels=channels,
        time_grid=GRID,
        provenance={"data": "none", "data_licence": "none", "licence": "MIT"},
    )
    networks = {VELOCITY: network}
    if dropout is not None:
        kind = {"semantic": "semantic_map", "layout": "layout"}[condition]
        encoder = NetworkSpec(
            kind, {"resolution": SENSOR.shape, "target": SENSOR.shape, "channels": 3}
        )
        networks[ENCODER] = build_network(*encoder)
        if condition == "semantic":
            torch.nn.init.normal_(networks[ENCODER].mix.weight, std=2.0)
        conditioning = {condition: {"dropout": dropout}}
        header = replace(
            header,
            networks=header.networks | {ENCODER: encoder},
            conditioning=conditioning,
        )
    save_checkpoint(path, header, networks)
    return path
