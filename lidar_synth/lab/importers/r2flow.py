"""R2Flow's released weights (https://github.com/kazuto1011/r2flow) as a checkpoint of this package.

R2Flow's network predicts u(s, x) = data - noise at s = 1 - t, so that ours is v(y, t) = -u(1 - t,
y). Both changes are linear and are folded into the weights::

    sign   the last layer is negated
    time   cos(2 pi f (1 - t)) = cos(2 pi f) cos(2 pi f t) + sin(2 pi f) sin(2 pi f t), and likewise
           the sine: the layer after the Fourier features of time absorbs this rotation

R2Flow stores the rotary harmonics in every block; here they are stored once per level.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from lidar_synth.datasets.recordings import KITTI360, KITTI360_SPLITS, all_frames
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import sha256
from lidar_synth.files.torch_files import load_pickle, state_of
from lidar_synth.generate.checkpoint import VELOCITY, Header, NetworkSpec
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.models import assemble
from lidar_synth.generate.models.positions import BASES, LEARNED
from lidar_synth.geometry import Sensor, presets
from lidar_synth.geometry.normalize import Normalisation

HEADS = (2, 4, 8, 16)
MAPPING_DEPTH = 2
"""These are fixed in R2Flow's loader and not part of its configuration, like patch, window and
ratio, whose values are our defaults."""

POSITIONS = {"learnable_embedding": LEARNED, **{name: name for name in BASES}}
NORMALISATIONS: dict[str, Literal["log", "linear", "inverse"]] = {
    "logscale": "log",
    "inverse": "inverse",
    "metric": "linear",
}
DATA = {
    "kitti_360": ("KITTI-360", "hdl64e_kitti360"),
    "kitti_raw": ("KITTI raw", "hdl64e_kitti"),
}
"""R2Flow's names of datasets: (name of the dataset, name of the sensor)."""

BLOCK = {
    "attention.temperature": "residual_attn.scale",
    "attention.norm.gain.weight": "residual_attn.norm.proj.0.weight",
    "attention.qkv.weight": "residual_attn.qkv_proj.weight",
    "attention.out.weight": "residual_attn.out_proj.weight",
    "feed_forward.norm.gain.weight": "residual_ffn.adarms.proj.0.weight",
    "feed_forward.layer.expand.weight": "residual_ffn.gegelu.weight",
    "feed_forward.layer.contract.weight": "residual_ffn.linear.weight",
}
"""Names inside a block: ours to R2Flow's."""
GROUPS = ("data", "flow", "training", "finetuning")
"""Groups of the configuration that tell the recipe."""
HARMONICS = ("residual_attn.rope.freqs_h", "residual_attn.rope.freqs_w")
FOURIER = ("spatial_pe.0.embedding.freqs", "spatial_pe.0.embedding.phase")


def read_r2flow(path: Path) -> tuple[Header, dict[str, nn.Module]]:
    """Read a released ``.pth`` as header and networks, ready for ``save_checkpoint``.

    Args:
        path: r2flow-kitti360-1rf.pth, -2rf.pth, or any checkpoint written by R2Flow's training.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a file that is not such a checkpoint, is truncated or contains code, or whose
            keys do not fit.
    """
    content = load_fields(path, "R2Flow", "weights")
    weights = state_of(content, "weights", path)
    with parsing(path, "R2Flow's groups and keys"):
        cfg = content["cfg"]
        data = cfg["data"]
        part = _network(data, cfg["model"], path)
        normalisation = _normalisation(data, path)
        header = Header(
            networks={VELOCITY: part},
            sensor=sensor_of(data),
            normalisation=normalisation,
            channels=("range", "reflectance")
            if data["train_reflectance"]
            else ("range",),
            time_grid=uniform_grid(
                cfg["finetuning"]["k_distil"] or cfg["flow"]["num_sampling_steps"]
            ),
            provenance={
                **describe_source(path, data["dataset"], "R2Flow"),
                "images": content.get("num_images"),
                "recipe": {group: cfg.get(group) for group in GROUPS},
            },
        )
        return header, {VELOCITY: convert(weights, part, str(path))}


def load_fields(path: Path, peer: str, weights: str) -> dict[str, Any]:
    """The content of a file of R2Flow or R2DM, with the configuration and the weights of this name;
    a DataError names the keys of another file."""
    content = load_pickle(path, peer)
    if not isinstance(content, dict) or not {"cfg", weights} <= set(content):
        given = (
            sorted(map(str, content))[:8]
            if isinstance(content, dict)
            else type(content).__name__
        )
        raise DataError(
            f"{path} holds {given}",
            f"{peer}'s dictionary with cfg and {weights} among its keys",
        )
    return content


