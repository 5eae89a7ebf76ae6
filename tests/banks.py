"""Small banks for tests, written without a bake."""

import json
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import INDEX, Bank, Entry, Facts, Index, ShardWriter
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.files.disk import sha256
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Boxes, RangeImage
from lidar_synth.geometry.sensor import Sensor, load_sensor

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)


def some_facts(sensor: Sensor = SENSOR, **others: Any) -> Facts:
    """Facts of a bank without a model."""
    known = {
        "sensor": sensor,
        "fields": ("reflectance", "label"),
        "model": "small",
        "checkpoint": "c" * 64,
        "settings": {"seed": 5},
        "label_policy": "generated",
        "licence": "MIT",
        "data_licence": "none",
    }
    return Facts(**known | others)  # type: ignore[arg-type]


def some_image(seed: int = 0, sensor: Sensor = SENSOR) -> RangeImage:
    """A random range image with every field of a bank; a third of its cells are empty."""
    rng = np.random.default_rng(seed)
    seen = rng.random(sensor.shape) < 0.67
    metres = rng.uniform(sensor.range_min, sensor.range_max, sensor.shape)
    channels = {
        "reflectance": (rng.random(sensor.shape) * seen).astype(np.float32),
        "label": np.where(seen, rng.integers(0, 19, sensor.shape), IGNORE).astype(
            np.uint8
        ),
        "confidence": (rng.random(sensor.shape) * seen).astype(np.float32),
    }
    values = rng.uniform(
        (-40, -40, -2, 0.5, 0.5, 0.5, -3), (40, 40, 1, 9, 3, 3, 3), (seed % 4, 7)
    ).astype(np.float32)
    names = tuple(
        rng.choice(["Car", "Pedestrian", "Misc", "Motorcyclist"], len(values)).tolist()
    )
    boxes = Boxes(values, names, instance=np.arange(1, len(values) + 1, dtype=np.int32))
    channels["instance"] = (
        rng.integers(0, len(values) + 1, sensor.shape) * seen
    ).astype(np.int32)
    return RangeImage((metres * seen).astype(np.float32), sensor, channels, boxes)


def write_bank(
    root: Path, images: Sequence[RangeImage], shard_size: int = 2, **others: Any
) -> list[Path]:
    """Write a bank with these images; returns the files of its shards."""
    facts = some_facts(images[0].sensor, **others)
    root.mkdir(parents=True, exist_ok=True)
    entries = []
    for first in range(0, len(images), shard_size):
        part = images[first : first + shard_size]
        entry = Entry(f"shard-{len(entries):05d}.h5", 5, first, len(part))
        with ShardWriter(root / entry.file, facts, entry) as writer:
            for image in part:
                writer.append(image)
        path = root / entry.file
        entries.append(replace(entry, bytes=path.stat().st_size, sha256=sha256(path)))
    write_bank_files(root, Index((facts,), tuple(entries)))
    return [root / entry.file for entry in entries]


def add_stray(path: Path) -> None:
    """Add the stray entry that numpy before 2.2 writes for ``savez(file, allow_pickle=False)``."""
    content = BytesIO()
    np.save(content, np.array(False))
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("allow_pickle.npy", content.getvalue())


def write_golden_bank(root: Path) -> None:
    """Write the bank in tests/golden, and numbers.json with the expected statistics of its
    scans."""
    from lidar_synth.lab.town import Town

    sensor = load_sensor(Path(__file__).parents[1] / "configs" / "tiny_sensor.yaml")
    images = [project(scan) for scan in Town(0, sensor, 3)]
    for image in images:
        image.channels["confidence"] = (
            image.channels["reflectance"] * image.mask
        ).astype(np.float32)
    write_bank(root, images, fields=("reflectance", "label", "confidence"))
    bank = Bank(root)
    scans = [numbers(bank, i) for i in range(len(bank))]
    (root / "numbers.json").write_text(
        json.dumps({"identity": bank.identity, "scans": scans}, indent=1) + "\n"
    )


def numbers(bank: Bank, number: int) -> dict[str, Any]:
    """Statistics of a scan of a bank."""
    image = bank.image(number)
    assert image.label is not None and image.reflectance is not None
    return {
        "id": bank.ids[number],
        "returns": len(bank[number].points),
        "range": round(float(image.range.sum(dtype=np.float64)), 3),
        "reflectance": round(float(image.reflectance.sum(dtype=np.float64)), 3),
        "confidence": round(
            float(image.channels["confidence"].sum(dtype=np.float64)), 3
        ),
        "labels": np.bincount(image.label.reshape(-1), minlength=256)[
            [*range(19), IGNORE]
        ].tolist(),
    }


def edit_index(root: Path, **changes: Any) -> None:
    """Change values of a bank's index and write it with a matching checksum."""
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    (root / INDEX).write_bytes(replace(index, **changes).to_json())


def spoiled(name: str, value: float) -> RangeImage:
    """A range image with one changed value in a channel."""
    image = some_image()
    (image.range if name == "range" else image.channels[name])[3, 4] = value
    return image
