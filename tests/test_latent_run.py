"""The latent path from configurations: autoencoder, conditioned teacher, student, scans; by the commands of pixels."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from accelerate.state import AcceleratorState
from conftest import random_scan
from PIL import Image
from torch import nn
from typer.testing import CliRunner

from lidar_synth.bake.conditions import conditions_for
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    join,
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.generate.generator import load_generator
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.train.config import DistillConfig, load_config
from lidar_synth.train.plan import make_plan, open_data
from lidar_synth.train.teaching import taught_flow

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
RECIPE = {"iterations": 8, "batch": 4, "warmup": 2, "rate": 1e-3, "ema_every": 1}
CODEC_NETWORK = {
    "architecture": "vqvae",
    "arguments": {
        "latent_channels": 4, "codes": 16, "codebook": "ema", "width": 8, "multipliers": [1, 2], "strides": [[1, 2]],
        "blocks": 1, "attention": False, "patch": [2, 2], "groups": 4,
    },
}  # fmt: skip
UNET = {
    "architecture": "unet",
    "arguments": {
        "width": 16, "multipliers": [1, 2], "blocks": 1, "attention": [1], "head_channels": 8, "groups": 4,
    },
}  # fmt: skip
TRANSFORMER = {"architecture": "hdit", "arguments": {
    "width": 16, "time_width": 16, "depths": [1, 1], "heads": [2, 2], "patch": [1, 1], "window": [3, 3],
}}  # fmt: skip
CAMERA = {
    "kind": "camera", "dropout": 0.1, "view_dropout": 0.5, "image": [40, 80],
    "arguments": {"resolution": [16, 32], "views": 2, "channels": 8, "widths": [4, 8]},
}  # fmt: skip
SIGHT = CAMERA | {"encoder": "sight", "view_dropout": 0.0, "arguments": {
    "resolution": [16, 32], "channels": 5, "widths": [4, 8],
    "image_from_sensor": [[40.0, -30.0, 0.0, 0.0], [20.0, 0.0, -30.0, 0.0], [1.0, 0.0, 0.0, 0.0]],
}}  # fmt: skip
STILL = ("stem", "encode", "merge", "to_latent", "shift", "scale")
"""Parts of names in an autoencoder that belong to its encoder, or to both sides."""
SEMANTIC = {"kind": "semantic", "arguments": {"channels": 3, "method": "patches"}, "dropout": 0.2}


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


def write_config(scans: Path, folder: Path, name: str, **values: Any) -> Path:
    config = {
        "output": str(folder / name),
        "licence": "MIT",
        "data": {"licence": "none", "path": str(scans / "scans"), "flip": True} | values.pop("data", {}),
        "recipe": RECIPE | values.pop("recipe", {}),
        "save_every": 4,
        "samples": {"every": 0},
    }
    if "teacher" not in values and "codec" not in values:
        config |= {"sensor": str(scans / "sensor.yaml"), "channels": ["range", "reflectance", "label"]}
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
    values = {"network": UNET, "condition": SEMANTIC, "steps": 5, "samples": {"every": 8, "count": 2}}
    call("train", write_config(scans, folder, "teacher", codec=str(codec), **values))
    assert (folder / "teacher" / "samples" / "0000008.png").exists()
    return folder / "teacher" / "teacher.safetensors"


def test_an_autoencoder_is_a_checkpoint_without_a_flow(codec: Path) -> None:
    header, networks, _ = load_checkpoint(codec)
    assert set(networks) == {CODEC}
    assert header.channels == ("range", "reflectance", "label")
    assert float(networks[CODEC].scale.mean()) != 1  # type: ignore[arg-type, union-attr]  # the latents' statistics
    with pytest.raises(DataError, match="is an autoencoder; expected a model that generates"):
        load_generator(codec)


def test_a_latent_model_of_label_maps_generates(codec: Path, teacher: Path) -> None:
    header, networks, _ = load_checkpoint(teacher)
    assert set(networks) == {VELOCITY, CODEC, ENCODER}
    assert header.networks[VELOCITY].arguments["channels"] == 4
    assert header.networks[VELOCITY].arguments["resolution"] == [4, 8]
    assert header.networks[VELOCITY].arguments["condition_channels"] == 3
    assert header.conditioning == {"semantic": {"dropout": 0.2}}
    assert header.provenance["codec"] == load_checkpoint(codec).hash
    for a, b in zip(networks[CODEC].parameters(), load_checkpoint(codec).networks[CODEC].parameters(), strict=True):
        assert torch.equal(a, b)  # it is frozen
    generator = load_generator(teacher)
    real = random_scan(SENSOR, 400, 9)
    [scan] = generator.scans(3, [1], real)
    [guided] = generator.scans(3, [1], real, guidance=2.0)
    assert (scan.id, scan.sensor) == ("teacher/3/1", SENSOR)
    assert scan.label is not None and scan.confidence is not None  # of its own: the tensor carries labels
    assert len(scan) > 0 and not np.array_equal(scan.points, guided.points)
    together = torch.cat(list(replace(generator, batch=2).samples(3, [5, 1], real)))
    [alone] = generator.samples(3, [1], real)
    assert torch.allclose(together[1], alone[0], atol=1e-4)


@pytest.mark.parametrize("guidance", [1.0, 2.0])
def test_it_is_distilled_on_timesteps_selected_with_its_conditions(
    guidance: float, scans: Path, teacher: Path, tmp_path: Path
) -> None:
    selection = {"candidates": 8, "trajectories": 3}
    config = write_config(
        scans, tmp_path, "student", teacher=str(teacher), steps=2, selection=selection, guidance=guidance
    )
    call("distill", config)
    header, _ = read_header(tmp_path / "student" / "student.safetensors")
    with np.load(tmp_path / "student" / "selection.npz") as found:
        assert header.time_grid == tuple(found["grid"]) and len(header.time_grid) == 5
    [scan] = load_generator(tmp_path / "student" / "student.safetensors").scans(0, [0], random_scan(SENSOR, 400, 1))
    assert len(scan) > 0
    call("distill", config, "--resume", "recipe.iterations=10")
    assert read_header(tmp_path / "student" / "student.safetensors")[0].provenance["iterations"] == 10


def test_a_student_learns_what_leads_away_from_a_weaker_teacher(
    scans: Path, codec: Path, teacher: Path, tmp_path: Path
) -> None:
    small = UNET | {"arguments": UNET["arguments"] | {"width": 8}}  # type: ignore[dict-item]
    call("train", write_config(scans, tmp_path, "weak", codec=str(codec), network=small, condition=SEMANTIC))
    weaker = tmp_path / "weak" / "weak.safetensors"
    values = {"teacher": str(teacher), "weaker": str(weaker), "strategy": "uniform_piecewise", "steps": 2}
    config = write_config(scans, tmp_path, "student", **values, guidance=2.5, within=[0.1, 0.5])
    call("distill", config)
    header, _ = read_header(tmp_path / "student" / "student.safetensors")
    assert header.provenance["weaker"] == load_checkpoint(weaker).hash
    assert str(tmp_path) not in json.dumps(header.provenance)

    strong, weak = load_checkpoint(teacher), load_checkpoint(weaker)
    flow, _ = taught_flow(load_config(DistillConfig, config), strong, torch.device("cpu"))
    y, t = torch.randn(2, 4, 4, 8), torch.tensor([0.3, 0.8])
    maps = torch.randint(0, 19, (2, *SENSOR.shape), dtype=torch.uint8)
    a, b = (join(checkpoint.networks)(y, t, maps) for checkpoint in (strong, weak))
    assert not torch.allclose(a, b, atol=1e-3)
    assert torch.allclose(flow(y, t, maps)[0], (b + 2.5 * (a - b))[0], atol=1e-5)
    assert torch.allclose(flow(y, t, maps)[1], a[1], atol=1e-5)  # t = 0.8

    for changes, message in (
        (["guidance=1"], "weak.safetensors with guidance 1; expected a scale"),
        (["within=[0.9,0.1]"], r"within \(0.9, 0.1\); expected a lesser and a greater time"),
        ([f"weaker={codec}"], "codec.safetensors, an autoencoder; expected a model that generates"),
        ([f"teacher={without_condition(teacher, tmp_path)}"], "of another conditioning; expected those of"),
        ([f"weaker={with_other_codec(weaker, tmp_path)}"], "of another autoencoder; expected those of"),
    ):
        with pytest.raises(ConfigError, match=message):
            call("distill", config, f"output={tmp_path / 'other'}", *changes)


def without_condition(path: Path, folder: Path) -> Path:
    """A model whose header says nothing of the condition that it takes."""
    header, networks, _ = load_checkpoint(path)
    save_checkpoint(out := folder / "alone.safetensors", replace(header, conditioning={}), networks)
    return out


def with_other_codec(path: Path, folder: Path) -> Path:
    """A model of other latents."""
    header, networks, _ = load_checkpoint(path)
    with torch.no_grad():
        networks[CODEC].scale.mul_(1.5)  # type: ignore[union-attr, operator]
    save_checkpoint(out := folder / "apart.safetensors", header, networks)
    return out


def test_guidance_of_an_unconditional_teacher_asks_for_a_weaker_one(scans: Path, codec: Path, tmp_path: Path) -> None:
    call("train", write_config(scans, tmp_path, "plain", codec=str(codec), network=UNET))
    plain = tmp_path / "plain" / "plain.safetensors"
    config = write_config(scans, tmp_path, "student", teacher=str(plain), guidance=2.0)
    with pytest.raises(ConfigError, match="unconditional teacher; expected 1, or weaker=CHECKPOINT"):
        call("distill", config)


def test_runs_go_on_as_if_nothing_had_happened(scans: Path, codec: Path, tmp_path: Path) -> None:
    """A codebook of moving averages, a discriminator and a condition's encoder are part of what is saved."""
    kinds = {
        "autoencoder": {"network": CODEC_NETWORK, "losses": {"adversarial": 0.1, "discriminator_width": 4}},
        "flow": {"network": UNET, "condition": SEMANTIC, "codec": str(codec)},
    }
    for name, values in kinds.items():
        whole = write_config(scans, tmp_path, f"{name}_whole", **values)
        parts = write_config(scans, tmp_path, f"{name}_parts", **values)
        call("train", whole)
        call("train", parts, "--minutes", "0")
        call("train", parts, "--resume")
        a, b = (load_checkpoint(tmp_path / p.stem / f"{p.stem}.safetensors") for p in (whole, parts))
        for part, network in a.networks.items():
            other = b.networks[part].state_dict()
            assert all(torch.equal(value, other[key]) for key, value in network.state_dict().items()), (name, part)


