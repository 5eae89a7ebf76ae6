"""What is fuzzed beside scans and banks: files of weights, states of runs, and settings that people
write."""

import gzip
import io
import json
import tarfile
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch
import yaml
from conftest import random_scan
from layouts import some_scan
from releases import (
    UNCONDITIONAL,
    config_of,
    peer_weights,
    random_weights,
    release,
    write_r2flow,
)
from torch import Tensor, nn

from fuzzing.weights import in_order
from lidar_synth import ObjectBank, Town, load_layout, load_skin
from lidar_synth.files.parsing import seal
from lidar_synth.files.torch_files import load_pickle, state_of
from lidar_synth.generate.checkpoint import load_checkpoint, save_checkpoint
from lidar_synth.generate.flow.timesteps import TrajectoryCosts
from lidar_synth.geometry.layout import layout_image
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.extractors.archive import Archive, load_weights
from lidar_synth.lab.evaluate.extractors.bonnetal import PARTS, read_segmenter
from lidar_synth.lab.evaluate.extractors.squeezeseg import SqueezeSeg
from lidar_synth.lab.importers import IMPORTERS
from lidar_synth.lab.proof.study import read_outcome, to_values
from lidar_synth.lab.proof.trial import TrialOutcome
from lidar_synth.lab.town.skin import skin as skins
from lidar_synth.lab.train import (
    DistillConfig,
    TrainConfig,
    cache_latents,
    cache_scans,
    load_config,
)
from lidar_synth.lab.train.selection import load_costs, save_costs
from lidar_synth.lab.train.state import STATE, Recipe, Training, checksum_of

SMALL = Sensor("tiny", 32, 1.0, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)

CHANNELS = ("range", "reflectance", "label")

SCANS = [random_scan(SMALL, 100, seed) for seed in range(70)]
"""Of a cache with two blocks."""

SETTINGS = {"intervals": 2, "teacher": "abc"}
"""With which timesteps were selected."""


def make_archives(root: Path) -> None:
    """Weights in both formats of PyTorch, and a judge's archive as a tar and as a compressed
    one."""
    folder = root / "judge"
    folder.mkdir(parents=True)
    flat = torch.randn(15, generator=torch.Generator().manual_seed(0))
    state = {"weight": flat[:12].view(3, 4), "bias": flat[12:]}
    content = {
        "state_dict": state,
        "epoch": 3,
        "optimizer": {"state": {0: {"step": 1}}, "betas": (0.9, 0.99)},
    }
    torch.save(content, root / "new.pth")
    old = io.BytesIO()
    torch.save(content, old, _use_new_zipfile_serialization=False)
    address = str(
        flat.untyped_storage()._cdata
    ).encode()  # the old format's name of the storage
    (root / "old.pt").write_bytes(old.getvalue().replace(address, b"1" * len(address)))
    torch.save(state, folder / "weights")
    (folder / "arch_cfg.yaml").write_text(
        yaml.safe_dump({"backbone": {"name": "x", "OS": 32}})
    )
    with tarfile.open(root / "judge.tar", "w") as tar:
        for path in sorted(folder.iterdir()):
            tar.add(path, f"judge/{path.name}", filter=without_owner)
    # without the record of zeros
    content = (root / "judge.tar").read_bytes().rstrip(b"\0")
    content += bytes(-len(content) % 512 + 1024)
    (root / "judge.tar").write_bytes(content)
    packed = gzip.compress(content, mtime=0)
    (root / "judge.tgz").write_bytes(packed)


