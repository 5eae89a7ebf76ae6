"""Small releases of other projects, with random weights: R2Flow's and LiDM's checkpoints as users
download them."""

import copy
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from lidar_synth.generate.checkpoint import CODEC, VELOCITY
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.lidm.diffusion import schedule_times
from lidar_synth.lab.importers.lidm import _parts
from lidar_synth.lab.importers.lidm_names import UNET, UNET_EMA, peer_names
from lidar_synth.lab.importers.r2flow import (
    HARMONICS,
    block_names,
    peer_names as r2flow_names,
)

DEPTHS = (1, 1, 1, 1)
CFG: dict[str, Any] = {
    "data": {
        "dataset": "kitti_360",
        "data_format": "logscale",
        "train_reflectance": True,
        "projection": "spherical-1024",
        "resolution": [64, 64],
        "min_depth": 1.45,
        "max_depth": 80.0,
    },
    "model": {
        "architecture": "nat_hdit",
        "base_channels": 16,
        "temb_channels": 16,
        "num_residual_blocks": list(DEPTHS),
        "coords_encoding": "learnable_embedding",
    },
    "flow": {"num_sampling_steps": 32, "solver": "dopri5"},
    "training": {"lr": 1e-4},
    "finetuning": {"init_ckpt": None, "k_distil": None},
}


def peer_weights(position: str = "learned") -> dict[str, Tensor]:
    """Random weights with R2Flow's names and shapes."""
    torch.manual_seed(0)
    net = build_network(
        "hdit",
        {
            "resolution": (64, 64),
            "width": 16,
            "time_width": 16,
            "depths": DEPTHS,
            "position": position,
            "angles": torch.rand(2, 64, 64),
        },
    )
    state = net.state_dict()
    weights = {
        theirs: torch.randn_like(state[ours])
        for ours, theirs in r2flow_names(DEPTHS, position).items()
    }
    weights["coords"] = state["angles.cells"][None]
    weights["tokenizer.0.weight"] = torch.randn(16, 2, 1, 4)
    if position == "learned":
        weights["spatial_pe.embedding"] = torch.randn(1, 64, 16, 16)
    for ours, theirs in block_names(DEPTHS).items():
        level = (
            len(DEPTHS) - 1 if ours.startswith("middle") else int(ours.split(".")[1])
        )
        for i, name in enumerate(HARMONICS):
            weights[f"{theirs}.{name}"] = state[f"rotary.{level}.harmonics"][i].clone()
    return weights


def write_r2flow(
    path: Path, weights: dict[str, Tensor], cfg: dict[str, Any] = CFG
) -> Path:
    """Write a file like R2Flow's training, including values that sampling does not need."""
    optimizer = {
        "state": {0: {"step": 1, "exp_avg": torch.zeros(3)}},
        "param_groups": [{"lr": 1e-4}],
    }
    torch.save(
        {
            "cfg": cfg,
            "weights": weights,
            "optimizer": optimizer,
            "lr_scheduler": {},
            "num_images": 96,
        },
        path,
    )
    return path


DDCONFIG = {
    "double_z": False,
    "z_channels": 4,
    "in_channels": 1,
    "out_ch": 1,
    "ch": 8,
    "ch_mult": [1, 2],
    "strides": [[2, 2]],
    "num_res_blocks": 1,
    "attn_levels": [],
    "dropout": 0.0,
}
FIRST = {
    "embed_dim": 4,
    "n_embed": 16,
    "lib_name": "lidm",
    "use_mask": False,
    "ddconfig": DDCONFIG,
}
UNET_PARAMS = {
    "image_size": [4, 16],
    "in_channels": 4,
    "out_channels": 4,
    "model_channels": 16,
    "attention_resolutions": [2, 1],
    "num_res_blocks": 1,
    "channel_mult": [1, 2],
    "num_head_channels": 8,
    "lib_name": "lidm",
}
DATASET = {
    "size": [8, 32],
    "fov": [3, -25],
    "depth_range": [1.0, 56.0],
    "depth_scale": 56,
    "log_scale": False,
}
UNCONDITIONAL = {
    "linear_start": 0.0015,
    "linear_end": 0.0195,
    "timesteps": 1000,
    "first_stage_config": {"params": FIRST},
    "unet_config": {"params": UNET_PARAMS},
    "cond_stage_config": "__is_unconditional__",
}
SEMANTIC = UNCONDITIONAL | {
    "unet_config": {"params": UNET_PARAMS | {"in_channels": 7}},
    "cond_stage_config": {
        "target": "lidm.modules.encoders.modules.SpatialRescaler",
        "params": {"strides": [[2, 2]], "in_channels": 20, "out_channels": 3},
    },
}
CAMERA = UNCONDITIONAL | {
    "unet_config": {
        "params": UNET_PARAMS | {"use_spatial_transformer": True, "context_dim": 12}
    },
    "cond_stage_config": {
        "target": "lidm.modules.encoders.modules.FrozenClipMultiImageEmbedder",
        "params": {"model": "ViT-L/14", "out_dim": 12, "split_per_view": 4},
    },
}
MASKED = FIRST | {
    "use_mask": True,
    "ddconfig": DDCONFIG | {"out_ch": 2, "attn_levels": [1, 5]},
}
MASKED_FLOW = UNCONDITIONAL | {"first_stage_config": {"params": MASKED}}
MODELS = {
    "first stage": FIRST,
    "unconditional": UNCONDITIONAL,
    "semantic": SEMANTIC,
    "camera": CAMERA,
    "first stage with a mask": MASKED,
    "flow with a mask": MASKED_FLOW,
}