class Fixed(nn.Module):
    """An autoencoder that takes every latent for zero: what differs in its images was left to chance."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network
        self.channels, self.resolution, self.draws = network.channels, network.resolution, network.draws
        self.latent_shape = network.latent_shape

    def decode(self, z: torch.Tensor, chance: torch.Tensor) -> Any:
        return self.network.decode(torch.zeros_like(z), chance)


def test_the_small_autoencoder_and_a_flow_on_its_latents_held_on_disk(scans: Path, tmp_path: Path) -> None:
    network = {"architecture": "autoencoder", "arguments": {"widths": [8, 8], "depth": 2, "fine": 8}}
    call("train", write_config(scans, tmp_path, "codec", network=network, samples={"every": 8, "count": 2}))
    hdit = {"architecture": "hdit", "arguments": {"width": 16, "depths": [1], "heads": [2], "patch": [1, 1]}}
    values = {"codec": str(tmp_path / "codec" / "codec.safetensors"), "network": hdit}
    data = {"latents": True, "cache": str(tmp_path / "cache")}
    call("train", write_config(scans, tmp_path, "teacher", data=data, **values))
    assert [p.name[:8] for p in (tmp_path / "cache").glob("latents*")] == ["latents-"]
    generator = load_generator(tmp_path / "teacher" / "teacher.safetensors")
    [scan] = generator.scans(0, [3])
    assert len(scan) and scan.label is not None and scan.confidence is not None
    # What the autoencoder leaves to chance is a function of seed and index too.
    among = generator.range_images(0, [2, 3])[1]
    assert np.array_equal(generator.range_images(0, [3])[0].mask, among.mask)
    middle = replace(generator, autoencoder=Fixed(generator.autoencoder))
    same = middle.range_images(0, [3, 4, 3])
    assert np.array_equal(same[0].mask, same[2].mask) and not np.array_equal(same[0].mask, same[1].mask)


@pytest.mark.parametrize("condition", [None, SEMANTIC | {"arguments": {"channels": 8, "method": "patches"}}])
def test_a_decoder_goes_on_alone(condition: dict[str, Any] | None, scans: Path, tmp_path: Path) -> None:
    network = {"architecture": "autoencoder", "arguments": {"widths": [8, 8], "depth": 2, "fine": 8, "window": [3, 3]}}
    call("train", write_config(scans, tmp_path, "codec", network=network))
    hdit = {"architecture": "hdit", "arguments": {"width": 16, "depths": [1], "heads": [2], "patch": [1, 1]}}
    given = {"condition": condition} if condition else {}
    codec = str(tmp_path / "codec" / "codec.safetensors")
    call("train", write_config(scans, tmp_path, "teacher", codec=codec, network=hdit, **given))
    start = tmp_path / "teacher" / "teacher.safetensors"
    config = write_config(scans, tmp_path, "more", losses={"noise": 0.1}, samples={"every": 8, "count": 2})
    values = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels"):
        del values[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(values | {"init": str(start), "decoder": True}))
    call("train", config)
    before, after = load_checkpoint(start), load_checkpoint(tmp_path / "more" / "more.safetensors")
    assert after.header.time_grid == before.header.time_grid
    assert set(after.networks) == set(before.networks)
    moved = set()
    for part, held in before.networks.items():
        new = after.networks[part].state_dict()
        moved |= {f"{part}.{name}" for name, value in held.state_dict().items() if not torch.equal(value, new[name])}
    assert moved and all(name.startswith(f"{CODEC}.") for name in moved)
    assert not [name for name in moved if any(part in name for part in STILL)]
    assert {f"{CODEC}.from_latent.weight", f"{CODEC}.planes.consensus.strict"} <= moved
    cond = np.zeros((8, 32), np.uint8) if condition else None
    assert len(load_generator(tmp_path / "more" / "more.safetensors").scans(0, [3], cond)[0])


def test_fine_tuning_a_latent_model(scans: Path, teacher: Path, codec: Path, tmp_path: Path) -> None:
    config = write_config(scans, tmp_path, "more", network=UNET, recipe={"iterations": 1, "rate": 1e-9})
    values = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels", "network"):
        del values[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(values | {"init": str(teacher)}))
    call("train", config)
    start, end = load_checkpoint(teacher), load_checkpoint(tmp_path / "more" / "more.safetensors")
    assert set(end.networks) == set(start.networks)
    assert end.header.conditioning == start.header.conditioning
    for part in start.networks:
        for a, b in zip(start.networks[part].parameters(), end.networks[part].parameters(), strict=True):
            assert torch.allclose(a, b, atol=1e-6)
    with pytest.raises(ConfigError, match="expected a checkpoint of the same kind"):
        call("train", config, f"init={codec}", f"output={tmp_path / 'other'}")


def test_a_network_that_takes_its_condition_among_its_channels_is_no_start(
    scans: Path, codec: Path, tmp_path: Path
) -> None:
    call("train", write_config(scans, tmp_path, "blind", network=UNET, codec=str(codec), recipe={"iterations": 1}))
    config = write_config(scans, tmp_path, "looking", condition=SEMANTIC, codec=str(codec))
    values = {key: value for key, value in yaml.safe_load(config.read_text()).items() if key != "codec"}
    config.write_text(yaml.safe_dump(values | {"init": str(tmp_path / "blind" / "blind.safetensors")}))
    with pytest.raises(ConfigError, match="a condition for init .* a unet; expected init: a model of this condition"):
        call("train", config)


def test_a_pixel_model_of_label_maps(scans: Path, tmp_path: Path) -> None:
    """The condition does not care for the codec."""
    network = TRANSFORMER | {"arguments": TRANSFORMER["arguments"] | {"patch": [2, 2]}}
    call(
        "train",
        write_config(scans, tmp_path, "pixel", network=network, condition=SEMANTIC, channels=["range"], steps=3),
    )
    generator = load_generator(tmp_path / "pixel" / "pixel.safetensors")
    [scan] = generator.scans(0, [0], random_scan(SENSOR, 400, 1))
    assert generator.fields == {"label", "confidence"}
    assert scan.label is not None


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI-360's layout with scans and images."""
    folder = tmp_path_factory.mktemp("kitti360")
    writer: Any = WRITERS["kitti360"](folder)
    for i in range(3):
        image = np.random.default_rng(i).integers(0, 256, (40, 80, 3), dtype=np.uint8)
        writer.write(random_scan(SENSOR, 400, i), i, image=image)
    writer.finish()
    return folder


