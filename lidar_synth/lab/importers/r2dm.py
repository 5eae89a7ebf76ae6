"""R2DM's released weights (https://github.com/kazuto1011/r2dm) as a checkpoint of this package.

R2DM is a continuous-time diffusion model; ``models.efficient_unet`` converts what its network
predicts to the velocity of a rectified flow, so that it can be sampled and distilled without
training. The averaged weights are taken. Buffers that follow from the configuration (the taps of
the resampling, the factors of the residuals, the octaves of the position features) are checked and
left out.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.torch_files import state_of
from lidar_synth.generate.checkpoint import VELOCITY, Header, NetworkSpec
from lidar_synth.generate.models import assemble
from lidar_synth.generate.models.efficient_unet import LIMIT, PREDICTIONS
from lidar_synth.generate.models.positions import BASES
from lidar_synth.geometry.normalize import Normalisation
from lidar_synth.lab.importers.r2flow import (
    check_octaves,
    describe_source,
    load_fields,
    sensor_of,
)

STEPS = 256
"""Steps of the checkpoint's time grid."""
LIMITS = {"min_depth": 1.45, "max_depth": 80.0}
"""Metres; constants of R2DM's data, which its configuration does not repeat."""
NORMALISATIONS: dict[str, Literal["log", "linear", "inverse"]] = {
    "log_depth": "log",
    "inverse_depth": "inverse",
    "depth": "linear",
}
SUPPORTED = {
    ("model", "architecture"): ("efficient_unet",),
    ("model", "coords_encoding"): (None, *BASES),
    ("diffusion", "timestep_type"): ("continuous",),
    ("diffusion", "noise_schedule"): ("cosine",),
    ("diffusion", "prediction_type"): PREDICTIONS,
    ("data", "train_depth"): (True,),
    ("data", "depth_format"): tuple(NORMALISATIONS),
}
"""{(group, key): values} of the configurations that can be read."""

_TAPS = torch.tensor([1.0, 3.0, 3.0, 1.0])
BUFFERS = {
    r"\.scale": torch.tensor(math.sqrt(0.5)),
    r"\.downsample\.1\.kernel": _TAPS / 8,
    r"\.upsample\.0\.kernel": _TAPS / 4,
}
"""Values of the buffers whose names end so."""
OCTAVES = ("coords_encoding.freqs", "coords_encoding.phase")
NAMES = {
    r"coords$": "angles.cells",
    r"time_embedding\.1": "embed.0",
    r"time_embedding\.3": "embed.2",
    r"in_conv": "enter",
    r"out_conv": "leave",
    r"downsample\.0": "before",
    r"upsample\.1": "after",
    r"residual_blocks": "blocks",
    r"norm2\.proj\.1": "gain",
    r"skip": "shortcut",
    r"self_attn_block\.norm": "attention.norm",
    r"self_attn_block\.attn\.in_proj_": "attention.qkv.",
    r"self_attn_block\.attn\.out_proj": "attention.out",
}
"""Parts of names: R2DM's to ours."""


def read_r2dm(path: Path) -> tuple[Header, dict[str, nn.Module]]:
    """Read a released ``.pth`` as header and networks, ready for ``save_checkpoint``.

    Args:
        path: r2dm.pth, or any checkpoint that R2DM's training wrote.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a file that is not such a checkpoint, is truncated or contains code, or whose
            keys do not fit.
    """
    content = load_fields(path, "R2DM", "ema_weights")
    with parsing(path, "R2DM's groups and keys"):
        cfg = content["cfg"]
        for (group, key), values in SUPPORTED.items():
            if cfg[group][key] not in values:
                raise DataError(
                    f"{path}: {group}.{key} {cfg[group][key]!r}",
                    f"one of {', '.join(map(str, values))}",
                )
        data = {**cfg["data"], **LIMITS}
        part = _network(data, cfg["model"], cfg["diffusion"]["prediction_type"])
        header = Header(
            networks={VELOCITY: part},
            sensor=sensor_of(data),
            normalisation=Normalisation(
                NORMALISATIONS[data["depth_format"]], *LIMITS.values()
            ),
            channels=("range", "reflectance")[: part.arguments["channels"]],
            time_grid=cosine_grid(STEPS),
            provenance={
                **describe_source(path, data["dataset"], "R2DM"),
                "steps": content.get("global_step"),
                "recipe": {name: cfg.get(name) for name in ("data", "diffusion")},
            },
        )
        weights = state_of(content, "ema_weights", path)
        return header, {VELOCITY: convert_r2dm(weights, part, str(path))}