def config_of(
    model: dict[str, Any], target: str = "lidm.data.kitti.KITTI360Train", **dataset: Any
) -> dict[str, Any]:
    data = {
        "dataset": DATASET | dataset,
        "aug": {"camera_drop": 0.5},
        "train": {"target": target},
    }
    return copy.deepcopy(
        {"model": {"target": "some.Model", "params": model}, "data": {"params": data}}
    )


def schedule(start: float = 0.0015, end: float = 0.0195) -> dict[str, Tensor]:
    times = schedule_times(start, end, 1000)
    signal = ((1 - times) ** 2 / ((1 - times) ** 2 + times**2)).float()
    return {
        "betas": torch.zeros(1000),
        "alphas_cumprod": signal,
        "logvar": torch.zeros(1000),
    }


def random_weights(model: dict[str, Any], folder: Path) -> dict[str, Tensor]:
    """Random weights in LiDM's shapes; the projections of its attention are convolutions."""
    torch.manual_seed(0)
    parts = _parts(model, DATASET, {}, folder)[0]
    nested, weights = (
        set(parts) != {CODEC},
        schedule() if "unet_config" in model else {},
    )
    for name, part in parts.items():
        state = build_network(*part).state_dict()
        for ours, theirs in peer_names(name, part, nested).items():
            shape = [state[ours].shape[0] // len(theirs), *state[ours].shape[1:]]
            if ours == "view_embedding":
                shape = [1, *shape]
            if (
                name == CODEC
                and (".attn_1." in theirs[0] or ".attn." in theirs[0])
                and len(shape) == 2
            ):
                shape += [1, 1]
            elif name == VELOCITY and theirs[0].endswith(
                ("1.qkv.weight", "1.proj_out.weight", "1.proj_in.weight")
            ):
                shape += [1, 1] if part.arguments["context_channels"] else [1]
            weights |= {one: torch.randn(shape) * 0.1 for one in theirs}
    if nested:
        for key in [k for k in weights if k.startswith(UNET)]:
            weights[UNET_EMA + key.removeprefix("model.").replace(".", "")] = (
                torch.randn_like(weights[key]) * 0.1
            )
        weights |= {
            f"{UNET_EMA}decay": torch.tensor(0.9999),
            f"{UNET_EMA}num_updates": torch.tensor(7),
        }
    if model is CAMERA:
        # Frozen CLIP, which is not imported.
        weights["cond_stage_model.model.visual.proj"] = torch.zeros(3, 3)
    return weights


def release(folder: Path, config: dict[str, Any], weights: dict[str, Tensor]) -> Path:
    """Write a release as a user downloads it, including values that only training needs."""
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    optimizer = {
        "state": {0: {"step": 1, "exp_avg": torch.zeros(3)}},
        "param_groups": [{"lr": 1e-6}],
    }
    torch.save(
        {
            "epoch": 3,
            "global_step": 9,
            "state_dict": weights,
            "optimizer_states": [optimizer],
        },
        folder / "model.ckpt",
    )
    return folder / "model.ckpt"