@pytest.mark.parametrize("condition", [SEMANTIC, CAMERA, SIGHT], ids=["semantic", "camera", "sight"])
def test_a_latent_transformer(condition: dict[str, Any], scans: Path, kitti: Path, codec: Path, tmp_path: Path) -> None:
    """Any velocity network lives on latents, which look where their cells look."""
    call("train", write_config(scans, tmp_path, "latent", network=TRANSFORMER, codec=str(codec), steps=3))
    start = tmp_path / "latent" / "latent.safetensors"
    [image] = load_generator(start).range_images(0, [0])
    assert "label" in image.channels

    # The start of a conditional model: until it has learnt to look, it generates what it did.
    data = {"path": str(kitti), "layout": "kitti360", "split": "all"}
    config = write_config(
        kitti, tmp_path, "looking", condition=condition, init=str(start), recipe={"rate": 1e-9}, data=data
    )
    values = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump({k: v for k, v in values.items() if k not in ("sensor", "channels")}))
    call("train", config)
    looking = load_generator(tmp_path / "looking" / "looking.safetensors")
    given = replace(random_scan(SENSOR, 400, 1), image_path=min(kitti.rglob("*.png")))
    [same] = looking.range_images(0, [0], condition=given, steps=50)
    [before] = load_generator(start).range_images(0, [0], steps=50)
    assert np.allclose(same.range, before.range, rtol=1e-3)
    kind = str(condition["kind"])
    assert looking.condition == kind and looking.header.conditioning[kind]["dropout"] == condition["dropout"]
    assert looking.header.provenance["init"] == load_checkpoint(start).hash
    if condition is SIGHT:  # it looks where the cells look
        angles = {
            name: load_checkpoint(tmp_path / "looking" / "looking.safetensors").networks[name].angles.cells
            for name in (ENCODER, VELOCITY)
        }
        assert torch.equal(angles[ENCODER], angles[VELOCITY])


