"""Runs of small latent models, which several tests start from."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from accelerate.state import AcceleratorState
from conftest import random_scan
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)


RECIPE = {"iterations": 8, "batch": 4, "warmup": 2, "rate": 1e-3, "ema_every": 1}


CODEC_NETWORK = {
    "architecture": "vqvae",
    "arguments": {
        "latent_channels": 4,
        "codes": 256,
        "width": 8,
        "multipliers": [1, 2],
        "strides": [[1, 2]],
        "blocks": 1,
        "attention": False,
        "patch": [2, 2],
        "groups": 4,
    },
}


UNET = {
    "architecture": "unet",
    "arguments": {
        "width": 16,
        "multipliers": [1, 2],
        "blocks": 1,
        "attention": [1],
        "head_channels": 8,
        "groups": 4,
    },
}


SEMANTIC = {
    "kind": "semantic",
    "arguments": {"channels": 3, "method": "patches"},
    "dropout": 0.2,
}


def write_config(scans: Path, folder: Path, name: str, **values: Any) -> Path:
    config = {
        "output": str(folder / name),
        "licence": "MIT",
        "data": {"licence": "none", "path": str(scans / "scans"), "flip": True}
        | values.pop("data", {}),
        "recipe": RECIPE | values.pop("recipe", {}),
        "save_every": 4,
        "samples": {"every": 0},
    }
    if "teacher" not in values and "codec" not in values:
        config |= {
            "sensor": str(scans / "sensor.yaml"),
            "channels": ["range", "reflectance", "label"],
        }
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(config | values))
    return path


def call(*arguments: str | Path) -> str:
    """The command line in this process; errors come out as they are."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    AcceleratorState._reset_state(True)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small labelled scans, and the sensor's file."""
    folder = tmp_path_factory.mktemp("scans")
    writer = WRITERS["npz"](folder / "scans")
    for i in range(5):
        writer.write(random_scan(SENSOR, 400, i), i)
    values = SENSOR.to_dict()
    (folder / "sensor.yaml").write_text(yaml.safe_dump({values.pop("name"): values}))
    return folder


@pytest.fixture(scope="module")
def codec(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("codec")
    losses = {"geometric": 1.0, "adversarial": 0.1, "discriminator_width": 4}
    config = write_config(
        scans,
        folder,
        "codec",
        network=CODEC_NETWORK,
        losses=losses,
        samples={"every": 8, "count": 2},
        recipe={"metric": "l1"},
    )
    call("train", config)
    assert (folder / "codec" / "samples" / "0000008.png").exists()
    return folder / "codec" / "codec.safetensors"


@pytest.fixture(scope="module")
def teacher(scans: Path, codec: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("teacher")
    values = {
        "network": UNET,
        "condition": SEMANTIC,
        "steps": 5,
        "samples": {"every": 8, "count": 2},
    }
    call("train", write_config(scans, folder, "teacher", codec=str(codec), **values))
    assert (folder / "teacher" / "samples" / "0000008.png").exists()
    return folder / "teacher" / "teacher.safetensors"
