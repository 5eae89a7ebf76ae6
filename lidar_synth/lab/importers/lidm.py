"""LiDM's released weights (https://github.com/hancyran/LiDAR-Diffusion) as checkpoints of this
package.

A release is a folder with ``model.ckpt`` and its ``config.yaml``. Two kinds are supported:

    first stage     an autoencoder: one part, the codec; weights under ``loss.`` belong to its
        training and are skipped
    diffusion       ``model.diffusion_model.`` the U-Net, ``first_stage_model.`` the autoencoder,
                    ``cond_stage_model.`` the condition's encoder, ``model_ema.`` the U-Net's
                    averaged weights (by names without dots), which are preferred; the tensors of
                    the schedule are checked and recomputed

LiDM's U-Net predicts the noise of a diffusion step; ``models.lidm.diffusion`` converts it to the
velocity of a rectified flow, so that it can be sampled and distilled without training. The file of
a camera model repeats the frozen CLIP weights, which are skipped (see
``models.encoders.clip_views``). LiDM's label maps use 0 for "unlabelled" and number the classes
from 1; the weights are permuted to our order.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lidar_synth.datasets.classes import NAMES
from lidar_synth.datasets.recordings import (
    KITTI360,
    KITTI360_SPLITS,
    Recordings,
    all_frames,
    frames_of,
)
from lidar_synth.errors import ConfigError, DataError, parsing
from lidar_synth.files.disk import sha256
from lidar_synth.files.parsing import read_yaml
from lidar_synth.files.torch_files import load_pickle, state_of
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Header,
    NetworkSpec,
)
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.models import assemble
from lidar_synth.generate.models.lidm.diffusion import schedule_times
from lidar_synth.geometry import Sensor, presets
from lidar_synth.geometry.normalize import Normalisation
from lidar_synth.lab.importers.lidm_names import COND_STAGE, UNET, UNET_EMA, peer_names

STEPS = 50
"""Steps of the checkpoint's uniform time grid: LiDM samples in 50."""
CAMERA_SIZE = (376, 1408)
"""Rows and columns of KITTI-360's rectified images, which LiDM cuts into views."""
SOURCE = "https://github.com/hancyran/LiDAR-Diffusion"
IMAGES = "KITTI-360 and KITTI odometry"
_LABELLED = ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10")
SEEN = {
    "SemanticKITTI": frames_of("semantic_kitti", _LABELLED),
    "KITTI-360": all_frames(KITTI360, KITTI360_SPLITS["lidm/train"] or ()),
    IMAGES: all_frames(KITTI360, KITTI360_SPLITS["lidm/train"] or ())
    | frames_of("semantic_kitti", (*_LABELLED, *map(str, range(11, 22)))),
}
"""LiDM's training data by the name under ``data`` of a provenance (from its lidm/data/kitti.py).
All of its autoencoders are trained on range images of both datasets, including the test sequences
of the odometry benchmark."""
OFFSET = 1.0001
"""LiDM's logarithmic scale is log2(d + 0.0001 + 1)."""


def read_lidm(path: Path) -> tuple[Header, dict[str, nn.Module]]:
    """Read a released ``model.ckpt`` and the ``config.yaml`` in its folder as header and networks
    for ``save_checkpoint``.

    Raises:
        FileError: if one of the two files cannot be read.
        DataError: on a file that is not such a checkpoint, is truncated or contains code, or whose
            keys or configuration do not fit.
    """
    config = _config(path.with_name("config.yaml"))
    content = load_pickle(path, "LiDM")
    if not isinstance(content, dict) or not content:
        raise DataError(
            f"{path} holds {type(content).__name__}",
            "LiDM's dictionary with state_dict among its keys, or a state dictionary",
        )
    weights = {
        k: v
        for k, v in state_of(content, "state_dict", path).items()
        if not k.startswith("loss.")
    }
    with parsing(path, "LiDM's own config.yaml"):
        model = config["model"]["params"]
        data = config["data"]["params"]
        parts, conditioning = _parts(
            model, data["dataset"], data.get("aug") or {}, path
        )
        header = Header(
            networks=parts,
            sensor=_sensor(data),
            normalisation=_normalisation(data["dataset"]),
            channels=("range",),
            time_grid=uniform_grid(STEPS if VELOCITY in parts else 1),
            provenance=_provenance(config, path),
            conditioning=conditioning,
        )
        return header, convert(weights, parts, str(path))


