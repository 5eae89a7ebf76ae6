"""Archives of every extractor in the form in which its authors publish it, with random weights: for
tests, benchmarks and comparisons with the peers' code. The weights depend on the seed and on
nothing else."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import nn

from lidar_synth.lab.evaluate.extractors.darknet import RangeNet
from lidar_synth.lab.evaluate.extractors.liploc import PREFIX
from lidar_synth.lab.evaluate.extractors.pointnet import PointNet
from lidar_synth.lab.evaluate.extractors.rangevit import build
from lidar_synth.lab.evaluate.extractors.squeezeseg import SqueezeSeg
from lidar_synth.lab.evaluate.extractors.voxel_networks import SPVCNN, MinkowskiNet

MEANS = [12.12, 10.88, 0.23, -1.04, 0.21]
DEVIATIONS = [12.32, 11.47, 6.91, 0.86, 0.16]
RAW = [0, 10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81]
VOXELS = {
    "model_params": {
        "cr": 0.5,
        "layer_num": [32, 32, 64, 128, 256, 256, 128, 96, 96],
        "input_dims": 4,
        "num_class": 20,
        "voxel_size": 0.05,
    }
}
RANGEVIT = {
    "n_classes": 20,
    "in_channels": 4,
    "patch_size": [2, 8],
    "patch_stride": [2, 8],
    "decoder": "up_conv",
    "vit_backbone": "vit_small_patch16_384",
    "skip_filters": 128,
    "image_size": [64, 384],
    "conv_stem": "ConvStem",
    "stem_base_channels": 32,
    "D_h": 128,
    "use_kpconv": True,
    "original_image_size": [64, 1024],
    "sensor": {
        "fov_up": 3,
        "fov_down": -25,
        "depth_range": [1.0, 56.0],
        "depth_scale": 56,
    },
}


def fill(module: nn.Module, seed: int) -> dict[str, torch.Tensor]:
    """Random weights for a module; its state dictionary."""
    rng = np.random.RandomState(seed)
    state = module.state_dict()
    for name in sorted(state):
        value = state[name]
        last = name.rpartition(".")[2]
        if last == "num_batches_tracked" or name.startswith("image_"):
            continue
        if last == "running_var" or (last == "weight" and value.ndim == 1):
            low = 0.5
            high = 1.5
        elif last == "kernel" and value.ndim == 3:
            high = (
                1 / value.shape[1]
            ) ** 0.5  # sparse: about three of 27 neighbours are there
            low = -high
        elif value.ndim > 1 and last in ("weight", "kernel"):
            high = (
                3 / (value.shape[0] if last == "kernel" else value[0].numel())
            ) ** 0.5
            low = -high
        else:
            low = -0.1
            high = 0.1
        drawn = rng.random_sample(tuple(value.shape)) * (high - low) + low
        state[name] = torch.from_numpy(drawn.astype(np.float32))
    module.load_state_dict(state)
    return state


def _bonnetal(
    folder: Path,
    network: nn.Module,
    name: str,
    seed: int,
    columns: int,
    remission: bool,
    layers: int,
) -> None:
    fill(network, seed)
    for part in ("backbone", "segmentation_decoder", "segmentation_head"):
        torch.save(network.get_submodule(part).state_dict(), folder / part)
    channels = 5 if remission else 4
    inputs = {"range": True, "xyz": True, "remission": remission}
    sensor = {
        "name": "HDL64",
        "type": "spherical",
        "fov_up": 3,
        "fov_down": -25,
        "img_prop": {"width": columns, "height": 64},
        "img_means": MEANS[:channels],
        "img_stds": DEVIATIONS[:channels],
    }
    settings = {
        "backbone": {
            "name": name,
            "input_depth": inputs,
            "OS": 32,
            "dropout": 0.0,
            "bn_d": 0.01,
            "extra": {"layers": layers},
        },
        "decoder": {"name": name, "dropout": 0.0, "bn_d": 0.01},
        "head": {"name": "segmentation"},
        "dataset": {"sensor": sensor},
    }
    (folder / "arch_cfg.yaml").write_text(yaml.safe_dump(settings))
    (folder / "data_cfg.yaml").write_text(
        yaml.safe_dump({"learning_map_inv": dict(enumerate(RAW))})
    )


def _lidm_rangenet(folder: Path, seed: int) -> None:
    network = RangeNet(4, 0, 21)
    fill(network, seed)
    for part in ("backbone", "segmentation_decoder"):
        torch.save(network.get_submodule(part).state_dict(), folder / part)
    inputs = {"range": True, "xyz": True, "remission": False}
    backbone = {
        "input_depth": inputs,
        "dropout": 0.0,
        "bn_d": 0.01,
        "OS": 32,
        "extra": {"layers": 21},
    }
    settings = {"backbone": backbone, "decoder": {"dropout": 0.0, "bn_d": 0.01}}
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))


def _checkpoint(
    folder: Path, settings: dict[str, Any], state: dict[str, torch.Tensor]
) -> None:
    (folder / "config.yaml").write_text(yaml.safe_dump(settings))
    torch.save({"state_dict": state, "epoch": 1}, folder / "model.ckpt")


def _voxels(network: type[MinkowskiNet]) -> Callable[[Path, int], None]:
    widths = [
        int(VOXELS["model_params"]["cr"] * w)
        for w in VOXELS["model_params"]["layer_num"]
    ]  # type: ignore
    return lambda folder, seed: _checkpoint(folder, VOXELS, fill(network(widths), seed))


def _rangevit(channels: int) -> Callable[[Path, int], None]:
    settings = RANGEVIT | {"in_channels": channels}
    return lambda folder, seed: _checkpoint(
        folder, settings, fill(build(settings), seed)
    )


def _liploc(folder: Path, seed: int) -> None:
    import timm

    settings = {
        "trained_image_model_name": "resnet50",
        "pretrained": False,
        "trainable": False,
    }
    state = fill(
        timm.create_model(
            "resnet50", pretrained=False, num_classes=0, global_pool="avg"
        ),
        seed,
    )
    _checkpoint(folder, settings, {PREFIX + k: v for k, v in state.items()})


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "rangenet53": lambda f, s: _bonnetal(
        f, RangeNet(5, 20, 53), "darknet", s, 1024, True, 53
    ),
    "rangenet21": lambda f, s: _bonnetal(
        f, RangeNet(5, 20, 21), "darknet", s, 2048, True, 21
    ),
    "squeezeseg": lambda f, s: _bonnetal(
        f, SqueezeSeg(5, 20), "squeezeseg", s, 2048, True, 0
    ),
    "lidm_rangenet": _lidm_rangenet,
    "r2flow_rangenet": lambda f, s: _bonnetal(
        f, RangeNet(4, 20, 21), "darknet", s, 1024, False, 21
    ),
    "r3dpa_rangevit": _rangevit(4),
    "r3dpa_rangevit_remission": _rangevit(5),
    "sparenet_pointnet": lambda f, s: torch.save(
        fill(PointNet(), s), f / "cls_model_39.pth"
    ),
    "lidm_minkowski": _voxels(MinkowskiNet),
    "lidm_spvcnn": _voxels(SPVCNN),
    "liploc": _liploc,
}
"""``(folder, seed)`` -> writes the files of an extractor's archive, by the extractor's name."""


def write(name: str, folder: Path, seed: int = 0) -> Path:
    """Write the archive of an extractor with random weights; the path to load."""
    folder.mkdir(parents=True, exist_ok=True)
    WRITERS[name](folder, seed)
    return folder / "cls_model_39.pth" if name == "sparenet_pointnet" else folder