def _network(
    data: Mapping[str, Any], model: Mapping[str, Any], path: Path
) -> NetworkSpec:
    if model["architecture"] != "nat_hdit":
        raise DataError(
            f"{path}: architecture {model['architecture']!r}", "nat_hdit, R2Flow's own"
        )
    if model["coords_encoding"] not in POSITIONS:
        raise DataError(
            f"{path}: coords_encoding {model['coords_encoding']!r}",
            f"one of {', '.join(POSITIONS)}",
        )
    arguments = {
        "resolution": list(data["resolution"]),
        "channels": 1 + bool(data["train_reflectance"]),
        "width": model["base_channels"],
        "time_width": model["temb_channels"],
        "depths": list(model["num_residual_blocks"]),
        "heads": list(HEADS),
        "mapping_depth": MAPPING_DEPTH,
        "position": POSITIONS[model["coords_encoding"]],
    }
    return NetworkSpec("hdit", arguments)


def _normalisation(data: Mapping[str, Any], path: Path) -> Normalisation:
    if data["data_format"] not in NORMALISATIONS:
        raise DataError(
            f"{path}: data_format {data['data_format']!r}",
            f"one of {', '.join(NORMALISATIONS)}",
        )
    return Normalisation(
        NORMALISATIONS[data["data_format"]], data["min_depth"], data["max_depth"]
    )


def sensor_of(data: Mapping[str, Any]) -> Sensor:
    """The HDL-64E on the grid of the network's training; R2DM's configuration has the same keys."""
    sensor = presets()[DATA[data["dataset"]][1]]
    if data["projection"].startswith("unfolding"):
        sensor = sensor.by_beams()
    rows, columns = data["resolution"]
    sensor = replace(
        sensor,
        columns=columns,
        range_min=data["min_depth"],
        range_max=data["max_depth"],
    )
    if rows != sensor.shape[0]:
        linear = {
            "rows": rows,
            "fov_up": sensor.up,
            "fov_down": sensor.down,
            "elevations": None,
        }
        sensor = replace(sensor, **linear, beams=None, heights=None, azimuths=None)
    return sensor


def describe_source(path: Path, dataset: str, peer: str) -> dict[str, Any]:
    """What a file of R2Flow or R2DM, which share their data and their author, learnt from."""
    # The split of KITTI raw is not published.
    known = all_frames(KITTI360, KITTI360_SPLITS["r2flow/train"] or ())
    seen = {"split": "r2flow/train", "seen": known.to_list()}
    return {
        "data": DATA[dataset][0],
        "data_licence": "CC BY-NC-SA 3.0",
        **(seen if dataset == "kitti_360" else {}),
        "licence": f"as {peer}'s repository: MIT",
        "source": f"https://github.com/kazuto1011/{peer.lower()}",
        "file": path.name,
        "file_sha256": sha256(path),
    }


def convert(
    weights: Mapping[str, Tensor], part: NetworkSpec, what: str = "R2Flow's weights"
) -> nn.Module:
    """Convert R2Flow's state dict to an ``HDiT`` in our convention.

    Args:
        weights: tensors by R2Flow's names.
        part: the network that they belong to.
        what: name of the weights in an error.

    Raises:
        DataError: on missing or unexpected keys, other shapes, or buffers with values that R2Flow
            never writes.
    """
    depths = part.arguments["depths"]
    position = part.arguments["position"]
    if sum(depths) > len(weights):
        raise DataError(
            f"{what}: {sum(depths)} blocks in {len(weights)} weights",
            "the weights of its configuration",
        )
    names = peer_names(depths, position)
    known = {
        *names.values(),
        *(
            f"{block}.{name}"
            for block in block_names(depths).values()
            for name in HARMONICS
        ),
    }
    known |= set(FOURIER) if position == "fourier_features" else set()
    missing = sorted(known - set(weights))
    unexpected = sorted(set(weights) - known)
    if missing or unexpected:
        raise DataError(
            f"{what}: missing keys {missing}, unexpected keys {unexpected}",
            "the keys of R2Flow's HDiT",
        )
    state = {ours: weights[theirs] for ours, theirs in names.items()}
    state["angles.cells"] = state["angles.cells"][0]
    state["tokenize.weight"] = state["tokenize.weight"].movedim(1, -1).flatten(1)
    state["detokenize.weight"] = -state["detokenize.weight"]
    state["time.linear.weight"] = _reverse_time(
        state["time.linear.weight"], state["time.features.frequencies"]
    )
    if position == LEARNED:
        state["position.table"] = state["position.table"][0]
    state |= _harmonics(weights, depths, what)
    if position == "fourier_features":
        stored, phase = (weights[name] for name in FOURIER)
        check_octaves(stored, phase, what)
    return assemble(*part, state, what)