def _config(path: Path) -> dict[str, Any]:
    try:
        config = read_yaml(path, "the config.yaml that LiDM releases with its weights")
    except ConfigError as error:
        raise DataError(
            str(error), "the config.yaml that LiDM releases with its weights"
        ) from error
    if not isinstance(config, dict):
        raise DataError(
            f"{path} holds {type(config).__name__}",
            "the config.yaml that LiDM releases with its weights",
        )
    return config


def _parts(
    model: Mapping[str, Any],
    dataset: Mapping[str, Any],
    augment: Mapping[str, Any],
    path: Path,
) -> tuple[dict[str, NetworkSpec], dict[str, Any]]:
    """The networks of a configuration, and the options of its condition."""
    if "ddconfig" in model:
        return {CODEC: codec_part(model, dataset["size"], path)}, {}
    codec = codec_part(model["first_stage_config"]["params"], dataset["size"], path)
    unet = unet_part(model["unet_config"]["params"], path)
    unet.arguments.update(
        beta_start=model["linear_start"],
        beta_end=model["linear_end"],
        steps=model.get("timesteps", 1000),
    )
    parts = {VELOCITY: unet, CODEC: codec}
    condition = model.get("cond_stage_config") or {}
    if not isinstance(condition, dict):  # a string that stands for no condition
        condition = {}
    kind = condition.get("target", "").rpartition(".")[2]
    if kind == "SpatialRescaler":
        channels = condition["params"]["out_channels"]
        unet.arguments.update(
            channels=unet.arguments["channels"] - channels, condition_channels=channels
        )
        sizes = {
            "resolution": list(dataset["size"]),
            "target": unet.arguments["resolution"],
        }
        return parts | {
            ENCODER: NetworkSpec("semantic_map", sizes | {"channels": channels})
        }, {"semantic": {"dropout": 0.0, "keep_gaps": True}}
    if kind == "FrozenClipMultiImageEmbedder":
        given = condition["params"]
        arguments = {
            "views": given["split_per_view"],
            "channels": given.get("out_dim", 512),
        }
        options = {
            "dropout": 0.0,
            "view_dropout": augment.get("camera_drop", 0.0),
            "image": list(CAMERA_SIZE),
            "views": given["split_per_view"],
        }
        return parts | {ENCODER: NetworkSpec("clip_views", arguments)}, {
            "camera": options
        }
    if kind:
        raise DataError(
            f"{path}: a condition encoded by {kind}",
            "label maps (SpatialRescaler), camera images (FrozenClipMultiImageEmbedder) or no "
            "condition",
        )
    return parts, {}


def codec_part(
    params: Mapping[str, Any], size: list[int], path: Path | str
) -> NetworkSpec:
    """The autoencoder of LiDM's configuration, for images of ``size`` rows and columns."""
    inner = params["ddconfig"]
    mask = bool(params.get("use_mask"))
    wanted = {
        "double_z": False,
        "z_channels": params["embed_dim"],
        "out_ch": inner["in_channels"] + mask,
    }
    unsupported = {
        key: inner.get(key) for key, value in wanted.items() if inner.get(key) != value
    }
    if unsupported or params.get("lib_name") != "lidm":
        raise DataError(
            f"{path}: an autoencoder with {unsupported or dict(params)}",
            "one of LiDM's published configurations",
        )
    # LiDM ignores attention levels that do not exist.
    attends = sorted(set(inner["attn_levels"]) & set(range(len(inner["ch_mult"]))))
    extra: dict[str, Any] = ({"attention_levels": attends} if attends else {}) | (
        {"mask": True} if mask else {}
    )
    return NetworkSpec(
        "vqvae",
        {
            "resolution": list(size),
            "channels": inner["in_channels"],
            "latent_channels": params["embed_dim"],
            "codes": params["n_embed"],
            "width": inner["ch"],
            "multipliers": list(inner["ch_mult"]),
            "strides": [list(s) for s in inner["strides"]],
            "blocks": inner["num_res_blocks"],
        }
        | extra,
    )


