"""The latent path from configurations: autoencoder, conditioned teacher, student, scans; by the
commands of pixels."""

import json
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
from torch import nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    join,
    load_checkpoint,
    network_hash,
    read_header,
    save_checkpoint,
)
from lidar_synth.generate.flow.timesteps import TrajectoryCosts
from lidar_synth.generate.loading import load_generator
from lidar_synth.lab.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.lab.train.runs import open_stage
from lidar_synth.lab.train.student import target_flow

STILL = ("stem", "encode", "merge", "to_latent", "shift", "scale")
"""Parts of names in an autoencoder that belong to its encoder, or to both sides."""


@pytest.mark.slow
def test_an_autoencoder_is_a_checkpoint_without_a_flow(codec: Path) -> None:
    header, networks, _ = load_checkpoint(codec)
    assert set(networks) == {CODEC}
    assert header.channels == ("range", "reflectance", "label")
    # The latents' statistics.
    assert float(networks[CODEC].scale.mean()) != 1  # type: ignore[arg-type, union-attr]
    with pytest.raises(
        DataError, match="is an autoencoder; expected a model that generates"
    ):
        load_generator(codec)


@pytest.mark.slow
def test_a_latent_model_of_label_maps_generates(codec: Path, teacher: Path) -> None:
    header, networks, _ = load_checkpoint(teacher)
    assert set(networks) == {VELOCITY, CODEC, ENCODER}
    assert header.networks[VELOCITY].arguments["channels"] == 4
    assert header.networks[VELOCITY].arguments["resolution"] == [4, 8]
    assert header.networks[VELOCITY].arguments["condition_channels"] == 3
    assert header.conditioning == {"semantic": {"dropout": 0.2, "keep_gaps": True}}
    assert header.provenance["codec"] == load_checkpoint(codec).hash
    for a, b in zip(
        networks[CODEC].parameters(),
        load_checkpoint(codec).networks[CODEC].parameters(),
        strict=True,
    ):
        assert torch.equal(a, b)  # it is frozen
    generator = load_generator(teacher)
    real = random_scan(SENSOR, 400, 9)
    [scan] = generator.scans(3, [1], real)
    # Small networks, hardly trained: a weak guidance may end at the same codes of the autoencoder.
    [guided] = generator.scans(3, [1], real, guidance=100.0)
    assert (scan.id, scan.sensor) == ("teacher/3/1", SENSOR)
    # Of its own: the tensor carries labels.
    assert scan.label is not None and scan.confidence is not None
    assert len(scan) > 0 and not np.array_equal(scan.points, guided.points)
    together = torch.cat(list(replace(generator, batch=2).samples(3, [5, 1], real)))
    [alone] = generator.samples(3, [1], real)
    assert torch.allclose(together[1], alone[0], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("guidance", [1.0, 2.0])
def test_it_is_distilled_on_timesteps_selected_with_its_conditions(
    guidance: float, scans: Path, teacher: Path, tmp_path: Path
) -> None:
    selection = {"candidates": 8, "trajectories": 3}
    config = write_config(
        scans,
        tmp_path,
        "student",
        teacher=str(teacher),
        steps=2,
        selection=selection,
        guidance=guidance,
    )
    call("distill", config)
    header, _ = read_header(tmp_path / "student" / "student.safetensors")
    with np.load(tmp_path / "student" / "selection.npz") as found:
        made = TrajectoryCosts(found["total"], found["optima"]).selection
    assert header.time_grid == made.grid and len(made.grid) == 5
    [scan] = load_generator(tmp_path / "student" / "student.safetensors").scans(
        0, [0], random_scan(SENSOR, 400, 1)
    )
    assert len(scan) > 0
    call("distill", config, "--resume", "recipe.iterations=10")
    assert (
        read_header(tmp_path / "student" / "student.safetensors")[0].provenance[
            "iterations"
        ]
        == 10
    )


@pytest.mark.slow
def test_a_student_learns_the_autoguided_teacher(
    scans: Path, codec: Path, teacher: Path, tmp_path: Path
) -> None:
    small = UNET | {"arguments": UNET["arguments"] | {"width": 8}}  # type: ignore[dict-item]
    call(
        "train",
        write_config(
            scans, tmp_path, "weak", codec=str(codec), network=small, condition=SEMANTIC
        ),
    )
    weaker = tmp_path / "weak" / "weak.safetensors"
    values = {
        "teacher": str(teacher),
        "weaker": str(weaker),
        "strategy": "uniform_piecewise",
        "steps": 2,
    }
    config = write_config(
        scans, tmp_path, "student", **values, guidance=2.5, within=[0.1, 0.5]
    )
    call("distill", config)
    header, _ = read_header(tmp_path / "student" / "student.safetensors")
    assert header.provenance["weaker"] == load_checkpoint(weaker).hash
    assert str(tmp_path) not in json.dumps(header.provenance)

    strong = load_checkpoint(teacher)
    weak = load_checkpoint(weaker)
    flow, _ = target_flow(
        load_config(DistillConfig, config), strong, torch.device("cpu")
    )
    y = torch.randn(2, 4, 4, 8)
    t = torch.tensor([0.3, 0.8])
    maps = torch.randint(0, 19, (2, *SENSOR.shape), dtype=torch.uint8)
    a, b = (join(checkpoint.networks)(y, t, maps) for checkpoint in (strong, weak))
    assert not torch.allclose(a, b, atol=1e-3)
    assert torch.allclose(flow(y, t, maps)[0], (b + 2.5 * (a - b))[0], atol=1e-5)
    assert torch.allclose(flow(y, t, maps)[1], a[1], atol=1e-5)  # t = 0.8

    for changes, message in (
        (["guidance=1"], "weak.safetensors with guidance 1; expected a guidance scale"),
        (["within=[0.9,0.1]"], r"within \(0.9, 0.1\); expected two increasing times"),
        (
            [f"weaker={codec}"],
            "codec.safetensors, an autoencoder; expected a model that generates",
        ),
        (
            [f"teacher={without_condition(teacher, tmp_path)}"],
            "of another conditioning; expected those of",
        ),
        (
            [f"weaker={with_other_codec(weaker, tmp_path)}"],
            "of another autoencoder; expected those of",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            call("distill", config, f"output={tmp_path / 'other'}", *changes)


def without_condition(path: Path, folder: Path) -> Path:
    """A model whose header says nothing of the condition that it takes."""
    header, networks, _ = load_checkpoint(path)
    save_checkpoint(
        out := folder / "alone.safetensors", replace(header, conditioning={}), networks
    )
    return out


def with_other_codec(path: Path, folder: Path) -> Path:
    """A model of other latents."""
    header, networks, _ = load_checkpoint(path)
    with torch.no_grad():
        networks[CODEC].scale.mul_(1.5)  # type: ignore[union-attr, operator]
    save_checkpoint(out := folder / "apart.safetensors", header, networks)
    return out


def test_guidance_of_an_unconditional_teacher_asks_for_a_weaker_one(
    scans: Path, codec: Path, tmp_path: Path
) -> None:
    call(
        "train", write_config(scans, tmp_path, "plain", codec=str(codec), network=UNET)
    )
    plain = tmp_path / "plain" / "plain.safetensors"
    config = write_config(scans, tmp_path, "student", teacher=str(plain), guidance=2.0)
    with pytest.raises(
        ConfigError, match="unconditional teacher; expected 1, or weaker=CHECKPOINT"
    ):
        call("distill", config)


@pytest.mark.slow
def test_runs_go_on_as_if_nothing_had_happened(
    scans: Path, codec: Path, tmp_path: Path
) -> None:
    """A codebook of moving averages, a discriminator and a condition's encoder are part of what is
    saved."""
    kinds = {
        "autoencoder": {
            "network": CODEC_NETWORK,
            "losses": {"adversarial": 0.1, "discriminator_width": 4},
        },
        "flow": {"network": UNET, "condition": SEMANTIC, "codec": str(codec)},
    }
    for name, values in kinds.items():
        whole = write_config(scans, tmp_path, f"{name}_whole", **values)
        parts = write_config(scans, tmp_path, f"{name}_parts", **values)
        call("train", whole)
        call("train", parts, "--minutes", "0")
        call("train", parts, "--resume")
        a, b = (
            load_checkpoint(tmp_path / p.stem / f"{p.stem}.safetensors")
            for p in (whole, parts)
        )
        for part, network in a.networks.items():
            other = b.networks[part].state_dict()
            assert all(
                torch.equal(value, other[key])
                for key, value in network.state_dict().items()
            ), (name, part)


class Fixed(nn.Module):
    """An autoencoder that takes every latent for zero: its images differ by the noise of sampling
    only."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network
        self.channels = network.channels
        self.resolution = network.resolution
        self.draws = network.draws
        self.latent_shape = network.latent_shape

    def decode(self, z: torch.Tensor, uniform_noise: torch.Tensor) -> Any:
        return self.network.decode(torch.zeros_like(z), uniform_noise)


SURFACES = {
    "architecture": "surfaces",
    "arguments": {
        "encoder_widths": [8, 8],
        "widths": [8, 8],
        "reaches": [1],
        "depth": 1,
    },
}


@pytest.mark.slow
def test_the_small_autoencoder_and_a_flow_on_its_latents_held_on_disk(
    scans: Path, tmp_path: Path
) -> None:
    call(
        "train",
        write_config(
            scans, tmp_path, "codec", network=SURFACES, samples={"every": 8, "count": 2}
        ),
    )
    hdit = {
        "architecture": "hdit",
        "arguments": {"width": 16, "depths": [1], "heads": [2], "patch": [1, 1]},
    }
    values = {"codec": str(tmp_path / "codec" / "codec.safetensors"), "network": hdit}
    data = {"latents": True, "cache": str(tmp_path / "cache")}
    call("train", write_config(scans, tmp_path, "teacher", data=data, **values))
    assert len(list((tmp_path / "cache").glob("latents-*/latents.npy"))) == 1
    generator = load_generator(tmp_path / "teacher" / "teacher.safetensors")
    [scan] = generator.scans(0, [3])
    assert len(scan) and scan.label is not None and scan.confidence is not None
    # The noise with which the autoencoder samples is a function of seed and index too.
    among = generator.range_images(0, [2, 3])[1]
    assert np.array_equal(generator.range_images(0, [3])[0].mask, among.mask)
    middle = replace(generator, autoencoder=Fixed(generator.autoencoder))
    same = middle.range_images(0, [3, 4, 3])
    assert np.array_equal(same[0].mask, same[2].mask) and not np.array_equal(
        same[0].mask, same[1].mask
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "condition", [None, SEMANTIC | {"arguments": {"channels": 8, "method": "patches"}}]
)
def test_a_decoder_goes_on_alone(
    condition: dict[str, Any] | None, scans: Path, tmp_path: Path
) -> None:
    call("train", write_config(scans, tmp_path, "codec", network=SURFACES))
    hdit = {
        "architecture": "hdit",
        "arguments": {"width": 16, "depths": [1], "heads": [2], "patch": [1, 1]},
    }
    given = {"condition": condition} if condition else {}
    codec = str(tmp_path / "codec" / "codec.safetensors")
    call(
        "train",
        write_config(scans, tmp_path, "teacher", codec=codec, network=hdit, **given),
    )
    start = tmp_path / "teacher" / "teacher.safetensors"
    config = write_config(
        scans, tmp_path, "more", losses={"noise": 0.1}, samples={"every": 8, "count": 2}
    )
    values = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels"):
        del values[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(values | {"init": str(start), "decoder": True}))
    call("train", config)
    before = load_checkpoint(start)
    after = load_checkpoint(tmp_path / "more" / "more.safetensors")
    assert after.header.time_grid == before.header.time_grid
    assert set(after.networks) == set(before.networks)
    moved = set()
    for part, held in before.networks.items():
        new = after.networks[part].state_dict()
        moved |= {
            f"{part}.{name}"
            for name, value in held.state_dict().items()
            if not torch.equal(value, new[name])
        }
    assert moved and all(name.startswith(f"{CODEC}.") for name in moved)
    assert not [name for name in moved if any(part in name for part in STILL)]
    assert {f"{CODEC}.from_latent.weight", f"{CODEC}.head.weight"} <= moved
    cond = np.zeros((8, 32), np.uint8) if condition else None
    assert len(
        load_generator(tmp_path / "more" / "more.safetensors").scans(0, [3], cond)[0]
    )


def test_a_discriminator_follows_the_seed(
    scans: Path, codec: Path, tmp_path: Path
) -> None:
    losses = {"adversarial": 0.1, "discriminator_width": 4}
    path = write_config(scans, tmp_path, "more", network=CODEC_NETWORK, losses=losses)
    zero, again, one = (
        network_hash(
            open_stage(
                load_config(TrainConfig, path, [f"init={codec}", f"seed={seed}"])
            ).network
        )
        for seed in (0, 0, 1)
    )
    assert zero == again != one


def test_fine_tuning_a_latent_model(
    scans: Path, teacher: Path, codec: Path, tmp_path: Path
) -> None:
    config = write_config(
        scans, tmp_path, "more", network=UNET, recipe={"iterations": 1, "rate": 1e-9}
    )
    values = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels", "network"):
        del values[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(values | {"init": str(teacher)}))
    call("train", config)
    start = load_checkpoint(teacher)
    end = load_checkpoint(tmp_path / "more" / "more.safetensors")
    assert set(end.networks) == set(start.networks)
    assert end.header.conditioning == start.header.conditioning
    for part in start.networks:
        for a, b in zip(
            start.networks[part].parameters(),
            end.networks[part].parameters(),
            strict=True,
        ):
            assert torch.allclose(a, b, atol=1e-6)
    with pytest.raises(ConfigError, match="expected a checkpoint of the same kind"):
        call("train", config, f"init={codec}", f"output={tmp_path / 'other'}")


def test_a_network_that_takes_its_condition_among_its_channels_is_no_start(
    scans: Path, codec: Path, tmp_path: Path
) -> None:
    call(
        "train",
        write_config(
            scans,
            tmp_path,
            "blind",
            network=UNET,
            codec=str(codec),
            recipe={"iterations": 1},
        ),
    )
    config = write_config(
        scans, tmp_path, "looking", condition=SEMANTIC, codec=str(codec)
    )
    values = {
        key: value
        for key, value in yaml.safe_load(config.read_text()).items()
        if key != "codec"
    }
    config.write_text(
        yaml.safe_dump(values | {"init": str(tmp_path / "blind" / "blind.safetensors")})
    )
    with pytest.raises(
        ConfigError,
        match="a condition for init .* a unet; expected init: a model of this condition",
    ):
        call("train", config)
