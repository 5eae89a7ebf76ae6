"""A small release of R2DM: its own names and shapes, with the random weights of
tests/golden/r2dm.*."""

import copy
import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

GOLDEN = Path(__file__).parent / "golden"
CFG: dict[str, Any] = {
    "data": {
        "dataset": "kitti_360",
        "depth_format": "log_depth",
        "projection": "spherical-1024",
        "train_depth": True,
        "train_reflectance": True,
        "resolution": (16, 32),
    },
    "model": {
        "architecture": "efficient_unet",
        "base_channels": 4,
        "temb_channels": 8,
        "channel_multiplier": (1, 1, 2, 2),
        "num_residual_blocks": (1, 2, 1, 1),
        "gn_num_groups": 2,
        "gn_eps": 1e-6,
        "attn_num_heads": 2,
        "coords_encoding": "fourier_features",
        "dropout": 0.0,
    },
    "diffusion": {
        "num_training_steps": None,
        "num_sampling_steps": 1024,
        "prediction_type": "eps",
        "loss_type": "l2",
        "noise_schedule": "cosine",
        "timestep_type": "continuous",
    },
    "training": {"lr": 1e-4},
}


def golden_weights() -> dict[str, Tensor]:
    """The weights and buffers by R2DM's names."""
    stored = load_file(GOLDEN / "r2dm.safetensors")
    kept = {
        name.removeprefix("weights."): value.float()
        for name, value in stored.items()
        if name.startswith("weights.")
    }
    buffers = json.loads((GOLDEN / "r2dm.json").read_text())["buffers"]
    return kept | {name: torch.tensor(value) for name, value in buffers.items()}


def change(**groups: dict[str, Any]) -> dict[str, Any]:
    """The configuration with some of its values replaced."""
    cfg = copy.deepcopy(CFG)
    for group, values in groups.items():
        cfg[group] |= values
    return cfg


def write_r2dm(
    path: Path,
    weights: dict[str, Tensor] | None = None,
    cfg: dict[str, Any] = CFG,
) -> Path:
    """Write a file like R2DM's training, including values that sampling does not need."""
    weights = golden_weights() if weights is None else weights
    content = {
        "cfg": cfg,
        "weights": {name: torch.zeros_like(value) for name, value in weights.items()},
        "ema_weights": weights,
        "optimizer": {"state": {}, "param_groups": [{"lr": 1e-4}]},
        "lr_scheduler": {},
        "global_step": 300_000,
    }
    torch.save(content, path)
    return path
