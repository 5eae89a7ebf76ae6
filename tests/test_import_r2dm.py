"""Import of R2DM's checkpoints: its network, its sampler, and invalid files."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from r2dm import GOLDEN, change, golden_weights, write_r2dm
from safetensors.torch import load_file
from torch import nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.checkpoint import VELOCITY
from lidar_synth.generate.flow.solvers import solve
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import build_network
from lidar_synth.lab.cli.import_ import import_
from lidar_synth.lab.importers.r2dm import cosine_grid, read_r2dm

EXPECTED = load_file(GOLDEN / "r2dm.safetensors")
SAMPLING = json.loads((GOLDEN / "r2dm.json").read_text())["sampling"]


def imported(tmp_path: Path, **groups: dict[str, Any]) -> nn.Module:
    path = write_r2dm(tmp_path / "r2dm.pth", cfg=change(**groups))
    return read_r2dm(path)[1][VELOCITY]


def test_the_network_is_r2dms(tmp_path: Path) -> None:
    found = imported(tmp_path).predict(EXPECTED["x"], EXPECTED["ratio"])
    torch.testing.assert_close(found, EXPECTED["prediction"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("predicts", ["eps", "v", "x_0"])
def test_euler_steps_are_those_of_its_sampler(tmp_path: Path, predicts: str) -> None:
    """Five points of its schedule; between them four steps of DDIM without noise."""
    network = imported(tmp_path, diffusion={"prediction_type": predicts}).double()
    network.angles.cells = network.angles.cells.double()
    low = math.atan(math.exp(-7.5))
    tangents = [math.tan(low + s * (math.pi / 2 - 2 * low)) for s in SAMPLING]
    grid = [x / (1 + x) for x in tangents]
    scale = [math.hypot(1 - t, t) for t in (grid[0], grid[-1])]
    y = EXPECTED["x"].double() * scale[0]
    for start, end in itertools.pairwise(grid):
        y = y + (end - start) * network(y, start)
    expected = EXPECTED[f"ddim.{predicts}"].double()
    torch.testing.assert_close(y / scale[1], expected, rtol=0, atol=5e-5)


def test_the_time_grid_is_that_of_its_schedule() -> None:
    grid = cosine_grid(256)
    assert len(grid) == 257 and (grid[0], grid[-1]) == (1.0, 0.0)
    assert all(a > b for a, b in itertools.pairwise(grid))
    assert grid[128] == pytest.approx(0.5)


def test_it_starts_as_far_as_noise_and_ends_at_its_estimate_of_the_data(
    tmp_path: Path,
) -> None:
    network = imported(tmp_path)
    noise = EXPECTED["x"]
    assert torch.isfinite(network(noise, 0.0)).all()
    data = solve(network, noise, [1.0, 0.0])
    assert data.abs().max() <= 1 + 1e-6


def test_an_imported_model_generates_scans(tmp_path: Path) -> None:
    path = write_r2dm(tmp_path / "r2dm.pth")
    out = tmp_path / "r2dm.safetensors"
    import_(path, out, peer="r2dm", check=True)
    generator = load_generator(out)
    header = generator.header
    assert header.channels == ("range", "reflectance")
    assert (header.sensor.shape, header.sensor.range_max) == ((16, 32), 80.0)
    assert header.normalisation.kind == "log"
    assert header.provenance["data"] == "KITTI-360" and header.provenance["seen"]
    [scan] = generator.scans(0, [0], steps=4)
    assert scan.sensor is not None and scan.sensor.shape == (16, 32)


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ({"model": {"architecture": "refinenet"}}, "refinenet"),
        ({"model": {"coords_encoding": "x"}}, "coords_encoding"),
        ({"diffusion": {"timestep_type": "discrete"}}, "discrete"),
        ({"diffusion": {"noise_schedule": "linear"}}, "linear"),
        ({"data": {"depth_format": "x"}}, "depth_format"),
        ({"data": {"dataset": "x"}}, "R2DM.s groups and keys"),
        ({"model": {"base_channels": 2**40}}, "the arguments of its class"),
        ({"model": {"base_channels": 8}}, "other shapes"),
        ({"model": {"num_residual_blocks": (1, 1, 1, 1)}}, "unexpected keys"),
        ({"model": {"num_residual_blocks": (1, 2, 1, 10**9)}}, "modules"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(
    tmp_path: Path, groups: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        imported(tmp_path, **groups)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("model.coords_encoding.freqs", None, "missing keys"),
        ("model.in_conv.weight", None, "missing keys"),
        ("model.more", torch.zeros(1), "unexpected keys"),
        ("model.u_block4.upsample.0.kernel", torch.ones(4), "kernel is"),
        ("model.d_block1.residual_blocks.0.scale", torch.tensor(1.0), "scale is"),
        ("model.coords_encoding.phase", torch.ones(9), "octaves"),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    tmp_path: Path, name: str, value: torch.Tensor | None, message: str
) -> None:
    weights = golden_weights()
    weights.pop(name, None)
    if value is not None:
        weights[name] = value
    with pytest.raises(DataError, match=message):
        read_r2dm(write_r2dm(tmp_path / "r2dm.pth", weights))


@pytest.mark.parametrize(
    "content",
    [{"cfg": {}}, [1], {"cfg": {}, "ema_weights": {}}, {"cfg": 1, "ema_weights": 1}],
)
def test_another_file_is_refused(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "other.pth")
    with pytest.raises(DataError):
        read_r2dm(tmp_path / "other.pth")


@pytest.mark.parametrize(
    "arguments",
    [
        {"predicts": "x"},
        {"position": "x"},
        {"multipliers": (1, 2)},
        {"resolution": (12, 32)},
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        build_network("efficient_unet", {"resolution": (16, 32), **arguments})
