"""U-Net, autoencoder and label maps against golden results of LiDM's own code with the same
weights."""

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from conftest import Golden
from safetensors.torch import load_file
from torch import Tensor

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, NetworkSpec
from lidar_synth.generate.models.lidm.diffusion import DiffusionUNet
from lidar_synth.generate.models.lidm.vqvae import VQVAE
from lidar_synth.lab.importers.lidm import codec_part, convert, unet_part
from lidar_synth.lab.importers.lidm_names import COND_STAGE, UNET

pytestmark = pytest.mark.usefixtures("one_thread")


def distance(a: Tensor, b: Tensor) -> float:
    """Relative distance in the l2 norm."""
    return float((a - b).detach().norm() / b.norm())


def read_golden(
    folder: Path, name: str
) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
    """The description, the golden tensors and the weights of a network."""
    tensors = load_file(folder / f"{name}.safetensors")
    weights = {
        k.removeprefix("weights."): v
        for k, v in tensors.items()
        if k.startswith("weights.")
    }
    return json.loads((folder / f"{name}.json").read_text()), tensors, weights


def tolerance(figures: dict[str, float]) -> float:
    return max(1e-5, 20 * figures["rel_l2"])


@pytest.mark.parametrize("grad", [False, True], ids=["inference", "training"])
@pytest.mark.parametrize("name", ["lidm_unet_tiny_uncond", "lidm_unet_tiny_context"])
def test_the_unet_equals_that_of_lidm(golden: Golden, name: str, grad: bool) -> None:
    about, tensors, weights = read_golden(golden, name)
    parts = {VELOCITY: unet_part(about["config"], name)}
    net = cast(
        DiffusionUNet,
        convert({UNET + k: v for k, v in weights.items()}, parts)[VELOCITY],
    )
    assert sum(p.numel() for p in net.parameters()) == about["parameters"]
    taps = {}
    net.time.register_forward_hook(lambda _, __, out: taps.update(time_embedding=out))
    net.middle[-1].register_forward_hook(lambda _, __, out: taps.update(middle=out))
    with torch.set_grad_enabled(grad):
        out = net.evaluate(
            tensors["input.x"], tensors["input.timesteps"], tensors.get("input.context")
        )
    assert (
        distance(out, tensors["output"])
        < about["sensitivity"]["suggested_rel_l2_tolerance"]
    )
    assert set(taps) == {"time_embedding", "middle"}
    for tap, value in taps.items():
        assert distance(value, tensors[f"tap.{tap}"]) < 5e-5, tap


@torch.no_grad()
def test_the_autoencoder_equals_that_of_lidm(golden: Golden) -> None:
    about, tensors, weights = read_golden(golden, "lidm_vqvae_tiny")
    net = cast(
        VQVAE,
        convert(weights, {CODEC: codec_part(about["config"], about["size"], "")})[
            CODEC
        ],
    )
    assert sum(p.numel() for p in net.parameters()) == about["parameters"]
    figures = about["f32_vs_f64"]
    latent = net.encode(tensors["input.x"])
    assert distance(latent, tensors["latent"]) < tolerance(figures["latent"])
    quantised, index = net.codebook(latent)
    assert torch.equal(index.flatten(), tensors["indices"])
    assert distance(quantised, tensors["quantised"]) < 1e-6
    assert distance(net.decode(latent), tensors["output"]) < tolerance(
        figures["output_without_quantiser"]
    )
    plain = net._decode(tensors["latent"])
    assert distance(plain, tensors["output_without_quantiser"]) < tolerance(
        figures["output_without_quantiser"]
    )
    gaps = net(tensors["input.x"])
    torch.testing.assert_close(
        gaps.gap + 0.25 * gaps.code_gap, tensors["codebook_loss"], rtol=1e-4, atol=0
    )


HERE = Path(__file__).parent / "golden"
SPREAD = {"quantize": 0.5, "quant_conv": 4.0, "post_quant_conv": 1.0, "decoder": 0.12}
"""Standard deviations of random weights, by the first component of their names; 0.1 for all
others."""


@torch.no_grad()
def test_the_masked_autoencoder_equals_that_of_lidm() -> None:
    """An autoencoder with ``use_mask`` and attention in a level, against LiDM's code in float64."""
    with np.load(HERE / "lidm_vqvae_mask.npz") as file:
        values = dict(file)
    config = json.loads(str(values.pop("config")))
    shapes = json.loads(str(values.pop("shapes")))
    size = values.pop("size").tolist()
    random = np.random.RandomState(11)
    expected = {name: torch.from_numpy(value) for name, value in values.items()}
    weights = {
        key: torch.from_numpy(
            (random.standard_normal(shape) * SPREAD.get(key.split(".")[0], 0.1)).astype(
                np.float32
            )
        )
        for key, shape in shapes.items()
    }
    x = torch.from_numpy(random.uniform(-1, 1, (2, 1, *size)).astype(np.float32))
    part = codec_part(config, size, "")
    net = cast(VQVAE, convert(weights, {CODEC: part})[CODEC])
    assert (part.arguments["mask"], part.arguments["attention_levels"]) == (True, [2])
    latent = net.encode(x)
    assert distance(latent, expected["latent"]) < 1e-5
    quantised, index = net.codebook(latent)
    assert torch.equal(index.flatten(), expected["indices"])
    raw = net._decode(quantised)
    output = net.decode(latent)
    assert raw.shape == expected["raw"].shape == (2, 2, *size)
    assert distance(raw, expected["raw"]) < 1e-5
    # rounding can change the sign of the others
    sure = expected["raw"][:, 1:].abs() > 1e-3
    assert output.shape == (2, 1, *size)
    assert distance(output[sure], expected["output"][sure]) < 1e-5
    assert 0.3 < (output == -1).float().mean() < 0.7


@torch.no_grad()
def test_encoded_label_maps_equal_those_of_lidm(golden: Golden) -> None:
    """LiDM uses 0 for unlabelled and classes from 1; we use 255 and classes from 0."""
    about, tensors, weights = read_golden(golden, "lidm_spatial_rescaler")
    theirs = tensors["input.labels"]
    assert len(theirs.unique()) == about["config"]["in_channels"]
    labels = torch.where(theirs == 0, IGNORE, theirs.int() - 1).to(torch.uint8)
    arguments = {"resolution": [64, 256], "target": [16, 32], "channels": 8}
    encoder = convert(
        {COND_STAGE + k: v for k, v in weights.items()},
        {ENCODER: NetworkSpec("semantic_map", arguments)},
    )[ENCODER]
    assert encoder.halvings == [tuple(s) for s in about["config"]["strides"]]
    assert distance(encoder(labels), tensors["output"]) < tolerance(about["f32_vs_f64"])