def _network(
    data: Mapping[str, Any], model: Mapping[str, Any], predicts: str
) -> NetworkSpec:
    arguments = {
        "resolution": list(data["resolution"]),
        "channels": 1 + bool(data["train_reflectance"]),
        "width": model["base_channels"],
        "time_width": model["temb_channels"] or 4 * model["base_channels"],
        "multipliers": list(model["channel_multiplier"]),
        "blocks": list(model["num_residual_blocks"]),
        "groups": model["gn_num_groups"],
        "heads": model["attn_num_heads"],
        "position": model["coords_encoding"],
        "predicts": predicts,
    }
    return NetworkSpec("efficient_unet", arguments)


def _drop_octaves(named: dict[str, Tensor], what: str) -> None:
    """Check the octaves of the Fourier features, which our networks do not store."""
    lost = [name for name in OCTAVES if name not in named]
    if lost:
        raise DataError(f"{what}: missing keys {lost}", "the keys of R2DM's U-Net")
    stored, phase = (named.pop(name) for name in OCTAVES)
    check_octaves(stored, phase, what)


def convert_r2dm(
    weights: Mapping[str, Tensor], part: NetworkSpec, what: str = "R2DM's weights"
) -> nn.Module:
    """Convert R2DM's state dict to an ``EfficientUNet``.

    Args:
        weights: tensors by R2DM's names.
        part: the network that they belong to.
        what: name of the weights in an error.

    Raises:
        DataError: on missing or unexpected keys, other shapes, or buffers with values that R2DM
            never writes.
    """
    state = {}
    named = {name.removeprefix("model."): value for name, value in weights.items()}
    named.pop("_dummy", None)
    if part.arguments["position"] == "fourier_features":
        _drop_octaves(named, what)
    for name, value in named.items():
        known = next(
            (v for end, v in BUFFERS.items() if re.search(f"{end}$", name)), None
        )
        if known is None:
            state[our_name(name, len(part.arguments["blocks"]))] = value
        elif value.shape != known.shape or not torch.allclose(value.float(), known):
            raise DataError(f"{what}: {name} is {value.tolist()}", f"{known.tolist()}")
    if "angles.cells" in state:
        state["angles.cells"] = state["angles.cells"].squeeze(0)
    return assemble(*part, state, what)


def our_name(name: str, levels: int) -> str:
    """Our name of a weight, without R2DM's prefix ``model.``."""
    for theirs, ours in NAMES.items():
        name = re.sub(rf"(^|\.){theirs}", rf"\1{ours}", name)
    name = re.sub(r"^d_block(\d)", lambda m: f"down.{int(m[1]) - 1}", name)
    return re.sub(r"^u_block(\d)", lambda m: f"up.{levels - int(m[1])}", name)


def cosine_grid(steps: int) -> tuple[float, ...]:
    """The times of R2DM's sampler: its cosine schedule at evenly spaced points, from 1 to 0."""
    low = math.atan(math.exp(-LIMIT / 2))
    high = math.atan(math.exp(LIMIT / 2))
    ratios = [math.tan(low + i / steps * (high - low)) for i in range(1, steps)]
    return (1.0, *(r / (1 + r) for r in reversed(ratios)), 0.0)