def unet_part(params: Mapping[str, Any], path: Path | str) -> NetworkSpec:
    """The U-Net of LiDM's configuration; ``channels`` includes those of a condition that is
    concatenated with the state."""
    levels = [1 << i for i in range(len(params["channel_mult"]))]
    if params.get("lib_name") != "lidm" or not set(
        params["attention_resolutions"]
    ) <= set(levels):
        raise DataError(
            f"{path}: a U-Net with {dict(params)}",
            "one of LiDM's published configurations",
        )
    return NetworkSpec(
        "diffusion_unet",
        {
            "resolution": list(params["image_size"]),
            "channels": params["in_channels"],
            "context_channels": params.get("context_dim") or 0,
            "width": params["model_channels"],
            "multipliers": list(params["channel_mult"]),
            "blocks": params["num_res_blocks"],
            "attention": [
                i for i, d in enumerate(levels) if d in params["attention_resolutions"]
            ],
            "head_channels": params["num_head_channels"],
            "position": False,
        },
    )


def _normalisation(dataset: Mapping[str, Any]) -> Normalisation:
    low, high = dataset["depth_range"]
    scale = float(dataset["depth_scale"])
    # Older configurations do not state the scale, which was then logarithmic, log2(range + 1).
    if dataset.get("log_scale", scale < 2 * math.log2(high + 1)):
        return Normalisation("log", low, high, scale, OFFSET)
    return Normalisation("linear", low, high, scale)


def _sensor(data: Mapping[str, Any]) -> Sensor:
    """The HDL-64E of the dataset, with the range limits of the training."""
    dataset = data["dataset"]
    sensor = presets()["hdl64e_kitti" if _semantic_kitti(data) else "hdl64e_kitti360"]
    low, high = dataset["depth_range"]
    sensor = replace(sensor, range_min=float(low), range_max=float(high))
    rows, columns = dataset["size"]
    up, down = dataset["fov"]
    if (rows, columns, up, down) == (*sensor.shape, sensor.up, sensor.down):
        return sensor
    return Sensor(
        "lidm",
        columns,
        float(low),
        float(high),
        rows=rows,
        fov_up=float(up),
        fov_down=float(down),
    )


def _semantic_kitti(data: Mapping[str, Any]) -> bool:
    return _data(data["train"]) == "SemanticKITTI"


def _data(train: Mapping[str, Any]) -> str:
    """The key of ``SEEN`` for a configuration's training data."""
    if "SemanticKITTI" in train["target"]:
        return "SemanticKITTI"
    return IMAGES if "KITTIImage" in train["target"] else "KITTI-360"


def seen(data: str, generates: bool) -> Recordings:
    """The recordings that weights were trained on.

    Args:
        data: a key of ``SEEN``; the recordings of other data are unknown.
        generates: whether the weights are those of a diffusion model, whose autoencoder was trained
            on ``IMAGES``.
    """
    return SEEN.get(data, Recordings()) | (SEEN[IMAGES] if generates else Recordings())


def _provenance(config: Mapping[str, Any], path: Path) -> dict[str, Any]:
    name = _data(config["data"]["params"]["train"])
    return {
        "data": name,
        "data_licence": "CC BY-NC-SA 3.0",
        "split": "lidm/train",
        "seen": seen(
            name, generates="ddconfig" not in config["model"]["params"]
        ).to_list(),
        "licence": "as LiDM's repository: MIT",
        "source": SOURCE,
        "file": path.name,
        "file_sha256": sha256(path),
        "recipe": config["model"],
    }


def convert(
    weights: Mapping[str, Tensor],
    parts: Mapping[str, NetworkSpec],
    what: str = "LiDM's weights",
) -> dict[str, nn.Module]:
    """Convert LiDM's state dict to our networks.

    Args:
        weights: tensors by LiDM's names, with the prefixes of a diffusion model if it is one.
        parts: the networks that they belong to.
        what: name of the weights in an error.

    Raises:
        DataError: on missing or unexpected keys, other shapes, or another noise schedule than the
            part's.
    """
    weights = dict(weights)
    nested = set(parts) != {CODEC}
    if VELOCITY in parts:
        _check_schedule(weights, parts[VELOCITY].arguments, what)
        weights = _averaged(weights)
    sources = {name: peer_names(name, part, nested) for name, part in parts.items()}
    known = {
        theirs
        for names in sources.values()
        for some in names.values()
        for theirs in some
    }
    missing = sorted(known - set(weights))
    unexpected = sorted(k for k in set(weights) - known if not _frozen(k))
    if missing or unexpected:
        raise DataError(
            f"{what}: missing keys {missing}, unexpected keys {unexpected}",
            "the keys of LiDM's networks",
        )
    networks = {}
    for name, part in parts.items():
        state = _statistics(part) if name == CODEC else {}
        for ours, theirs in sources[name].items():
            tensor = (
                torch.cat([weights[t] for t in theirs])
                if len(theirs) > 1
                else weights[theirs[0]]
            )
            state[ours] = _arranged(ours, tensor, part)
        networks[name] = assemble(*part, state, f"{what}: {name}")
    return networks


