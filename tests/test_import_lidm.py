"""Import of LiDM's releases: small models end to end, the published ones by all their keys."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch
import yaml
from conftest import Golden
from fuzzing.text import edit
from releases import (
    DDCONFIG,
    FIRST,
    MASKED,
    MODELS,
    UNCONDITIONAL,
    UNET_PARAMS,
    config_of,
    random_weights,
    release,
    schedule,
)
from safetensors.torch import load_file
from torch import Tensor
from typer.testing import CliRunner

from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, load_checkpoint
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models.lidm.unet import _plan
from lidar_synth.lab.importers.lidm import read_lidm
from lidar_synth.lab.importers.lidm_names import FIRST_STAGE, UNET, UNET_EMA


def run_import(path: Path, out: Path, *options: str) -> str:
    from lidar_synth.cli import app

    given = ["import", str(path), str(out), "--peer", "lidm", *options]
    result = CliRunner().invoke(app, given)
    if result.exception is not None:
        raise result.exception
    return result.output


def test_an_autoencoder_has_no_scans_to_look_at(tmp_path: Path) -> None:
    first = MODELS["first stage"]
    path = release(tmp_path, config_of(first), random_weights(first, tmp_path))
    with pytest.raises(ConfigError, match="an autoencoder.*Leave out --check"):
        run_import(path, tmp_path / "out.safetensors", "--check")
    assert not (tmp_path / "out.safetensors").exists()


@pytest.mark.parametrize("name", MODELS)
def test_a_release_becomes_a_checkpoint(name: str, tmp_path: Path) -> None:
    weights = random_weights(MODELS[name], tmp_path) | {
        "loss.discriminator.main.0.weight": torch.zeros(4)
    }
    path = release(tmp_path, config_of(MODELS[name]), weights)
    out = tmp_path / "out.safetensors"
    said = run_import(path, out)
    header, networks, digest = load_checkpoint(out)
    assert digest in said
    expected = {
        "first stage": {CODEC},
        "unconditional": {VELOCITY, CODEC},
        "semantic": {VELOCITY, CODEC, ENCODER},
        "camera": {VELOCITY, CODEC, ENCODER},
        "first stage with a mask": {CODEC},
        "flow with a mask": {VELOCITY, CODEC},
    }
    assert set(networks) == expected[name]
    assert (header.channels, header.sensor.shape, header.sensor.range_max) == (
        ("range",),
        (8, 32),
        56.0,
    )
    assert (header.normalisation.kind, header.normalisation.divisor) == ("linear", 56.0)
    assert list(header.conditioning) == (
        [name] if name in ("semantic", "camera") else []
    )
    assert header.provenance["data"] == "KITTI-360"
    seen = {part["dataset"]: part["drives"] for part in header.provenance["seen"]}
    assert "2013_05_28_drive_0002_sync" in seen["KITTI-360"]
    # By the autoencoder inside a flow's file.
    assert ("odometry 21" in seen.get("KITTI", {})) == (VELOCITY in networks)
    if VELOCITY in networks:  # the averaged weights are imported, not the last ones
        head = networks[VELOCITY].state_dict()["head.bias"]
        assert torch.equal(head, weights[f"{UNET_EMA}diffusion_modelout2bias"])


def test_imported_models_generate(tmp_path: Path) -> None:
    maps = torch.full((8, 32), 3, dtype=torch.uint8)
    for name, condition in (
        ("unconditional", None),
        ("flow with a mask", None),
        ("semantic", maps),
    ):
        folder = tmp_path / name
        folder.mkdir()
        out = folder / f"{name}.safetensors"
        run_import(
            release(
                folder, config_of(MODELS[name]), random_weights(MODELS[name], folder)
            ),
            out,
        )
        generator = load_generator(out)
        [scan] = generator.scans(0, [1], condition, steps=3)
        assert scan.id == f"{name}/0/1"
        assert (scan.label is None) == (condition is None)


def test_other_configurations_are_imported(tmp_path: Path) -> None:
    config = config_of(
        FIRST, "lidm.data.kitti.SemanticKITTITrain", log_scale=True, depth_scale=5.84
    )
    header, _ = read_lidm(release(tmp_path, config, random_weights(FIRST, tmp_path)))
    assert header.provenance["data"] == "SemanticKITTI"
    assert (
        header.normalisation.kind,
        header.normalisation.divisor,
        header.normalisation.offset,
    ) == (
        "log",
        5.84,
        1.0001,
    )


@pytest.mark.parametrize(("scale", "kind"), [(5.84, "log"), (56, "linear")])
def test_an_older_configuration_without_a_scale_is_imported(
    scale: float, kind: str, tmp_path: Path
) -> None:
    """The published autoencoders with a mask date from a time when the scale was always
    logarithmic."""
    config = config_of(MASKED, depth_scale=scale)
    del config["data"]["params"]["dataset"]["log_scale"]
    header, _ = read_lidm(release(tmp_path, config, random_weights(MASKED, tmp_path)))
    assert (header.normalisation.kind, header.normalisation.divisor) == (kind, scale)


def test_weights_without_an_average_are_imported_unchanged(tmp_path: Path) -> None:
    weights = {
        k: v
        for k, v in random_weights(UNCONDITIONAL, tmp_path).items()
        if not k.startswith(UNET_EMA)
    }
    _, networks = read_lidm(release(tmp_path, config_of(UNCONDITIONAL), weights))
    assert torch.equal(
        networks[VELOCITY].state_dict()["head.bias"], weights[f"{UNET}out.2.bias"]
    )


# --- the published networks
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["vqvae", "uncond", "sem2lidar", "cam2lidar"])
def test_all_keys_of_the_published_networks_are_imported(
    name: str, golden: Golden, tmp_path: Path
) -> None:
    """Up to 395 M parameters by name and shape; each tensor is one expanded number."""
    published = json.loads((golden / f"lidm_{name}_full_keys.json").read_text())
    zero = torch.zeros(())
    weights = {
        key: zero.expand(shape)
        for key, shape, *_ in published["keys"]
        if not key.startswith(UNET_EMA)
    }
    if name != "vqvae":
        start, end = (
            published["config"][key] for key in ("linear_start", "linear_end")
        )
        weights |= schedule(start, end)
        for key in [k for k in weights if k.startswith(UNET)]:
            weights[UNET_EMA + key.removeprefix("model.").replace(".", "")] = weights[
                key
            ]
        weights |= {f"{UNET_EMA}decay": zero, f"{UNET_EMA}num_updates": torch.tensor(0)}
        assert (
            sum(k.startswith(UNET_EMA) for k in weights)
            == published["groups"]["model_ema"]["tensors"]
        )
    config = config_of(published["config"], size=[64, 1024])
    header, networks = read_lidm(release(tmp_path, config, weights))
    count = {
        part: sum(p.numel() for p in network.parameters())
        for part, network in networks.items()
    }
    if name == "vqvae":
        assert count == {CODEC: published["parameters"]}
    else:
        assert count[VELOCITY] == published["unet_parameters"]
        assert count[CODEC] == published["groups"]["first_stage_model"]["elements"]
    assert header.sensor.shape == (64, 1024)


# --- invalid files
# --------------------------------------------------------------------------------------------------


def drop(weights: dict[str, Tensor]) -> None:
    del weights[f"{FIRST_STAGE}decoder.up.1.block.0.norm1.bias"]


def drop_average(weights: dict[str, Tensor]) -> None:
    del weights[f"{UNET_EMA}diffusion_modelout2bias"]


def add(weights: dict[str, Tensor]) -> None:
    weights["model.extra.weight"] = torch.zeros(2)


def reshape(weights: dict[str, Tensor]) -> None:
    weights[f"{FIRST_STAGE}quantize.embedding.weight"] = torch.zeros(8, 4)


def rescale(weights: dict[str, Tensor]) -> None:
    weights["scale_factor"] = torch.tensor(0.18)


def reschedule(weights: dict[str, Tensor]) -> None:
    weights |= schedule(end=0.012)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            drop,
            r"missing keys \['first_stage_model.decoder.up.1.block.0.norm1.bias'\], "
            r"unexpected keys \[\]",
        ),
        (drop_average, r"missing keys \['model.diffusion_model.out.2.bias'\]"),
        (add, r"missing keys \[\], unexpected keys \['model.extra.weight'\]"),
        (reshape, r"other shapes: codebook.codes \(8, 4\) for \(16, 4\)"),
        (rescale, r"latents scaled by 0.18"),
        (reschedule, r"another noise schedule than in its config.yaml"),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    spoil: Callable[[dict[str, Tensor]], None], message: str, tmp_path: Path
) -> None:
    weights = random_weights(UNCONDITIONAL, tmp_path)
    spoil(weights)
    with pytest.raises(DataError, match=message) as caught:
        read_lidm(release(tmp_path, config_of(UNCONDITIONAL), weights))
    assert "model.ckpt" in str(caught.value)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (FIRST | {"use_mask": True}, r"an autoencoder with \{'out_ch': 1\}"),
        (
            FIRST | {"ddconfig": DDCONFIG | {"out_ch": 2}},
            r"an autoencoder with \{'out_ch': 2\}",
        ),
        (
            UNCONDITIONAL
            | {"unet_config": {"params": UNET_PARAMS | {"lib_name": "ldm"}}},
            "a U-Net with",
        ),
        (
            UNCONDITIONAL
            | {"cond_stage_config": {"target": "x.FrozenCLIPTextEmbedder"}},
            "by FrozenCLIPTextEmbedder",
        ),
        ({"linear_start": 1}, "KeyError: 'first_stage_config'"),
    ],
)
def test_configurations_that_do_not_fit_are_refused(
    model: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=message):
        read_lidm(release(tmp_path, config_of(model), {}))


def test_a_missing_config_yaml_is_reported(tmp_path: Path) -> None:
    path = release(tmp_path, config_of(FIRST), random_weights(FIRST, tmp_path))
    (tmp_path / "config.yaml").write_text("[")
    with pytest.raises(DataError, match=r"config.yaml is not YAML"):
        read_lidm(path)
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(FileError, match=r"config.yaml cannot be read"):
        read_lidm(path)


def test_a_pickle_of_something_else_is_refused(tmp_path: Path) -> None:
    path = release(tmp_path, config_of(FIRST), {})
    torch.save([1], path)
    with pytest.raises(DataError, match="state_dict among its keys"):
        read_lidm(path)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_bare_state_dictionary_of_a_wrapped_network_is_imported(
    tmp_path: Path, zipped: bool
) -> None:
    weights = random_weights(FIRST, tmp_path)
    wanted = read_lidm(release(tmp_path, config_of(FIRST), weights))[1][
        CODEC
    ].state_dict()
    bare = {f"module._orig_mod.{name}": tensor for name, tensor in weights.items()}
    torch.save(
        bare, path := tmp_path / "model.ckpt", _use_new_zipfile_serialization=zipped
    )
    found = read_lidm(path)[1][CODEC].state_dict()
    assert found.keys() == wanted.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in wanted.items())


def test_an_imported_checkpoint_gives_the_results_of_lidm(
    golden: Golden, tmp_path: Path
) -> None:
    """.ckpt -> import -> checkpoint -> autoencoder gives LiDM's own results."""
    about = json.loads((golden / "lidm_vqvae_tiny.json").read_text())
    tensors = load_file(golden / "lidm_vqvae_tiny.safetensors")
    weights = {
        k.removeprefix("weights."): v
        for k, v in tensors.items()
        if k.startswith("weights.")
    }
    out = tmp_path / "codec.safetensors"
    run_import(
        release(tmp_path, config_of(about["config"], size=about["size"]), weights), out
    )
    codec: Any = load_checkpoint(out).networks[CODEC]
    with torch.no_grad():
        error = (
            codec.decode(codec.encode(tensors["input.x"])) - tensors["output"]
        ).norm() / tensors["output"].norm()
    assert float(error) < 6e-5


@pytest.mark.parametrize("blocks", [2**31 - 1, "2", None, [1], 1.5, -1])
def test_a_hostile_number_of_blocks_is_refused_soon(
    tmp_path: Path, blocks: Any
) -> None:
    path = release(tmp_path, config_of(FIRST), random_weights(FIRST, tmp_path))
    config = config_of(FIRST)
    config["model"]["params"]["ddconfig"]["num_res_blocks"] = blocks
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    start = time.process_time()
    with pytest.raises(DataError):
        read_lidm(path)
    assert time.process_time() - start < 5


def test_mutated_configurations_give_no_foreign_error(tmp_path: Path) -> None:
    path = release(tmp_path, config_of(FIRST), random_weights(FIRST, tmp_path))
    rng = Random(0)
    refused = 0
    for _ in range(60):
        config = config_of(FIRST)
        edit(config, rng)
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
        try:
            read_lidm(path)
        except LidarSynthError:
            refused += 1
    assert refused > 10


def test_a_u_net_without_end_is_refused_before_it_is_planned() -> None:
    with pytest.raises(ConfigError, match="1000000000 blocks a level"):
        _plan([16, 32], 10**9)
