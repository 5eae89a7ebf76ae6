"""Banks and plans of every option, and the package's own reading of them, for tests of
``integrations/reader.py``."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from banks import some_facts, some_image, write_bank
from lidar_synth.integrations.plan import write_plan

from lidar_synth.bake.edit import drop, merge
from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Bank, Entry, Index, ShardWriter
from lidar_synth.bank.boxes import encode_boxes
from lidar_synth.files.disk import sha256
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.labels import make_policy
from lidar_synth.mixing import MixedScans

ALL = ("reflectance", "label", "confidence")
BOXED = (*ALL, "instance", "boxes")
LASERS = Sensor(
    "lasers",
    48,
    0.9,
    120.0,
    elevations=(15.0, 7.5, 2.0, -1.0, -9.0, -24.5),
    heights=(0.1,) * 6,
)


def images(count: int = 5, sensor: Sensor | None = None) -> list[Any]:
    """Random range images."""
    return [some_image(seed, *([sensor] if sensor else [])) for seed in range(count)]


def at_limits() -> list[Any]:
    """A range image with returns at both limits of the sensor."""
    [image] = images(1)
    image.range[image.mask] = np.resize(
        [image.sensor.range_min, image.sensor.range_max], image.mask.sum()
    )
    return [image]


def conditional(root: Path) -> None:
    """A bank of a conditional model."""
    facts = some_facts(
        condition={"kind": "semantic", "source": "kitti360", "split": "r2flow/train"}
    )
    entry = Entry("shard-00000.h5", 5, 7, 2)
    root.mkdir()
    with ShardWriter(
        root / entry.file, facts, entry, conditions=["drive/0000000007", "drive/8"]
    ) as writer:
        for image in images(2):
            writer.append(image)
    path = root / entry.file
    write_bank_files(
        root,
        Index(
            (facts,), (replace(entry, bytes=path.stat().st_size, sha256=sha256(path)),)
        ),
    )


def curated(root: Path) -> None:
    """A bank of which scans are dropped at the beginning, in the middle and at the end of
    shards."""
    write_bank(root.with_name("original"), images(8), shard_size=3)
    drop(Bank(root.with_name("original")), [0, 4, 7], "by hand", root, progress=False)


def merged(root: Path) -> None:
    """A bank of two bakes."""
    parts = [root.with_name(name) for name in ("first", "second")]
    write_bank(parts[0], images(3))
    write_bank(parts[1], images(2), model="other", checkpoint="d" * 64, layout="paged")
    merge([Bank(part) for part in parts], root, progress=False)


BANKS: dict[str, Any] = {
    "range only": lambda root: write_bank(root, images(), fields=()),
    "reflectance": lambda root: write_bank(root, images(), fields=("reflectance",)),
    "labels": lambda root: write_bank(root, images(), fields=("label",)),
    "all fields": lambda root: write_bank(root, images(), fields=ALL),
    "boxes": lambda root: write_bank(root, images(9), fields=BOXED),
    "one shard": lambda root: write_bank(root, images(), shard_size=5, fields=ALL),
    "many shards": lambda root: write_bank(root, images(40), shard_size=2, fields=ALL),
    "paged": lambda root: write_bank(root, images(), fields=ALL, layout="paged"),
    "limits": lambda root: write_bank(root, at_limits(), fields=ALL),
    "lasers": lambda root: write_bank(root, images(2, LASERS), fields=ALL),
    "hdl64e": lambda root: write_bank(
        root, images(2, load_sensor("hdl64e_kitti")), fields=ALL
    ),
    "conditional": conditional,
    "curated": curated,
    "merged": merged,
}
"""Writers of banks by name."""

MIXTURES: dict[str, tuple[str, int, dict[str, Any]]] = {
    "generated": ("all fields", 11, {"ratio": 0.25, "seed": 3}),
    "threshold": (
        "all fields",
        11,
        {"ratio": 0.5, "labels": {"generated": {"threshold": 0.5}}},
    ),
    "condition": ("conditional", 5, {"ratio": [0.0, 0.3, 0.6], "labels": "condition"}),
    "without confidence": (
        "labels",
        7,
        {"ratio": 0.4, "reuse": 2, "epoch_size": "replace"},
    ),
    "no labels": ("reflectance", 7, {"ratio": 0.5, "labels": "none", "epoch_size": 20}),
    "curated": ("curated", 4, {"ratio": 0.6}),
    "boxes": ("boxes", 8, {"ratio": 0.5, "labels": "boxes", "unboxed": "keep"}),
}
"""Bank, number of real samples, and settings of mixtures by name."""

EPOCHS = 3


def expected_scans(root: Path) -> dict[str, Any]:
    """Arrays of every scan of a bank, as the package reads them."""
    bank = Bank(root)
    found = dict[str, Any]()
    for number in range(len(bank)):
        image = bank.image(number)
        scan = bank[number]
        found |= {
            f"{number} image {name}": v
            for name, v in {"range": image.range, **image.channels}.items()
        }
        found |= {
            f"{number} {name}": v
            for name, v in {"points": scan.points, **scan.fields()}.items()
        }
        found[f"{number} id"] = np.array(scan.id)
        if image.boxes is not None:
            found[f"{number} image boxes"] = encode_boxes(image.boxes)[
                : len(image.boxes)
            ]
        found |= {f"{number} {name}": v for name, v in boxes_of(scan).items()}
    return found


def boxes_of(scan: Scan) -> dict[str, Any]:
    """The arrays of a scan's boxes."""
    return (
        {}
        if scan.boxes is None
        else {"boxes": scan.boxes.values, "names": np.array(scan.boxes.names)}
    )


def expected_samples(root: Path, real: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Arrays of every sample of the first epochs, as ``MixedScans`` gives them."""
    options = {key: value for key, value in settings.items() if key != "labels"}
    bank = Bank(root)
    policy = make_policy(settings.get("labels", "generated"), fields=bank.fields)
    mixed = MixedScans.wrap(
        range(real),
        bank,
        to_sample=lambda scan, rng: scan,
        compare=False,
        labels=policy,
        **options,
    )
    found: dict[str, Any] = {}
    for epoch in range(EPOCHS):
        for position in range(len(mixed)):
            sample = mixed.sample(epoch, position)
            if isinstance(sample, int):
                found[f"{epoch} {position} real"] = np.array(sample)
                continue
            values = {
                "points": sample.points,
                **sample.fields(),
                **boxes_of(sample),
                "id": np.array(sample.id),
            }
            found |= {
                f"{epoch} {position} {name}": value for name, value in values.items()
            }
    return found


def write_cases(folder: Path) -> None:
    """Write every bank to ``banks/<name>`` and every plan to ``plans/<name>.npz``, each with its
    expected arrays."""
    for name, write in BANKS.items():
        root = folder / "banks" / name / "bank"
        root.parent.mkdir(parents=True)
        write(root)
        np.savez(root.with_name("expected.npz"), **expected_scans(root))
    for name, (bank, real, settings) in MIXTURES.items():
        root = folder / "banks" / bank / "bank"
        plan = folder / "plans" / name
        plan.mkdir(parents=True)
        (plan / "mix.yaml").write_text(
            yaml.safe_dump({"synthetic": str(root), **settings})
        )
        write_plan(
            {"synthetic": str(root), **settings},
            plan / "plan.npz",
            real=real,
            epochs=EPOCHS,
        )
        (plan / "bank.txt").write_text(f"{bank}\n{real}\n")
        np.savez(plan / "expected.npz", **expected_samples(root, real, settings))