def _statistics(part: NetworkSpec) -> dict[str, Tensor]:
    """Buffers for latents that are not normalised."""
    size = part.arguments["latent_channels"]
    return {
        "shift": torch.zeros(size),
        "scale": torch.ones(size),
    }


def _frozen(key: str) -> bool:
    return key.startswith(f"{COND_STAGE}model.")


def _averaged(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights without the schedule, and with the averaged U-Net instead of the last one."""
    plain = {
        k: v
        for k, v in weights.items()
        if k not in _SCHEDULE and not k.startswith(UNET_EMA)
    }
    average = {
        k: v
        for k, v in weights.items()
        if k.startswith(UNET_EMA) and k not in _COUNTERS
    }
    if not average:
        return plain
    names = {
        k: UNET_EMA + k.removeprefix("model.").replace(".", "")
        for k in plain
        if k.startswith(UNET)
    }
    averaged = {k: average.pop(name) for k, name in names.items() if name in average}
    return {k: v for k, v in plain.items() if k not in names} | averaged | average


_COUNTERS = (f"{UNET_EMA}decay", f"{UNET_EMA}num_updates")
_SCHEDULE = (
    "logvar betas alphas_cumprod alphas_cumprod_prev sqrt_alphas_cumprod "
    "sqrt_one_minus_alphas_cumprod log_one_minus_alphas_cumprod sqrt_recip_alphas_cumprod "
    "sqrt_recipm1_alphas_cumprod posterior_variance posterior_log_variance_clipped "
    "posterior_mean_coef1 posterior_mean_coef2 scale_factor"
).split()


def _check_schedule(
    weights: Mapping[str, Tensor], arguments: Mapping[str, Any], what: str
) -> None:
    if "scale_factor" in weights and float(weights["scale_factor"]) != 1:
        raise DataError(
            f"{what}: latents scaled by {float(weights['scale_factor'])}",
            "1, as in LiDM's releases",
        )
    if (signal := weights.get("alphas_cumprod")) is None:
        return
    times = schedule_times(
        arguments["beta_start"], arguments["beta_end"], arguments["steps"]
    )
    if signal.shape != times.shape:
        raise DataError(
            f"{what}: a noise schedule of shape {tuple(signal.shape)}",
            f"{tuple(times.shape)}",
        )
    signal = signal.double()
    stored = (1 - signal).sqrt() / (signal.sqrt() + (1 - signal).sqrt())
    if not torch.allclose(stored, times, atol=1e-4):
        raise DataError(
            f"{what}: another noise schedule than in its config.yaml",
            "linear_start, linear_end, timesteps",
        )


def _arranged(ours: str, tensor: Tensor, part: NetworkSpec) -> Tensor:
    """LiDM's tensor in our order of dimensions and classes."""
    # LiDM: unlabelled, then 19 classes; ours: 19 classes, then unlabelled
    if part.architecture == "semantic_map":
        return tensor[:, [*range(1, len(NAMES) + 1), 0]]
    if ours == "view_embedding":
        return tensor[0]
    if (
        part.architecture == "diffusion_unet"
        and ".attention.qkv." in ours
        and not part.arguments["context_channels"]
    ):
        # In LiDM, heads are outermost: query, key and value of the first head, then of the next.
        width = part.arguments["head_channels"]
        tensor = (
            tensor.reshape(-1, 3, width, *tensor.shape[1:])
            .transpose(0, 1)
            .reshape(tensor.shape)
        )
    linear = (".qkv.", ".out.", ".enter.", ".leave.")
    if tensor.ndim > 2 and any(name in ours for name in linear):
        return tensor.flatten(1)
    return tensor