def peer_names(depths: Sequence[int], position: str) -> dict[str, str]:
    """{our name: R2Flow's name} of all weights except the rotary harmonics."""
    names = {
        "angles.cells": "coords",
        "tokenize.weight": "tokenizer.0.weight",
        "norm.weight": "detokenizer.0.scale",
        "detokenize.weight": "detokenizer.1.weight",
        "time.features.frequencies": "timestep_pe.0.freqs",
        "time.linear.weight": "timestep_pe.0.linear.weight",
    }
    names |= _mapping_names("time.mapping", "timestep_pe.1")
    if position == LEARNED:
        names["position.table"] = "spatial_pe.embedding"
    else:
        names["position.linear.weight"] = "spatial_pe.0.linear.weight"
        names |= _mapping_names("position.mapping", "spatial_pe.1")
    for ours, theirs in block_names(depths).items():
        names |= {f"{ours}.{a}": f"{theirs}.{b}" for a, b in BLOCK.items()}
    for i in range(len(depths) - 1):
        names[f"merge.{i}.linear.weight"] = f"down_levels.merge_{i}.1.weight"
        names[f"expand.{i}.linear.weight"] = f"up_levels.expand_{i}.linear.weight"
        names[f"expand.{i}.mix"] = f"up_levels.expand_{i}.alpha"
    return names


def block_names(depths: Sequence[int]) -> dict[str, str]:
    """{our name: R2Flow's name} of every block."""
    *upper, middle = depths
    names = {f"middle.{j}": f"mid_levels.{j}" for j in range(middle)}
    for side in ("down", "up"):
        for i, depth in enumerate(upper):
            names |= {
                f"{side}.{i}.{j}": f"{side}_levels.level_{i}.{j}" for j in range(depth)
            }
    return names


def _mapping_names(ours: str, theirs: str) -> dict[str, str]:
    last = MAPPING_DEPTH + 1
    names = {f"{ours}.norms.{i}.weight": f"{theirs}.{i}.scale" for i in (0, last)}
    for i in range(1, last):
        names[f"{ours}.norms.{i}.weight"] = f"{theirs}.{i}.norm.scale"
        names[f"{ours}.layers.{i - 1}.expand.weight"] = f"{theirs}.{i}.gegelu.weight"
        names[f"{ours}.layers.{i - 1}.contract.weight"] = f"{theirs}.{i}.linear.weight"
    return names


def _reverse_time(weight: Tensor, frequencies: Tensor) -> Tensor:
    """Convert an (E, E) layer over cosines and sines of 2 pi f (1 - t) to one over those of 2 pi f
    t."""
    turn = 2 * math.pi * frequencies.double()
    cosine, sine = weight.double().chunk(2, 1)
    reverse = (
        cosine * turn.cos() + sine * turn.sin(),
        cosine * turn.sin() - sine * turn.cos(),
    )
    return torch.cat(reverse, 1).to(weight.dtype)


def _harmonics(
    weights: Mapping[str, Tensor], depths: Sequence[int], what: str
) -> dict[str, Tensor]:
    """The rotary harmonics of each level, (2, heads, D / 4), which all its blocks have to share."""
    state: dict[str, Tensor] = {}
    for ours, theirs in block_names(depths).items():
        level = len(depths) - 1 if ours.startswith("middle") else ours.split(".")[1]
        stored = torch.stack([weights[f"{theirs}.{name}"] for name in HARMONICS])
        if not torch.equal(
            state.setdefault(f"rotary.{level}.harmonics", stored), stored
        ):
            raise DataError(
                f"{what}: {theirs} has other rotary harmonics than its level",
                "the same harmonics in all blocks of a level",
            )
    return state


def check_octaves(stored: Tensor, phase: Tensor, what: str) -> None:
    """Check the octaves (K, 2, 1, 1) and phases (K,) of Fourier features, since ours are computed.

    Raises:
        DataError: on others.
    """
    rows = int((stored[:, 0] > 0).sum())
    octaves = torch.zeros(len(stored), 2)
    octaves[:rows, 0] = torch.arange(rows).exp2()
    octaves[rows:, 1] = torch.arange(len(stored) - rows).exp2()
    if phase.any() or not torch.equal(stored[..., 0, 0], octaves):
        raise DataError(
            f"{what}: Fourier features other than octaves of the angles",
            "those of R2Flow's and R2DM's encoding",
        )
