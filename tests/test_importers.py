"""Import of R2Flow's checkpoints: keys, conventions, and invalid files."""

import copy
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Golden
from fuzzing.text import edit
from PIL import Image
from releases import CFG, DEPTHS, peer_weights, write_r2flow
from safetensors.torch import load_file
from torch import Tensor
from typer.testing import CliRunner

from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.lab.importers.r2flow import convert, read_r2flow


@pytest.fixture
def released(tmp_path: Path) -> Path:
    return write_r2flow(tmp_path / "r2flow-kitti360-1rf.pth", peer_weights())


def change(**groups: dict[str, Any]) -> dict[str, Any]:
    """The configuration with some of its values replaced."""
    cfg = copy.deepcopy(CFG)
    for group, values in groups.items():
        cfg[group] |= values
    return cfg


def test_the_header_describes_the_model_of_r2flow(released: Path) -> None:
    header, _ = read_r2flow(released)
    assert header.channels == ("range", "reflectance")
    assert (
        header.normalisation.kind,
        header.normalisation.range_min,
        header.normalisation.range_max,
    ) == (
        "log",
        1.45,
        80.0,
    )
    assert header.sensor.shape == (64, 64)
    assert (header.sensor.up, header.sensor.down) == (3.0, -25.0)
    assert len(header.time_grid) == 33
    assert header.provenance["data"] == "KITTI-360"
    assert header.provenance["images"] == 96
    [seen] = header.provenance["seen"]
    assert (seen["dataset"], [drive[-9:-5] for drive in seen["drives"]]) == (
        "KITTI-360",
        ["0003", "0004", "0005", "0006", "0007", "0009", "0010"],
    )
    json.dumps(header.to_dict())


@pytest.mark.parametrize(
    ("cfg", "expected"),
    [
        (
            change(finetuning={"k_distil": 4}),
            {"time_grid": (1.0, 0.75, 0.5, 0.25, 0.0)},
        ),
        (
            change(data={"dataset": "kitti_raw"}),
            {"sensor.name": "hdl64e_kitti", "provenance": {"split": None}},
        ),
        (change(data={"data_format": "metric"}), {"normalisation.kind": "linear"}),
        (
            change(data={"projection": "unfolding-1024"}),
            {"sensor.name": "hdl64e_kitti360/beams"},
        ),
    ],
    ids=["distilled", "kitti raw", "metric", "unfolded"],
)
def test_other_configurations_are_imported(
    tmp_path: Path, cfg: dict[str, Any], expected: dict[str, Any]
) -> None:
    header, _ = read_r2flow(write_r2flow(tmp_path / "other.pth", peer_weights(), cfg))
    for name, value in expected.items():
        found: Any = header
        for part in name.split("."):
            found = getattr(found, part)
        if isinstance(found, dict):
            found = {key: found.get(key) for key in value}
        assert found == value


@torch.no_grad()
def test_time_and_sign_are_folded_into_the_weights(released: Path) -> None:
    weights = peer_weights()
    net = read_r2flow(released)[1][VELOCITY]
    assert isinstance(net, HDiT)
    for t in (0.0, 0.3, 1.0):
        turn = 2 * math.pi * weights["timestep_pe.0.freqs"].double() * (1 - t)
        features = torch.cat((turn.cos(), turn.sin())).float()
        expected = net.time.mapping(features @ weights["timestep_pe.0.linear.weight"].T)
        torch.testing.assert_close(
            net.time(torch.tensor([t]))[0], expected, rtol=1e-4, atol=1e-4
        )
    assert torch.equal(net.detokenize.weight, -weights["detokenizer.1.weight"])


def test_all_keys_of_the_released_network_are_imported(
    golden: Golden, tmp_path: Path
) -> None:
    """80.9 M parameters by name and shape; each tensor is one expanded number, so that the file
    stays small."""
    published = json.loads((golden / "r2flow_hdit_full_keys.json").read_text())
    weights = {
        key: torch.zeros(1).expand(shape) for key, shape, _, _ in published["keys"]
    }
    path = write_r2flow(
        tmp_path / "full.pth", weights, published["checkpoint"]["cfg_defaults"]
    )
    assert path.stat().st_size < 1 << 20
    header, networks = read_r2flow(path)
    assert (
        sum(p.numel() for p in networks[VELOCITY].parameters())
        == published["parameters"]
    )
    assert header.sensor.name == "hdl64e_kitti360"
    assert header.sensor.shape == (64, 1024)