def without_owner(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """The same member at any time and for any user."""
    member.mtime = member.uid = member.gid = 0
    member.uname = member.gname = ""
    return member


def read_archives(root: Path) -> list[Any]:
    """A small network with the weights of each file, and the settings of the tars."""
    found: list[Any] = []
    states: dict[Path, Any] = {}
    for path in (root / "new.pth", root / "old.pt"):
        states[path] = state_of(load_pickle(path, "a peer"), "state_dict", path)
    for path in (root / "judge.tar", root / "judge.tgz"):
        archive = Archive(path, "a peer")
        found.append(archive.yaml("arch_cfg.yaml"))
        states[path] = archive.weights("weights")
    for path, state in states.items():
        network = nn.Linear(4, 3)
        load_weights(network, state, str(path))
        found.append(network)
    return found


def make_judges(root: Path) -> None:
    """A folder with SqueezeSeg as lidar-bonnetal publishes it."""
    root.mkdir()
    torch.manual_seed(0)
    network = SqueezeSeg(5, 20)
    for part in PARTS:
        torch.save(network.get_submodule(part).state_dict(), root / part)
    sensor = {
        "name": "HDL64",
        "fov_up": 3,
        "fov_down": -25,
        "img_prop": {"width": 64, "height": 16},
        "img_means": [12.12, 10.88, 0.23, -1.04, 0.21],
        "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
    }
    inputs = {"range": True, "xyz": True, "remission": True}
    settings = {
        "backbone": {
            "name": "squeezeseg",
            "input_depth": inputs,
            "OS": 16,
            "extra": {"layers": 21},
        },
        "decoder": {"name": "squeezeseg"},
        "head": {"name": "segmentation"},
        "dataset": {"sensor": sensor},
    }
    (root / "arch_cfg.yaml").write_text(yaml.safe_dump(settings))


def read_judges(root: Path) -> list[Any]:
    """Its grid and its features of an image."""
    judge = read_segmenter(Archive(root, "lidar-bonnetal"))
    image = np.ones((5, 16, 64), np.float32)
    with torch.no_grad():
        return [judge.sensor, judge.decode(judge.normalise(image))]


def make_importers(root: Path) -> None:
    """A release of R2Flow and one of LiDM."""
    lidm = root / "lidm"
    lidm.mkdir(parents=True)
    write_r2flow(root / "r2flow.pth", peer_weights())
    release(lidm, config_of(UNCONDITIONAL), random_weights(UNCONDITIONAL, lidm))


def read_importers(root: Path) -> list[Any]:
    """The checkpoints that ``lidar-synth import`` writes."""
    found: list[Any] = []
    for peer, path in (
        ("r2flow", root / "r2flow.pth"),
        ("lidm", root / "lidm" / "model.ckpt"),
    ):
        header, networks = IMPORTERS[peer](path)
        out = root / f"{peer}.safetensors"
        save_checkpoint(out, header, networks)
        found.append(load_checkpoint(out))
        out.unlink()
    return found


class Identity(nn.Module):
    """A codec whose latents are the images."""

    shape = (7, 8, 32)

    def encode(self, x: Tensor) -> Tensor:
        return x


def some_training() -> Training:
    """A run after one step."""
    torch.manual_seed(0)
    made = Training(nn.Linear(4, 3), Recipe(iterations=5))
    take_step(made)
    return made


def take_step(training: Training) -> None:
    training.network(torch.ones(1, 4)).sum().backward()
    for optimizer in training.optimizers:
        optimizer.step()
    training.step += 1


def make_states(root: Path) -> None:
    """What runs keep to resume: a training's state, a cache with latents, an outcome of a study,
    timesteps."""
    run = some_training()
    # the same bytes on a busy machine
    with mock.patch.object(type(run), "seconds", 1.0):
        run.save(root / STATE)
    (root / STATE).write_bytes(in_order((root / STATE).read_bytes()))
    cached(root)
    outcome = TrialOutcome(
        np.arange(361).reshape(19, 19), [(1, np.eye(19, dtype=np.int64))], [0.5], 2.0
    )
    (root / "outcome.json").write_bytes(seal(to_values(outcome)))
    costs = np.triu(np.ones((5, 5)), 1)
    costs = np.where(costs > 0, costs, np.inf)
    chosen = TrajectoryCosts(2 * costs, np.array([[0, 2, 4], [0, 1, 4]]))
    save_costs(root / "selection.npz", chosen, SETTINGS)


def cached(root: Path) -> list[Any]:
    """A cache of scans and its latents, made where they are missing or damaged."""
    kept = cache_scans(SCANS, SMALL, CHANNELS, root / "cache", progress=False)
    codec: Any = Identity()
    tensors = TensorFormat(CHANNELS, NORMALISATIONS["r2flow"])
    latents = cache_latents(
        kept, tensors, codec, "cpu", root / "cache", "abc", progress=False
    )
    return [*kept.read(range(len(kept))).values(), latents]


def read_states(root: Path) -> list[Any]:
    """All of it, and the weights after one more step of the resumed run."""
    training = some_training()
    training.load(root / STATE)
    take_step(training)
    outcome = read_outcome(root / "outcome.json")
    chosen = load_costs(root / "selection.npz", SETTINGS)
    return [
        training.network,
        training.average,
        training.step,
        asdict(outcome),
        asdict(chosen.selection)["grid"],
        chosen.optima,
        *cached(root),
    ]


def mend_states(root: Path) -> None:
    """The checksums of the files as they are."""
    for path in (
        root / "outcome.json",
        root / "cache" / "cache.json",
        root / "cache" / "latents-abc" / "cache.json",
    ):
        values = json.loads(path.read_text())
        values.pop("checksum", None)
        path.write_bytes(seal(values))
    mend_metadata(root / STATE)


def mend_metadata(path: Path) -> None:
    """The checksum of a state as its tensors are."""
    tensors = safetensors.torch.load_file(path)
    with safetensors.safe_open(path, "pt") as file:
        facts = dict(file.metadata())
    facts.pop("checksum", None)
    whole = safetensors.torch.save(
        tensors, facts | {"checksum": checksum_of(facts, tensors)}
    )
    path.write_bytes(in_order(whole))


@cache
def some_objects() -> ObjectBank:
    """The objects of a scan of the town."""
    return ObjectBank.from_scans(Town(seed=0, scans=1))


def make_objects(root: Path) -> None:
    """A bank of objects."""
    root.mkdir()
    some_objects().save(root / "objects.npz")


def read_objects(root: Path) -> list[Any]:
    """Every object at its place."""
    bank = ObjectBank.load(root / "objects.npz")
    return [bank[i].scan for i in range(min(len(bank), 50))]


def make_layouts(root: Path) -> None:
    """A scene with every key."""
    root.mkdir()
    scene = {
        "ground": -1.73,
        "reach": 15,
        "objects": [
            {"class": "Van", "at": [12, 0]},
            {
                "class": "Cyclist",
                "at": [16.5, 4.4],
                "heading": 180,
                "size": [1.8, 0.6, 1.7],
                "above": 0.1,
            },
        ],
        "outlines": [
            {"kind": "building", "line": [[-10, 9], [40, 9]], "height": 8},
            {"kind": "vegetation", "line": [[5, -7], [12, -7]], "from": 2, "height": 6},
        ],
    }
    (root / "scene.yaml").write_text("# a comment\n" + yaml.safe_dump(scene))


def read_layouts(root: Path) -> list[Any]:
    """The boxes of the scene, and its image."""
    layout = load_layout(root / "scene.yaml")
    return [layout.boxes, layout_image(layout, SMALL)]


def make_recipes(root: Path) -> None:
    """A teacher on a base, with a sensor beside it, and a student."""
    root.mkdir()
    base = {
        "licence": "MIT",
        "data": {"licence": "MIT", "town": 4, "flip": True},
        "channels": list(CHANNELS),
    }
    network = {
        "width": 32,
        "time_width": 32,
        "depths": [1, 1],
        "heads": [2, 4],
        "patch": [2, 4],
        "window": [3, 5],
    }
    teacher = {
        "base": "shared",
        "sensor": "own.yaml",
        "network": {"arguments": network},
        "recipe": {
            "iterations": 20,
            "batch": 8,
            "rate": 0.002,
            "schedule": "trapezoid",
            "weights": {"label": 0.5},
        },
        "condition": {
            "kind": "semantic",
            "arguments": {"channels": 3, "method": "patches"},
            "dropout": 0.2,
        },
        "steps": 16,
        "samples": {"every": 10, "count": 4},
    }
    student = {
        "licence": "MIT",
        "data": {"licence": "MIT", "town": 4},
        "teacher": "teacher.safetensors",
        "strategy": "adaptive_piecewise",
        "steps": 8,
        "intervals": 2,
        "grid": [1, 0.5, 0],
        "recipe": {"iterations": 5},
        "selection": {"candidates": 4},
    }
    values = SMALL.to_dict()
    files = {
        "base/shared": base,
        "teacher": teacher,
        "student": student,
        "own": {values.pop("name"): values},
    }
    for name, content in files.items():
        path = root / f"{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text("# a comment\n" + yaml.safe_dump(content))


def read_recipes(root: Path) -> list[Any]:
    """The checked configurations, as plain values."""
    teacher = load_config(TrainConfig, root / "teacher.yaml")
    student = load_config(DistillConfig, root / "student.yaml")
    return [
        config.model_dump_json().replace(str(root), "") for config in (teacher, student)
    ]


def make_skins(root: Path) -> None:
    """The skin that comes with the package."""
    root.mkdir()
    load_skin("pandar64").save(root / "own.skin")


def read_skins(root: Path) -> list[Any]:
    """The returns of a scan with the skin."""
    skin = load_skin(root / "own.skin")
    skin.summary()
    scan = some_scan()
    ring = np.sort(np.arange(len(scan)) % skin.sensor.shape[0])
    boxed = np.zeros(len(scan), np.bool_)
    return [
        skin.sensor,
        skin.apply(
            scan.points, scan.reflectance, ring, boxed, np.random.default_rng(0)
        ),
    ]


def mend_skin(root: Path) -> None:
    """The checksum of the skin as it is."""
    path = root / "own.skin"
    content = path.read_bytes()
    start = int.from_bytes(content[:8], "little") + 8
    header = json.loads(json.loads(content[8:start])["__metadata__"]["lidar_synth"])
    arrays = safetensors.numpy.load(content)
    header.pop("checksum", None)
    header["checksum"] = skins._checksum(header, arrays)
    path.write_bytes(
        safetensors.numpy.save(
            arrays, {"lidar_synth": json.dumps(header, sort_keys=True)}
        )
    )
