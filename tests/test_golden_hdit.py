"""HDiT against golden results of R2Flow's own code with the same weights."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Golden
from safetensors.torch import load_file
from torch import Tensor

from lidar_synth.generate.checkpoint import NetworkSpec
from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.generate.models.positions import BASES, AnglePosition
from lidar_synth.lab.importers.r2flow import POSITIONS as PEER_POSITIONS, convert

pytestmark = pytest.mark.usefixtures("one_thread")


def distance(a: Tensor, b: Tensor) -> float:
    """Relative distance in the l2 norm."""
    return float((a - b).detach().norm() / b.norm())


def read_golden(folder: Path, name: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    return json.loads((folder / f"{name}.json").read_text()), load_file(
        folder / f"{name}.safetensors"
    )


def golden_network(folder: Path, name: str) -> tuple[HDiT, dict[str, Tensor], float]:
    """An imported golden network, its golden tensors, and their tolerance."""
    about, tensors = read_golden(folder, name)
    config = about["config"]
    arguments = {
        "resolution": config["resolution"],
        "channels": config["in_channels"],
        "width": config["base_channels"],
        "time_width": config["temb_channels"],
        "depths": config["num_residual_blocks"],
        "heads": config["attn_num_heads"],
        "position": PEER_POSITIONS[config["coords_encoding"]],
    }
    weights = {
        k.removeprefix("weights."): v
        for k, v in tensors.items()
        if k.startswith("weights.")
    }
    net = convert(weights, NetworkSpec("hdit", arguments))
    assert isinstance(net, HDiT)
    assert sum(p.numel() for p in net.parameters()) == about["parameters"]
    return net, tensors, about["sensitivity"]["suggested_rel_l2_tolerance"]


TINY = ("r2flow_hdit_tiny_learnable", "r2flow_hdit_tiny_fourier")


@pytest.mark.parametrize("grad", [False, True], ids=["inference", "training"])
@pytest.mark.parametrize("name", TINY)
def test_velocities_equal_those_of_r2flow(
    golden: Golden, name: str, grad: bool
) -> None:
    """v(y, t) = -u(1 - t, y): R2Flow's t = 0 is noise, and its velocity points to the data."""
    net, tensors, tolerance = golden_network(golden, name)
    with torch.set_grad_enabled(grad):
        assert (
            distance(
                -net(tensors["input.x"], 1 - tensors["input.t"]), tensors["output"]
            )
            < tolerance
        )
        one = -net(tensors["input.x"][:1], 1 - tensors["input.t_scalar"])
    assert distance(one, tensors["output_scalar_t"]) < tolerance


@pytest.mark.parametrize("name", TINY)
@torch.no_grad()
def test_intermediate_results_equal_those_of_r2flow(golden: Golden, name: str) -> None:
    net, tensors, tolerance = golden_network(golden, name)
    taps = {}
    net.down[0][-1].register_forward_hook(
        lambda _, __, out: taps.update(down_level_0=out)
    )
    net.middle[-1].register_forward_hook(lambda _, __, out: taps.update(mid=out))
    net.tokenize.register_forward_hook(lambda _, __, out: taps.update(tokens=out))
    net.time.register_forward_hook(lambda _, __, out: taps.update(time_embedding=out))
    net.position.register_forward_hook(
        lambda _, __, out: taps.update(spatial_embedding=out)
    )
    net(tensors["input.x"], 1 - tensors["input.t"])
    assert len(taps) == 5
    for tap, value in taps.items():
        expected = tensors[f"tap.{tap}"]
        assert distance(value.reshape(expected.shape), expected) < tolerance, tap


@pytest.mark.parametrize("name", TINY)
@torch.no_grad()
def test_sampled_states_equal_those_of_r2flow(golden: Golden, name: str) -> None:
    """Euler steps in our descending time reach the same states as R2Flow's."""
    net = golden_network(golden, name)[0]
    about, tensors = read_golden(golden, "r2flow_sampling")
    tolerance = max(1e-5, 20 * about["models"][name]["f32_vs_f64"]["rel_l2"])
    states = tensors[f"{name}/states"]
    velocities = tensors[f"{name}/velocities"]
    times = 1 - tensors[f"{name}/input.grid"]
    y = tensors[f"{name}/input.x0"]
    for i in range(len(times) - 1):
        v = net(y, times[i])
        assert distance(-v, velocities[i]) < tolerance
        y = y + (times[i + 1] - times[i]) * v
        assert distance(y, states[i + 1]) < tolerance
    assert distance(y, tensors[f"{name}/output"]) < tolerance


@pytest.mark.parametrize("grid", ["polar", "hdl64e"])
@pytest.mark.parametrize("basis", sorted(BASES))
@torch.no_grad()
def test_position_encodings_equal_those_of_r2flow(
    golden: Golden, basis: str, grid: str
) -> None:
    about, tensors = read_golden(golden, "r2flow_positions")
    config = about["config"]
    coords = tensors[f"input.coords_{grid}"][0]
    expected = tensors[f"basis.{basis}/{grid}"][0].movedim(0, -1)
    torch.testing.assert_close(BASES[basis](coords), expected, rtol=1e-5, atol=2e-6)
    position = AnglePosition(
        basis,
        config["resolution"],
        config["dim"],
        config["mlp_ratio"],
        config["mapping_depth"],
    )
    peer = f"weights.{basis}/spatial_pe."
    names = {"linear.weight": "0.linear.weight", "mapping.norms.0.weight": "1.0.scale"}
    names |= {"mapping.norms.3.weight": "1.3.scale"}
    for i in (1, 2):
        names[f"mapping.norms.{i}.weight"] = f"1.{i}.norm.scale"
        names[f"mapping.layers.{i - 1}.expand.weight"] = f"1.{i}.gegelu.weight"
        names[f"mapping.layers.{i - 1}.contract.weight"] = f"1.{i}.linear.weight"
    position.load_state_dict(
        {ours: tensors[peer + theirs] for ours, theirs in names.items()}
    )
    assert distance(position(coords), tensors[f"output.{basis}/{grid}"][0]) < 1e-5