def test_an_imported_checkpoint_gives_the_results_of_r2flow(
    golden: Golden, tmp_path: Path
) -> None:
    """.pth -> import -> checkpoint -> network gives R2Flow's own results."""
    name = "r2flow_hdit_tiny_learnable"
    about = json.loads((golden / f"{name}.json").read_text())
    tensors = load_file(golden / f"{name}.safetensors")
    config = about["config"]
    weights = {
        k.removeprefix("weights."): v
        for k, v in tensors.items()
        if k.startswith("weights.")
    }
    model = {
        key: config[key]
        for key in (
            "base_channels",
            "temb_channels",
            "num_residual_blocks",
            "coords_encoding",
        )
    }
    path = write_r2flow(
        tmp_path / "tiny.pth",
        weights,
        change(data={"resolution": config["resolution"]}, model=model),
    )
    out = tmp_path / "tiny.safetensors"
    result = run_import(path, out)
    assert result.exit_code == 0, result.output
    header, networks, digest = load_checkpoint(out)
    assert digest in result.output
    assert header.sensor.shape == (16, 128)
    with torch.no_grad():
        velocity = -networks[VELOCITY](tensors["input.x"], 1 - tensors["input.t"])
    error = float((velocity - tensors["output"]).norm() / tensors["output"].norm())
    assert error < about["sensitivity"]["suggested_rel_l2_tolerance"]


def run_import(path: Path, out: Path, *options: str) -> Any:
    import typer

    from lidar_synth.lab.cli.import_ import import_

    app = typer.Typer()
    app.command()(import_)
    return CliRunner().invoke(app, [str(path), str(out), *options])


def test_the_command_refuses_unknown_peers(released: Path, tmp_path: Path) -> None:
    result = run_import(released, tmp_path / "out.safetensors", "--peer", "nobody")
    assert isinstance(result.exception, ConfigError)
    assert "one of 'r2flow'" in str(result.exception)
    assert not (tmp_path / "out.safetensors").exists()


def test_a_condition_is_of_the_check(released: Path, tmp_path: Path) -> None:
    result = run_import(released, tmp_path / "out.safetensors", "--condition", "KITTI")
    assert "--condition KITTI without --check" in str(result.exception)