@pytest.mark.parametrize("network", [UNET, TRANSFORMER], ids=lambda network: network["architecture"])
def test_a_camera_model(network: dict[str, Any], scans: Path, kitti: Path, codec: Path, tmp_path: Path) -> None:
    config = write_config(scans, tmp_path, "camera", network=network, condition=CAMERA, codec=str(codec), steps=3,
                          data={"path": str(kitti), "layout": "kitti360", "split": "all"})  # fmt: skip
    call("train", config)
    generator = load_generator(tmp_path / "camera" / "camera.safetensors")
    images = sorted(kitti.rglob("*.png"))
    given = np.asarray(Image.open(images[0]).resize((32, 16), Image.Resampling.BICUBIC)).transpose(2, 0, 1)
    [scan] = generator.scans(0, [0], given.copy())
    [same] = generator.scans(0, [0], replace(random_scan(SENSOR, 400, 0), image_path=images[0]))
    assert np.allclose(scan.points, same.points)
    with pytest.raises(ConfigError, match="roll with the condition 'camera'"):
        call("train", config, "data.roll=true", f"output={tmp_path / 'rolled'}")


def test_the_camera_of_another_focal_length_is_refused(scans: Path, kitti: Path, codec: Path, tmp_path: Path) -> None:
    data, condition = {"path": str(kitti), "layout": "kitti360", "split": "all"}, CAMERA | {"focal": 552.55}
    config = write_config(scans, tmp_path, "camera", network=UNET, condition=condition, codec=str(codec), data=data)
    call("train", config, "recipe.iterations=1")
    generator = load_generator(tmp_path / "camera" / "camera.safetensors")
    assert conditions_for(generator, str(kitti)) is not None
    file = kitti / "calibration" / "perspective.txt"
    for text, found in (
        (file.read_text().replace("5.52554261", "7.21537700"), "a focal length of 721.5 pixels"),
        (None, "no calibration"),
    ):
        other = tmp_path / found
        shutil.copytree(kitti, other)
        file = other / "calibration" / "perspective.txt"
        file.write_text(text) if text else shutil.rmtree(file.parent)
        with pytest.raises(DataError, match=f"a camera with {found}; expected 552.5 pixels"):
            conditions_for(generator, str(other))


