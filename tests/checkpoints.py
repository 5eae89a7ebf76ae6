"""Small checkpoints, and ways to change their header and weights."""

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import nn

from lidar_synth.generate.checkpoint import (
    VELOCITY,
    Header,
    NetworkSpec,
    weights_hash,
)
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import NORMALISATIONS
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor(
    "small",
    columns=32,
    range_min=1.0,
    range_max=80.0,
    rows=8,
    fov_up=3.0,
    fov_down=-25.0,
)


ARGUMENTS: dict[str, Any] = {
    "resolution": [8, 32],
    "channels": 7,
    "width": 16,
    "time_width": 8,
    "depths": [1, 1],
    "heads": [2, 2],
}


HEADER = Header(
    networks={VELOCITY: NetworkSpec("hdit", ARGUMENTS)},
    sensor=SENSOR,
    normalisation=NORMALISATIONS["r2flow"],
    channels=("range", "reflectance", "label"),
    time_grid=(1.0, 0.86, 0.58, 0.22, 0.0),
    provenance={
        "data": "town",
        "data_licence": "MIT",
        "licence": "MIT",
        "metrics": {"jsd": 0.1},
    },
    conditioning={"semantic": {"classes": 19}},
)


def network(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    net = build_network(
        "hdit", ARGUMENTS | {"angles": torch.from_numpy(SENSOR.ray_angles())}
    )
    for parameter in net.parameters():
        nn.init.normal_(parameter)
    return net


def checksummed(values: dict[str, Any]) -> str:
    """The text of a header with its checksum."""
    values = {k: v for k, v in values.items() if k != "checksum"}
    checksum = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    return json.dumps({**values, "checksum": checksum})


def rewrite(path: Path, **changes: Any) -> None:
    """Change keys of the header (None = remove) and update its checksum; the weights stay
    unchanged."""
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    outer = json.loads(content[8 : 8 + size])
    header = json.loads(outer["__metadata__"]["lidar_synth"]) | changes
    outer["__metadata__"]["lidar_synth"] = checksummed(
        {k: v for k, v in header.items() if v is not None}
    )
    text = json.dumps(outer).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + size :])


def replace_weights(path: Path, change: Any) -> None:
    """Replace the weights and their checksum, but not the rest of the header, as a careless tool
    would."""
    tensors = load_file(path)
    change(tensors)
    save_file(
        tensors,
        path,
        {
            "lidar_synth": checksummed(
                {**HEADER.to_dict(), "weights": weights_hash(tensors)}
            )
        },
    )