def test_imported_weights_are_looked_at(released: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    result = run_import(released, out, "--check")
    assert result.exit_code == 0, result.output
    images = load_generator(out).range_images(0, range(4), steps=10)
    filled = np.mean([image.mask.mean() for image in images])
    assert f"4 scans of 10 steps: {100 * filled:.1f} % of the cells" in result.output
    shares = re.findall(r" to +[\d.]+ +([\d.]+) ?#*$", result.output, re.M)
    ranges = np.concatenate([image.range[image.mask] for image in images])
    first = np.mean(ranges < 1.45 * (80 / 1.45) ** (1 / 8))
    assert float(shares[0]) == pytest.approx(100 * first, abs=0.06)
    assert sum(map(float, shares)) == pytest.approx(100, abs=0.5)
    with Image.open(out.with_suffix(".png")) as picture:
        assert min(picture.size) > 100


# --- invalid files
# -------------------------------------------------------------------------------------------------


def drop(weights: dict[str, Tensor]) -> None:
    del weights["up_levels.expand_1.alpha"]


def add(weights: dict[str, Tensor]) -> None:
    weights["label_head.weight"] = torch.zeros(2)


def reshape(weights: dict[str, Tensor]) -> None:
    weights["detokenizer.0.scale"] = torch.zeros(8)


def retune(weights: dict[str, Tensor]) -> None:
    weights["up_levels.level_0.0.residual_attn.rope.freqs_w"] = torch.ones(2, 2)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (drop, r"missing keys \['up_levels.expand_1.alpha'\], unexpected keys \[\]"),
        (add, r"missing keys \[\], unexpected keys \['label_head.weight'\]"),
        (reshape, r"other shapes: norm.weight \(8,\) for \(16,\)"),
        (retune, "up_levels.level_0.0 has other rotary harmonics"),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    tmp_path: Path, spoil: Callable[[dict[str, Tensor]], None], message: str
) -> None:
    weights = peer_weights()
    spoil(weights)
    path = write_r2flow(tmp_path / "other.pth", weights)
    with pytest.raises(DataError, match=message) as caught:
        read_r2flow(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (change(model={"architecture": "adm_unet"}), "'adm_unet'.*expected nat_hdit"),
        (change(model={"coords_encoding": None}), "coords_encoding None"),
        (change(data={"data_format": "cartesian"}), "'cartesian'.*one of logscale"),
        (change(data={"dataset": "nuscenes"}), "'nuscenes'"),
        (change(data={"resolution": [64, 72]}), "resolution"),
        ({"data": CFG["data"]}, "KeyError: 'model'"),
        (change(data={"min_depth": 90.0}), "range limits 90"),
    ],
    ids=[
        "architecture",
        "position",
        "format",
        "dataset",
        "resolution",
        "groups",
        "limits",
    ],
)
def test_configurations_that_do_not_fit_are_refused(
    tmp_path: Path, cfg: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        read_r2flow(write_r2flow(tmp_path / "other.pth", peer_weights(), cfg))


def test_fourier_features_other_than_octaves_are_refused() -> None:
    from lidar_synth.generate.checkpoint import NetworkSpec

    weights = peer_weights("fourier_features")
    octaves = torch.tensor(
        [[2.0**i, 0.0] for i in range(6)] + [[0.0, 2.0**i] for i in range(4)]
    )
    weights["spatial_pe.0.embedding.freqs"] = octaves[..., None, None]
    weights["spatial_pe.0.embedding.phase"] = torch.zeros(10)
    arguments = {
        "resolution": [64, 64],
        "width": 16,
        "time_width": 16,
        "depths": list(DEPTHS),
        "position": "fourier_features",
    }
    convert(weights, NetworkSpec("hdit", arguments))
    weights["spatial_pe.0.embedding.phase"][2] = 0.5
    with pytest.raises(DataError, match="octaves"):
        convert(weights, NetworkSpec("hdit", arguments))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_a_truncated_file_is_refused(released: Path, share: float) -> None:
    content = released.read_bytes()
    released.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match="is truncated, damaged or no .pth file"):
        read_r2flow(released)


@pytest.mark.parametrize(
    "content",
    [
        [1, 2],
        {"state_dict": {}},
        {"cfg": CFG},
        {"cfg": CFG, "weights": [1]},
        {"cfg": CFG, "weights": {"coords": 1}},
        {"cfg": CFG, "weights": {"coords": print}},
    ],
    ids=["list", "other", "no weights", "list of weights", "numbers", "code"],
)
def test_a_pickle_of_something_else_is_refused(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"cfg and weights|not tensors by name"):
        read_r2flow(tmp_path / "other.pth")


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be read"):
        read_r2flow(tmp_path / "none.pth")


def test_mutated_configurations_give_no_foreign_error(tmp_path: Path) -> None:
    rng = Random(0)
    refused = 0
    weights = peer_weights()
    for _ in range(60):
        cfg = copy.deepcopy(CFG)
        edit(cfg, rng)
        try:
            read_r2flow(write_r2flow(tmp_path / "a.pth", weights, cfg))
        except LidarSynthError:
            refused += 1
    assert refused > 10


def test_a_hostile_number_of_blocks_is_refused_soon(tmp_path: Path) -> None:
    cfg = change(model={"num_residual_blocks": [2**31 - 1, 1, 1, 1]})
    with pytest.raises(DataError, match="blocks in"):
        read_r2flow(write_r2flow(tmp_path / "a.pth", peer_weights(), cfg))
