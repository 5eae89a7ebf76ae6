"""Conditional models from configuration to scans: label maps and camera images."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from conftest import random_scan
from latent_runs import (  # noqa: F401 - fixtures
    CODEC_NETWORK,
    SEMANTIC,
    SENSOR,
    UNET,
    call,
    codec,
    one_thread,
    scans,
    teacher,
    write_config,
)
from PIL import Image

from lidar_synth.bake.conditions import conditions_for
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.generate.checkpoint import (
    ENCODER,
    VELOCITY,
    load_checkpoint,
    save_checkpoint,
)
from lidar_synth.generate.conditions import CONDITIONS, bridge_gaps
from lidar_synth.generate.loading import load_generator
from lidar_synth.lab.town import Town
from lidar_synth.lab.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.lab.train.runs import open_stage
from lidar_synth.lab.train.student import target_flow

TRANSFORMER = {
    "architecture": "hdit",
    "arguments": {
        "width": 16,
        "time_width": 16,
        "depths": [1, 1],
        "heads": [2, 2],
        "patch": [1, 1],
        "window": [3, 3],
    },
}
PIXEL = TRANSFORMER | {"arguments": TRANSFORMER["arguments"] | {"patch": [2, 2]}}


CAMERA = {
    "kind": "camera",
    "dropout": 0.1,
    "view_dropout": 0.5,
    "image": [40, 80],
    "arguments": {"resolution": [16, 32], "views": 2, "channels": 8, "widths": [4, 8]},
}


SIGHT = CAMERA | {
    "encoder": "sight",
    "view_dropout": 0.0,
    "arguments": {
        "resolution": [16, 32],
        "channels": 5,
        "widths": [4, 8],
        "image_from_sensor": [
            [40.0, -30.0, 0.0, 0.0],
            [20.0, 0.0, -30.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ],
    },
}


def test_a_pixel_model_of_label_maps(scans: Path, tmp_path: Path) -> None:
    """The condition does not care for the codec."""
    call(
        "train",
        write_config(
            scans,
            tmp_path,
            "pixel",
            network=PIXEL,
            condition=SEMANTIC,
            channels=["range"],
            steps=3,
        ),
    )
    generator = load_generator(tmp_path / "pixel" / "pixel.safetensors")
    [scan] = generator.scans(0, [0], random_scan(SENSOR, 400, 1))
    assert generator.fields == {"label", "confidence"}
    assert scan.label is not None


def test_gaps_stay_in_label_maps_where_the_model_has_learnt_them(
    scans: Path, tmp_path: Path
) -> None:
    given = {"network": PIXEL, "condition": SEMANTIC, "channels": ["range"]}
    data = {"town": 1, "path": None}
    config = write_config(scans, tmp_path, "town", data=data, **given)
    town = open_stage(load_config(TrainConfig, config))
    assert "keep_gaps" not in town.header.conditioning["semantic"]
    start = tmp_path / "start.safetensors"
    save_checkpoint(start, town.header, town.parts(town.network))
    source = open_scans(scans / "scans")
    for init in (None, str(start)):
        config = write_config(scans, tmp_path, f"of-{init is None}", init=init, **given)
        stage = open_stage(load_config(TrainConfig, config))
        data = stage.open_data()
        shown = data.conditions(range(5)).numpy()
        options = stage.header.conditioning["semantic"]
        for i, seen in zip(data.scans_at(range(5)), shown, strict=True):
            sensor = stage.header.sensor
            read = CONDITIONS["semantic"].read(source[i], sensor, seen.shape, options)
            assert np.array_equal(read, seen)
            assert not np.array_equal(seen, bridge_gaps(seen))
    # A model that fills gaps may be its weaker one: both have seen them in training.
    own = tmp_path / "own.safetensors"
    save_checkpoint(own, stage.header, stage.parts(stage.network))
    given = {"teacher": str(own), "weaker": str(start), "guidance": 2}
    config = load_config(
        DistillConfig, write_config(scans, tmp_path, "student", **given)
    )
    _, made = target_flow(config, load_checkpoint(own), "cpu")
    assert made["weaker"] == load_checkpoint(start).hash


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "condition", [SEMANTIC, CAMERA, SIGHT], ids=["semantic", "camera", "sight"]
)
def test_a_latent_transformer(
    condition: dict[str, Any], scans: Path, kitti: Path, codec: Path, tmp_path: Path
) -> None:
    """Any velocity network lives on latents, which look where their cells look."""
    call(
        "train",
        write_config(
            scans, tmp_path, "latent", network=TRANSFORMER, codec=str(codec), steps=3
        ),
    )
    start = tmp_path / "latent" / "latent.safetensors"
    [image] = load_generator(start).range_images(0, [0])
    assert "label" in image.channels

    # The start of a conditional model: until it has learnt to look, it generates what it did.
    data = {"path": str(kitti), "layout": "kitti360", "split": "all"}
    data |= {"flip": condition is not SIGHT}
    config = write_config(
        kitti,
        tmp_path,
        "looking",
        condition=condition,
        init=str(start),
        recipe={"rate": 1e-9},
        data=data,
    )
    values = yaml.safe_load(config.read_text())
    config.write_text(
        yaml.safe_dump(
            {k: v for k, v in values.items() if k not in ("sensor", "channels")}
        )
    )
    call("train", config)
    looking = load_generator(tmp_path / "looking" / "looking.safetensors")
    given = replace(random_scan(SENSOR, 400, 1), image_path=min(kitti.rglob("*.png")))
    [same] = looking.range_images(0, [0], condition=given, steps=50)
    [before] = load_generator(start).range_images(0, [0], steps=50)
    assert np.allclose(same.range, before.range, rtol=1e-3)
    kind = str(condition["kind"])
    assert (
        looking.condition == kind
        and looking.header.conditioning[kind]["dropout"] == condition["dropout"]
    )
    assert looking.header.provenance["init"] == load_checkpoint(start).hash
    if condition is SIGHT:  # it looks where the cells look
        angles = {
            name: load_checkpoint(tmp_path / "looking" / "looking.safetensors")
            .networks[name]
            .angles.cells
            for name in (ENCODER, VELOCITY)
        }
        assert torch.equal(angles[ENCODER], angles[VELOCITY])


@pytest.mark.parametrize(
    "network", [UNET, TRANSFORMER], ids=lambda network: network["architecture"]
)
def test_a_camera_model(
    network: dict[str, Any], scans: Path, kitti: Path, codec: Path, tmp_path: Path
) -> None:
    config = write_config(
        scans,
        tmp_path,
        "camera",
        network=network,
        condition=CAMERA,
        codec=str(codec),
        steps=3,
        data={"path": str(kitti), "layout": "kitti360", "split": "all"},
    )
    call("train", config)
    generator = load_generator(tmp_path / "camera" / "camera.safetensors")
    images = sorted(kitti.rglob("*.png"))
    given = np.asarray(
        Image.open(images[0]).resize((32, 16), Image.Resampling.BICUBIC)
    ).transpose(2, 0, 1)
    [scan] = generator.scans(0, [0], given.copy())
    [same] = generator.scans(
        0, [0], replace(random_scan(SENSOR, 400, 0), image_path=images[0])
    )
    assert np.allclose(scan.points, same.points)
    model = tmp_path / "camera" / "camera.safetensors"
    student = ["distill", write_config(scans, tmp_path, "few", teacher=str(model))]
    held = "held_out={data: {town: 1, licence: MIT, roll: 90}}"
    for arguments, message in (
        (["train", config, "data.roll=true"], "data.roll=True"),
        (["train", config, "data.flip=both"], "data.flip=both"),
        (["train", config, held], "data.roll=90.0"),
        ([*student, "data.roll=true"], "data.roll=True"),
    ):
        with pytest.raises(
            ConfigError, match=f"{message}.* with the condition 'camera'"
        ):
            call(*arguments, f"output={tmp_path / 'turned'}")


def test_scans_are_not_mirrored_for_an_encoder_that_uses_the_calibration(
    scans: Path, kitti: Path, tmp_path: Path
) -> None:
    data = {"path": str(kitti), "layout": "kitti360", "split": "all"}
    given = {"network": PIXEL, "condition": SIGHT, "data": data}
    config = write_config(scans, tmp_path, "sight", **given)
    with pytest.raises(
        ConfigError,
        match="data.flip=True.* encoder 'sight'; expected .*data.flip=false",
    ):
        open_stage(load_config(TrainConfig, config)).open_data()
    open_stage(load_config(TrainConfig, config, ["data.flip=false"])).open_data()


@pytest.mark.slow
def test_the_town_renders_the_images_of_a_camera_model(
    scans: Path, tmp_path: Path
) -> None:
    condition = CAMERA | {"image": [376, 1408]}
    config = write_config(
        scans,
        tmp_path,
        "camera",
        network=UNET,
        condition=condition,
        steps=3,
        data={"town": 2, "path": None},
    )
    call("train", config, "recipe.iterations=1")
    kept = np.load(tmp_path / "camera" / "cache" / "camera.npy")
    town = Town(0, SENSOR, 2, interval=1.0)
    for i, image in enumerate(kept):
        small = Image.fromarray(town.image(i)).resize(
            (32, 16), Image.Resampling.BICUBIC
        )
        assert np.array_equal(image, np.asarray(small).transpose(2, 0, 1))
    with pytest.raises(
        DataError,
        match=r"the town's image of \(376, 1408\) rows and columns; expected \(40, 80\)",
    ):
        call("train", config, f"output={tmp_path / 'other'}", "condition.image=[40,80]")


def test_the_camera_of_another_focal_length_is_refused(
    scans: Path, kitti: Path, codec: Path, tmp_path: Path
) -> None:
    data = {"path": str(kitti), "layout": "kitti360", "split": "all"}
    condition = CAMERA | {"focal": 552.55}
    config = write_config(
        scans,
        tmp_path,
        "camera",
        network=UNET,
        condition=condition,
        codec=str(codec),
        data=data,
    )
    call("train", config, "recipe.iterations=1")
    generator = load_generator(tmp_path / "camera" / "camera.safetensors")
    assert conditions_for(generator, str(kitti)) is not None
    file = kitti / "calibration" / "perspective.txt"
    for text, found in (
        (
            file.read_text().replace("5.52554261", "7.21537700"),
            "a focal length of 721.5 pixels",
        ),
        (None, "no calibration"),
    ):
        other = tmp_path / found
        shutil.copytree(kitti, other)
        file = other / "calibration" / "perspective.txt"
        file.write_text(text) if text else shutil.rmtree(file.parent)
        refused = f"a camera with {found}; expected 552.5 pixels"
        with pytest.raises(DataError, match=refused):
            conditions_for(generator, str(other))
        with pytest.raises(DataError, match=refused):
            call("train", config, f"data.path={other}", f"output={other}-run")


@pytest.mark.slow
def test_what_does_not_fit_together(
    scans: Path, codec: Path, teacher: Path, tmp_path: Path
) -> None:
    def refuse(message: str, *overrides: str, **values: Any) -> None:
        with pytest.raises(ConfigError, match=message):
            call(
                "train",
                write_config(scans, tmp_path, "bad", **({"network": UNET} | values)),
                *overrides,
            )

    refuse(
        "an autoencoder with a codec or a condition",
        network=CODEC_NETWORK,
        condition=SEMANTIC,
    )
    refuse("decoder without init", decoder=True)
    refuse("with a codec", decoder=True, init=str(teacher), codec=str(codec))
    refuse(
        "expected a model whose autoencoder predicts", decoder=True, init=str(teacher)
    )
    refuse("expected a checkpoint of the same kind", decoder=True, init=str(codec))
    refuse("of a latent model", codec=str(codec), recipe={"weights": {"label": 0.5}})
    refuse(f"channels .*expected that of {codec}", codec=str(codec), channels=["range"])
    refuse(
        "expected the checkpoint of an autoencoder",
        codec=str(pixel_checkpoint(tmp_path)),
    )
    refuse("unknown key 'condition.colour'", condition=SEMANTIC | {"colour": 1})
    refuse("one of 'semantic_map'", condition=SEMANTIC | {"encoder": "views"})
    refuse(
        r"network.arguments with \['condition_channels'\]",
        condition=SEMANTIC,
        network={
            "architecture": "unet",
            "arguments": UNET["arguments"] | {"condition_channels": 3},
        },
    )
    refuse(
        "unexpected keyword argument 'colour'",
        network={"architecture": "hdit", "arguments": {"colour": 1}},
    )
    student = write_config(scans, tmp_path, "student", teacher=str(codec))
    with pytest.raises(
        ConfigError, match="an autoencoder; expected a model that generates"
    ):
        call("distill", student)
    with pytest.raises(ConfigError, match="of a latent model"):
        call("distill", student, f"teacher={teacher}", "recipe.weights={range: 2.0}")


def pixel_checkpoint(folder: Path) -> Path:
    from test_checkpoint import HEADER, network

    from lidar_synth.generate.checkpoint import save_checkpoint

    path = folder / "pixel.safetensors"
    save_checkpoint(path, HEADER, {VELOCITY: network()})
    return path


def test_conditions_reach_the_batches_of_teacher_and_student(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    from accelerate import Accelerator

    accelerator = Accelerator(cpu=True)
    config = load_config(
        DistillConfig,
        write_config(
            scans,
            tmp_path,
            "student",
            teacher=str(teacher),
            grid=[1, 0.5, 0],
            intervals=2,
            steps=1,
        ),
    )
    stage = open_stage(config)
    data = stage.open_data()
    stage.prepare(data, accelerator)
    batch = data(range(3))
    assert batch.y0.shape == (3, 4, 4, 8) == batch.y1.shape
    assert batch.cond is not None and batch.cond.shape == (3, 8, 32)
    example = stage.task(batch)
    assert example.cond is batch.cond