def test_what_does_not_fit_together(scans: Path, codec: Path, teacher: Path, tmp_path: Path) -> None:
    def refuse(message: str, *overrides: str, **values: Any) -> None:
        with pytest.raises(ConfigError, match=message):
            call("train", write_config(scans, tmp_path, "bad", **({"network": UNET} | values)), *overrides)

    refuse("an autoencoder with a codec or a condition", network=CODEC_NETWORK, condition=SEMANTIC)
    refuse("decoder without init", decoder=True)
    refuse("expected a model whose autoencoder says", decoder=True, init=str(teacher))
    refuse("expected a checkpoint of the same kind", decoder=True, init=str(codec))
    refuse("of a latent model", codec=str(codec), recipe={"weights": {"label": 0.5}})
    refuse(f"channels .*expected that of {codec}", codec=str(codec), channels=["range"])
    refuse("expected the checkpoint of an autoencoder", codec=str(pixel_checkpoint(tmp_path)))
    refuse("unknown key 'condition.colour'", condition=SEMANTIC | {"colour": 1})
    refuse("one of semantic_map", condition=SEMANTIC | {"encoder": "views"})
    refuse(r"network.arguments with \['condition_channels'\]", condition=SEMANTIC,
           network={"architecture": "unet", "arguments": UNET["arguments"] | {"condition_channels": 3}})  # fmt: skip
    refuse("unexpected keyword argument 'colour'", network={"architecture": "hdit", "arguments": {"colour": 1}})
    student = write_config(scans, tmp_path, "student", teacher=str(codec))
    with pytest.raises(ConfigError, match="an autoencoder; expected a model that generates"):
        call("distill", student)
    with pytest.raises(ConfigError, match="of a latent model"):
        call("distill", student, f"teacher={teacher}", "recipe.weights={range: 2.0}")


def pixel_checkpoint(folder: Path) -> Path:
    from test_checkpoint import HEADER, network

    from lidar_synth.generate.checkpoint import save_checkpoint

    path = folder / "pixel.safetensors"
    save_checkpoint(path, HEADER, {VELOCITY: network()})
    return path


def test_conditions_reach_the_batches_of_teacher_and_student(scans: Path, teacher: Path, tmp_path: Path) -> None:
    from accelerate import Accelerator

    accelerator = Accelerator(cpu=True)
    config = load_config(DistillConfig, write_config(
        scans, tmp_path, "student", teacher=str(teacher), grid=[1, 0.5, 0], intervals=2, steps=1,
    ))  # fmt: skip
    plan = make_plan(config, accelerator)
    data = open_data(config, plan, accelerator.device)
    batch = data(range(3))
    assert batch.y0.shape == (3, 4, 4, 8) == batch.y1.shape
    assert batch.cond is not None and batch.cond.shape == (3, 8, 32)
    example = plan.task(batch)
    assert example.cond is batch.cond
